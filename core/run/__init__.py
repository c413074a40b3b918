"""Carries a pipeline's runs out: which operators take part, over which observations, in which
blocks, within what memory.
"""
