"""What the detectors add."""
