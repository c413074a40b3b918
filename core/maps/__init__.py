"""Maps, however they are made: products, views of them, and the images that they are simulated
from.
"""
