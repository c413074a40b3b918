"""What the optics take away."""
