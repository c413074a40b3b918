"""Pictures of comparisons, spectra, streams and scans from plain values."""
