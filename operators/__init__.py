"""Everything that flows over the data, grouped by what it does."""
