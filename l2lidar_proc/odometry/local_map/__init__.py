"""The map that sweeps are aligned with: surfaces, in a grid of cells of several sizes."""
