"""How the virtual sensor moves."""
