"""The link to the host: ports and faults."""
