"""What the analysis removes."""
