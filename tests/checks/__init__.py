"""The slow half of the stability matrix: checks that say something about the code rather than about
the machine.
"""

from zonda.core.checks import Check, registered

from . import (
    covariance,
    determinism,
    filters,
    geometry,
    lattice,
    maps,
    means,
    noise,
    opacity,
    pointing,
    timing,
)
from .cases import MATRIX

FAMILIES = (
    covariance,
    lattice,
    geometry,
    filters,
    maps,
    opacity,
    noise,
    pointing,
    timing,
    determinism,
    means,
)


def matrix() -> list[Check]:
    """Every check of the matrix, in the order of its rows; those of `zonda doctor` first."""
    every = registered() + [check for module in FAMILIES for check in module.checks]
    return [check for case in MATRIX for check in every if check.case is case]
