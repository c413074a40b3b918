"""Maps that were made with a beam: a simulated telescope convolves them with its own once more."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from zonda.core.numerics.angles import angle_text
from zonda.core.types import Floats

TOLD = 5e-3
"""Share by which a second beam lowers the peaks of point sources from which it is told."""


def made_with(header: Mapping[str, Any], given: float | None = None) -> tuple[float, float] | None:
    """FWHM (major, minor) [rad] of the beam that a map was made with; None: none is named.

    ``given``: `SkyMap.input_beam` [rad], which replaces the header's BMAJ and BMIN.
    """
    if given is not None:
        return given, given
    major = header.get("BMAJ")
    minor = header.get("BMIN", major)
    sides = [
        b
        for b in (major, minor)
        if isinstance(b, int | float) and not isinstance(b, bool) and math.isfinite(b) and b > 0
    ]
    return (math.radians(sides[0]), math.radians(sides[1])) if len(sides) == 2 else None


def seen_twice(
    beam: tuple[float, float] | None, given: float | None, telescope: Floats
) -> tuple[str, str]:
    """Statement about a map that was made with a ``beam`` (major, minor) [rad], and the warning;
    either may be empty.

    ``given``: `SkyMap.fwhm`; ``telescope`` (n,): the detectors' FWHM [rad]. There is no warning
    where peaks fall by less than `TOLD`, nor where ``given`` makes the resolution that of the
    telescope.
    """
    if beam is None or not telescope.size:
        return "", ""
    own = float(np.median(telescope))
    simulated = own if given is None else given
    major, minor = (math.hypot(simulated, b) for b in beam)
    result = math.sqrt(major * minor)
    was, now = angle_text(math.sqrt(beam[0] * beam[1])), angle_text(result)
    text = (
        f"made with a beam of {was} (BMAJ), convolved with one of {angle_text(simulated)}: {now}"
        " in all"
    )
    share = (simulated / result) ** 2
    if 1 - share < TOLD or (given is not None and abs(result / own - 1) < TOLD / 2):
        return text, ""
    rest = own**2 - beam[0] * beam[1]
    both = (
        f", `fwhm: {math.degrees(math.sqrt(rest)) * 3600:.4g} arcsec` makes {angle_text(own)}"
        " in all"
        if rest > 0
        else ""
    )
    return (
        text,
        (
            f"the map was made with a beam of {was} (BMAJ) and is convolved with the telescope's of"
            f" {angle_text(simulated)} once more: the resolution becomes {now}, and point sources"
            f" keep {share:.2g} of the peak that they have in the telescope's beam. `beam: none`"
            f" samples the map as it is{both}; if the map shows the sky before any beam, remove"
            " BMAJ from its header"
        ),
    )
