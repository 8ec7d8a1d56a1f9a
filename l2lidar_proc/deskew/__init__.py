"""Deskew and filters."""
