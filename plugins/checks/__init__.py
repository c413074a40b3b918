"""The built-in checks of `zonda doctor`: those that say something about the machine at hand, one
module per family.
"""
