"""The commands beside `run`, `check` and `plan`."""
