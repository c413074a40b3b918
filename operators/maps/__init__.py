"""From time streams to maps."""
