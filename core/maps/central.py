"""Width of the circle in the middle of a map in which its noise and its depth are stated."""

from __future__ import annotations

from ..numerics.angles import ARCMIN

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
