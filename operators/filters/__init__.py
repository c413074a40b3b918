"""Filters of the analysis."""
