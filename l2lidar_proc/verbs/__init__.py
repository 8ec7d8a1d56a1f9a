"""Command line verbs of the companion."""
