"""Many observations as tasks on any engine."""
