"""The beam of a map to which detectors of different beams contribute.

A point source of flux density S is seen by a detector of Gaussian beam O_d with the peak S / O_d,
and the map's peak is the mean of these by the weights W_d that the detectors have in it. The beam
of the map is the Gaussian of the solid angle O with

    1 / O = sum W_d / O_d / sum W_d,
    that is   FWHM^-2 = sum W_d FWHM_d^-2 / sum W_d:                           (1)

peak times O is S, as is the integral over the map (which is S for any beams). No single Gaussian
has the shape of a sum of several: what lies between, such as a fit of the width, is as near as the
beams are to each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..errors import InputError
from ..numerics.sphere import ARCSEC
from ..types import Floats

UNIT = 1 << 10
"""Of weights, which are added up as whole numbers: their sums do not depend on the order."""
SPREAD = 1.1
"""Widest over narrowest beam above which the shape of the map's beam is worth a warning."""


WIDER = 3.0
"""Widths of a map in which the beam that its header states cannot be."""


def check_width(fwhm: float, across: float, place: str, cure: str) -> None:
    """Raise InputError for a beam [rad] that is `WIDER` than the map, ``across`` [rad]: BMAJ in
    arcsec or radians.
    """
    if fwhm > WIDER * across:
        text = (
            f"the beam of the map is {size_text(fwhm)} wide, and the whole map {size_text(across)}"
        )
        raise InputError(text, place=place, cure=cure)


def size_text(angle: float) -> str:
    """An angle [rad] as headers write it: ``20 deg``, ``18 arcsec``."""
    return (
        f"{math.degrees(angle):.4g} deg"
        if angle >= math.radians(0.1)
        else f"{angle / ARCSEC:.4g} arcsec"
    )


def effective_fwhm(weights: Mapping[float, float]) -> float:
    """Equation (1) [rad] of weights by FWHM; of one FWHM that itself; 0 where one of them is not
    known (0) or there is none.
    """
    used = sorted((fwhm, weight) for fwhm, weight in weights.items() if weight > 0)
    if not used or not used[0][0] > 0:
        return 0.0
    if len(used) == 1:
        return used[0][0]
    total = math.fsum(weight for _, weight in used)
    return math.sqrt(total / math.fsum(weight / fwhm**2 for fwhm, weight in used))


def expected_fwhm(fwhm: Floats, net: Floats) -> float:
    """Equation (1) [rad] of detectors (n_det,) that see the same of a map, with the weights of
    their ``net``; equal ones where one is 0."""
    weight = net**-2.0 if (net > 0).all() else np.ones(len(net))
    return effective_fwhm(dict(_by_width(fwhm, weight)))


def _by_width(fwhm: Floats, weight: Floats) -> list[tuple[float, float]]:
    """Each width, and the sum of the weights of its detectors."""
    widths, which = np.unique(fwhm, return_inverse=True)
    return list(zip(widths.tolist(), np.bincount(which, weight, len(widths)).tolist(), strict=True))


@dataclass
class Beams:
    """Weights in a map by the detectors' FWHM [rad], in whole numbers of `UNIT` times a sample of
    weight 1.
    """

    weights: dict[float, int] = field(default_factory=dict)

    def add(self, fwhm: Floats, weight: Floats, samples: int) -> None:
        """Detectors of ``fwhm`` (n_det,) whose samples weigh ``weight`` (n_det,), with about
        ``samples`` each.
        """
        for width, total in _by_width(fwhm, weight):
            share = round(total * UNIT) * samples
            if share > 0:
                self.weights[width] = self.weights.get(width, 0) + share

    def __iadd__(self, other: Beams) -> Beams:
        for width, share in other.weights.items():
            self.weights[width] = self.weights.get(width, 0) + share
        return self

    @property
    def fwhm(self) -> float:
        """FWHM of the map, equation (1)."""
        return effective_fwhm(self.weights)

    @property
    def extremes(self) -> tuple[float, float]:
        """Narrowest and widest FWHM; zeros where there is none."""
        return (min(self.weights), max(self.weights)) if self.weights else (0.0, 0.0)
