"""Pictures of maps, spectra, streams and scans from plain values: figures, axes on the sky, PNG
files, the process that draws.
"""
