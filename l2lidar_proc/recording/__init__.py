"""Bags, trajectories and map files."""
