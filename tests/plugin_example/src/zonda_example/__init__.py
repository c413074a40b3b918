"""A third-party zonda plugin."""
