"""Figures of a run: for `zonda accuracy`, and of maps, spectra and modes."""
