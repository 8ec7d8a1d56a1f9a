"""The way to the host: ports, faults and damage."""
