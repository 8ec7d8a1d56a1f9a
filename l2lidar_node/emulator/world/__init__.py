"""What the virtual L2 sees: scenes and ray casting."""
