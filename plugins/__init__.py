"""The built-in instruments, sites, bands and noise models, registered through the entry points a
third party uses.
"""
