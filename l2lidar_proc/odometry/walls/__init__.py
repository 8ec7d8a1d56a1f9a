"""Velocity along bare walls, where surfaces leave it free."""
