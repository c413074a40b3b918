"""Effects of telescope and optics: efficiencies, ground pickup, polarization."""
