"""The driver core: packets to sweeps, commands, device health."""
