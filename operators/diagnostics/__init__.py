"""Spectra, pictures and reports."""
