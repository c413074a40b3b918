"""Pointing: simulated and recorded scans, and the transformation between the sky and the
horizon.
"""
