"""Noise of a map: the circle in which it is stated, its size in units of the white noise, and the
words for it.
"""

from __future__ import annotations

import numpy as np

from ..numerics.angles import ARCMIN
from ..types import Floats

ACROSS = 5.0
"""Beams and pixels across the circle, at least: an rms of fewer beams is known to no better than a
quarter.
"""


def central_diameter(fwhm: float, pixel: float, given: float | None = None) -> float:
    """``given``; where that is None 1 arcmin, or `ACROSS` beams or pixels where these are wider.
    All in rad.
    """
    return max(ARCMIN, ACROSS * fwhm, ACROSS * pixel) if given is None else given


def in_beams(diameter: float, fwhm: float) -> str:
    """`` (6.7 beams)``, what a circle is wide; empty where the beam is not known."""
    return f" ({diameter / fwhm:.2g} beams)" if fwhm > 0 else ""


LEAST = 0.1
"""Share of the 99th percentile of the weight (1 / noise^2) that a pixel needs for its noise to be
measured.
"""
ELSEWHERE = "that of the complete map, none in this one"
"""Said of the noise of a signal without noise (`Signal.is_quiet`): it is that of the complete map.
"""
WHITE = "white noise only"
"""Said of noise that is the standard error of independent pixels, where no map of the noise alone
is known.
"""


def noise_factor(noise: Floats, alone: Floats) -> float | None:
    """The rms of ``alone`` / ``noise`` over pixels with at least `LEAST` of the usual weight: what
    white noise is to be multiplied by, so that noise that is correlated between pixels (1/f noise,
    the atmosphere) counts in full. None where it cannot be measured."""
    with np.errstate(invalid="ignore", divide="ignore"):
        weight, ratio = noise**-2.0, alone / noise
    known = np.isfinite(ratio) & np.isfinite(weight)
    if not known.any():
        return None
    well = known & (weight >= LEAST * np.percentile(weight[known], 99))
    factor = float(np.sqrt(np.mean(ratio[well] ** 2)))
    return factor if factor > 0 else None


def stated(noise: Floats, alone: tuple[Floats, str] | None) -> tuple[float | None, str]:
    """`noise_factor`, and what it was measured in; None and `WHITE` where it is not known.
    ``alone``: the map and its name.
    """
    factor = None if alone is None else noise_factor(noise, alone[0])
    return (None, WHITE) if alone is None or factor is None else (factor, alone[1])
