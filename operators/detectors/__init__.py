"""What detectors and their readout do to the signal."""
