"""Noise of the detectors."""
