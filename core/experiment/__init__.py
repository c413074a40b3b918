"""Variants of a pipeline, run at several seeds, and the values that metrics have there."""
