"""Turbulent layers: covariance, lattice, beams, geometry, sampling, nodes."""
