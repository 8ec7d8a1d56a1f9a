"""Alignment of a sweep with the map: correspondences, weak directions, and the state after it."""
