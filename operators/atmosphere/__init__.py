"""The air between the telescope and the sky."""
