"""Atomic writes, checks of untrusted files, locks."""
