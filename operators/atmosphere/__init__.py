"""The atmosphere between the telescope and the sky."""
