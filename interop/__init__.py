"""Bridges: scans as objects of other packages, and back. Each module needs the extra of its
name.
"""
