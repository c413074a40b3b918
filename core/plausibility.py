"""Warnings of numbers of a scene that are not of the size that the field knows: a wrong unit is off
by a factor of 60 or 1000.

What is beyond is possible, so that it is warned of and not refused; limits are wide. The checks of
steps use `doubt`, too.
"""

from __future__ import annotations

import math

from .band import SPEED_OF_LIGHT
from .instrument import Instrument

NET = 1e-6, 3.0
"""K_RJ s^1/2, on the sky."""
DIAMETER = 0.02, 500.0
"""m, of a primary."""
BAND = 1e9, 1e13
"""Hz, centre of a band."""
EFFICIENCY = 0.01, 1.0
WIDTHS = 0.4, 50.0
"""Beam in units of 1.22 lambda / D."""
KNEE = 1e-5, 1e3
"""Hz."""
PWV = 2e-5, 0.06
"""m at zenith."""
FLUX = 1e-9, 1e6
"""Jy, the brightest of a catalogue."""


def doubt(what: str, value: float, limits: tuple[float, float], unit: str) -> str:
    """The warning about a number that is none or beyond its limits; empty where it is within, or 0:
    nothing of it.
    """
    low, high = limits
    if value == 0 or low <= abs(value) <= high:
        return ""
    size = "small" if abs(value) < low else "large"
    return (
        f"{what} is {value:.3g} {unit}".rstrip()
        + f", very {size} (known are {low:g} to {high:g}); is its unit right?"
    )


def doubts(instrument: Instrument) -> list[str]:
    """The warnings about a telescope and its camera."""
    found = [
        doubt(
            f"{instrument.telescope.name}: diameter",
            instrument.telescope.diameter,
            DIAMETER,
            "m",
        )
    ]
    for name, camera in instrument.cameras.items():
        centre = camera.band.centre
        who = f"{instrument.name}, {name}"
        found.append(
            doubt(f"{who}: the band's centre", centre / 1e9, (BAND[0] / 1e9, BAND[1] / 1e9), "GHz")
        )
        limit = 1.22 * SPEED_OF_LIGHT / centre / instrument.telescope.diameter
        plane = camera.focalplane() if camera.focalplane_table is not None else None
        widths = (
            [camera.beam_fwhm]
            if plane is None
            else [float(plane.fwhm.min()), float(plane.fwhm.max())]
        )
        nets = [camera.net] if plane is None else [float(plane.net.min()), float(plane.net.max())]
        for fwhm in widths:
            text = (
                f"{who}: the beam of {math.degrees(fwhm) * 3600:.3g} arcsec, in units of 1.22"
                " lambda / D,"
            )
            found.append(doubt(text, fwhm / limit, WIDTHS, ""))
        found += [doubt(f"{who}: NET", net, NET, "K sqrt(s)") for net in nets]
        found.append(doubt(f"{who}: knee of the pink noise", camera.knee, KNEE, "Hz"))
        for key in ("main_beam_efficiency", "illumination_efficiency"):
            found.append(
                doubt(f"{who}: {key.replace('_', ' ')}", getattr(camera, key), EFFICIENCY, "")
            )
    return list(dict.fromkeys(text for text in found if text))
