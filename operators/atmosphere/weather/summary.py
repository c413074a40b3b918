"""Text of `zonda weather`: the profile, the PWV by month and hour, and what instruments see."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.tables import aligned
from zonda.core.types import Floats

from . import climatology
from .bands import BandAtmosphere
from .profiles import PWV_MAX, Profile

if TYPE_CHECKING:
    from collections.abc import Iterable

    from zonda.core.instrument import Band
    from zonda.core.site import Site


HOURS = tuple(range(0, 24, 3))
"""UTC."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
HEIGHTS = (0.0, 250.0, 500.0, 1e3, 2e3, 3e3, 5e3, 8e3, 12e3, 20e3)
"""m above the site, in the table."""
MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


@dataclass(frozen=True)
class PwvByMonth:
    """PWV [m] on the 15th of each month: ``median`` (12, n_hour), and the mean over the hours of
    ``quantiles`` (12, 5).
    """

    median: Floats
    quantiles: Floats


def pwv_by_month(site: Site, year: int = 2023) -> PwvByMonth:
    """PWV by month, from the site's climatology. Raises `InputError` where there is none."""
    median, quantiles = np.empty((12, len(HOURS))), np.zeros((12, len(QUANTILES)))
    for month in range(12):
        for k, hour in enumerate(HOURS):
            law = climatology.profile(
                site,
                Instant.parse(f"{year}-{month + 1:02d}-15T{hour:02d}:00Z"),
            ).distribution
            assert law is not None  # the climatology has spreads
            median[month, k] = law.median
            quantiles[month] += np.array([law.at(q) for q in QUANTILES]) / len(HOURS)
    return PwvByMonth(median, quantiles)


def pwv_steps(profile: Profile) -> list[float]:
    """The PWVs [m] for which spectra are shown: the profile's own among round values from very dry
    to very wet there.
    """
    law = profile.distribution
    if not profile.pwv > 0:
        return [0.0, 1e-3]
    low, high = profile.pwv / 3, min(3 * profile.pwv, PWV_MAX)
    if law is not None:
        low, high = law.at(0.05), law.at(0.95)
    rounded = {float(f"{low * (high / low) ** (k / 3):.1g}") for k in range(4)}
    return sorted({profile.pwv, *(p for p in rounded if abs(p / profile.pwv - 1) > 0.2)})


def place_lines(site: Site, time: Instant, profile: Profile) -> list[str]:
    """Lines about place, time and source of the profile."""
    where = (
        f"{math.degrees(site.latitude):.4f} deg, {math.degrees(site.longitude):.4f} deg,"
        f" {site.altitude:g} m"
    )
    head = f"{site.name}: {site.description}" if site.description else site.name
    return [head, f"{where}; {time}", *(f"{what}: {text}" for what, text in profile.stated)]


def profile_lines(profile: Profile) -> list[str]:
    """A table of the profile; the wind is that which blows, coming from a direction."""
    air = profile.at(HEIGHTS)
    columns = (
        ("above site", "m", ".0f", air.height),
        ("pressure", "hPa", ".1f", air.pressure / 100),
        ("temperature", "K", ".1f", air.temperature),
        ("vapour", "g/m3", ".3g", air.vapour_density * 1e3),
        ("wind", "m/s", ".1f", np.hypot(air.wind_east, air.wind_north)),
        ("from", "deg", ".0f", np.degrees(np.arctan2(-air.wind_east, -air.wind_north)) % 360),
    )
    heads, units, forms, values = zip(*columns, strict=True)
    rows = [
        [f"{x:{form}}" for x, form in zip(row, forms, strict=True)]
        for row in zip(*values, strict=True)
    ]
    return aligned([units, *rows], heads, ">", indent="  ")


def pwv_lines(water: PwvByMonth) -> list[str]:
    """A table of the PWV by month and hour."""
    head = ("", *(f"{hour:02d}h" for hour in HOURS), "|", *(f"{100 * q:g} %" for q in QUANTILES))
    rows = [
        (month, *map(_short, medians), "|", *map(_short, quantiles))
        for month, medians, quantiles in zip(MONTHS, water.median, water.quantiles, strict=True)
    ]
    title = "PWV [mm]: median by hour (UTC), and quantiles of the month"
    return [title, *aligned(rows, head, "<>")]


def band_lines(profile: Profile, bands: Iterable[Band], elevation: float) -> list[str]:
    """Emission and transmission of bands at several PWVs and an elevation [rad]."""
    steps = pwv_steps(profile)
    at = f"at an elevation of {math.degrees(elevation):g} deg"
    lines = [f"{at}: emission of the atmosphere (background 0 K), transmission, opacity"]
    for band in bands:
        seen = BandAtmosphere(band, profile, min(max(*steps, 1e-4) * 1.01, PWV_MAX))
        low, high = (edge / 1e9 for edge in band.edges)
        lines.append(f"  {band.name} ({low:.6g} to {high:.6g} GHz)")
        rows = []
        for pwv in steps:
            passed = float(seen.transmission(pwv, elevation))
            rows.append(
                (
                    f"PWV {_short(pwv)} mm:",
                    f"{float(seen.emission(pwv, elevation)):.2f} K_RJ,",
                    f"{passed:{'.4f' if passed >= 1e-3 else '.1e'}},",
                    f"{float(seen.opacity(pwv, elevation)):.4g}",
                    "<" if pwv == profile.pwv else "",
                )
            )
        lines += aligned(rows, align=">", indent="    ")
    return lines


def _short(pwv: float) -> str:
    return f"{pwv * 1e3:.2f}" if pwv < 10e-3 else f"{pwv * 1e3:.1f}"
