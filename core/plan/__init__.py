"""What of a scene is worth simulating."""
