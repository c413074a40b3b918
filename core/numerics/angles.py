"""Units of angle, angles as text, and the width of a Gaussian."""

import math

ARCMIN = math.pi / 10800
"""rad."""
ARCSEC = math.pi / 648000
"""rad."""
FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))
"""Full width at half maximum of a Gaussian of unit standard deviation."""


def beam_area(fwhm: float) -> float:
    """Solid angle of a Gaussian beam, sr."""
    return math.pi / math.log(16) * fwhm**2


def angle_text(value: float, digits: int = 3) -> str:
    """``4°``, ``1.5′``, ``8.5″``, of rad."""
    for unit, name in ((60 * ARCMIN, "°"), (ARCMIN, "′")):
        if abs(value) >= unit:
            return f"{value / unit:.{digits}g}{name}"
    return f"{value / ARCSEC:.{digits}g}″"


def sides_text(y: float, x: float) -> str:
    """Size of a pixel of these sides [rad]: ``2″`` where they are equal to a per cent, else across
    and up, ``1″ x 2″``.
    """
    return angle_text(y) if abs(x / y - 1) < 0.01 else f"{angle_text(x)} x {angle_text(y)}"
