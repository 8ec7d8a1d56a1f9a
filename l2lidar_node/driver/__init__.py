"""From ordered packets to sweeps, and how the device is doing."""
