"""How the map begins: at rest, or in motion with a velocity that is found out within seconds."""
