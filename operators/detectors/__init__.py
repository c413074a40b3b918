"""Effects of detectors and their read-out on the signal."""
