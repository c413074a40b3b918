"""Where the telescope looks."""
