"""What really happened in a run."""
