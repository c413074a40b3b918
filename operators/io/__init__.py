"""Files of maps and time streams."""
