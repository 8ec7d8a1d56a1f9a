"""Captures and bags: writing, reading, replay."""
