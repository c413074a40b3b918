"""Two maps on one grid and with one beam: what they have in common, and how they differ."""
