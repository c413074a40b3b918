"""Arithmetic that operators share: random numbers, tiles, smooth fields, projections, transforms,
brightness.
"""
