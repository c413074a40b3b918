"""Files: whole or not at all, from elsewhere with suspicion, locked while they change."""
