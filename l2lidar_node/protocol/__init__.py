"""The wire: layout, framing, packets and commands."""
