"""Shipped pipelines, each runnable by name."""
