"""Plans a run: what of a scene is worth simulating, and what it costs."""
