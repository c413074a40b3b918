"""How a map differs from a reference: figures, difference, fidelity and SNR.

    B = g A + o,  g and o by least squares, A without error                                                  (1)
    fidelity F = |A| / max(|B - A|, t rms(B - A))                                                            (2)
    chi^2 = sum (B - A)^2 / (n_A^2 + n_B^2)                                                                  (3)

A is the reference, B the map. (2) with t = 0.7 is the fidelity of ALMA's memo 398 (Pety, Gueth & Guilloteau 2001): the threshold
keeps it from being large by chance. The standard error of g and o is that of a jackknife: the fit is repeated without each of
`BLOCKS`^2 parts of the field, so that neighbouring pixels need not be independent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.types import Floats

from .planes import Plane, common
from .radial import Profiles, RadialSpectra, profiles, radial_spectra, ring_edges, tapered

BLOCKS = 6
"""Parts of the field along each side that the jackknife leaves out in turn."""
THRESHOLD = 0.7
"""t of equation (2)."""


@dataclass(frozen=True)
class Comparison:
    """Two maps on one grid and with one beam.

    Attributes
    ----------
    names
        Of the reference and of the map.
    planes
        (ny, nx) each: ``reference``, ``map``, ``difference`` (map - reference), ``fidelity``; ``snr`` of the map where its
        noise is known, and ``reference_snr``.
    header
        Celestial WCS of all of them.
    unit, fwhm, pixel
        Of the values; resolution, and side of a pixel, rad. ``fwhm`` 0: not known.
    figures
        By name, see `figures_of`.
    spectra, profiles
        Of ``reference``, ``map`` and ``difference``.
    notes
        How the maps were brought together.
    centre
        Pixel (x, y) of the profiles' centre.
    label
        Of the step that made it.
    """

    names: tuple[str, str]
    planes: dict[str, Floats]
    header: dict[str, Any]
    unit: str
    fwhm: float
    pixel: float
    figures: dict[str, float]
    spectra: RadialSpectra
    profiles: Profiles
    notes: list[str]
    centre: tuple[float, float]
    label: str = "compare"


@dataclass(frozen=True)
class Settings:
    """How maps are compared: common resolution [rad] (None: the wider of the two), t of equation (2), number of rings."""

    fwhm: float | None = None
    threshold: float = THRESHOLD
    bins: int = 24


def compare(reference: Plane, other: Plane, settings: Settings | None = None, label: str = "compare") -> Comparison:
    """Compare a map with a reference. Raises InputError where they cannot be: `planes.common`."""
    settings = settings or Settings()
    a, b, notes = common(reference, other, settings.fwhm)
    centre = _centre(a)
    a, b, corner = _cropped(a, b)
    both = np.isfinite(a.values) & np.isfinite(b.values)
    planes = {"reference": np.where(both, a.values, np.nan), "map": np.where(both, b.values, np.nan)}
    difference = planes["difference"] = planes["map"] - planes["reference"]
    floor = settings.threshold * rms(difference)
    with np.errstate(invalid="ignore", divide="ignore"):
        planes["fidelity"] = np.abs(planes["reference"]) / np.maximum(np.abs(difference), floor)
        for name, plane in (("snr", b), ("reference_snr", a)):
            if plane.noise is not None and np.isfinite(plane.noise[both]).any():
                planes[name] = np.where(both & (plane.noise > 0), plane.values / plane.noise, np.nan)
    pixel, fwhm = a.pixel, max(a.fwhm or 0.0, b.fwhm or 0.0)
    maps = {name: planes[name] for name in ("reference", "map", "difference")}
    edges = ring_edges(both.shape, pixel, settings.bins)
    spectra = radial_spectra(maps, tapered(both, pixel), pixel, edges)
    centre = centre[0] - corner[0], centre[1] - corner[1]
    area = math.pi / math.log(16) * fwhm**2
    found = profiles(maps, centre, pixel, max(pixel, fwhm / 2), area)
    figures = figures_of(planes["reference"], planes["map"], (a.noise, b.noise))
    figures["pixels"] = float(np.count_nonzero(both))
    figures["median fidelity where the reference is above 10 % of its peak"] = _median_fidelity(planes)
    names = (reference.name, other.name)
    return Comparison(names, planes, a.header, a.unit, fwhm, pixel, figures, spectra, found, notes, centre, label)


def _cropped(a: Plane, b: Plane) -> tuple[Plane, Plane, tuple[int, int]]:
    """The part of both in which both have values, and the pixel (x, y) at which it begins."""
    both = np.isfinite(a.values) & np.isfinite(b.values)
    y, x = (np.flatnonzero(both.any(axis=axis)) for axis in (1, 0))
    window = slice(int(y[0]), int(y[-1]) + 1), slice(int(x[0]), int(x[-1]) + 1)
    header = {key: a.header[key] for key in a.header if key and isinstance(a.header[key], bool | int | float | str)}
    for key, cut in (("CRPIX1", window[1]), ("CRPIX2", window[0])):
        header[key] = float(header.get(key, 0.0)) - cut.start
    first, second = (
        replace(p, values=p.values[window], noise=None if p.noise is None else p.noise[window], header=header) for p in (a, b)
    )
    return first, second, (window[1].start, window[0].start)


def rms(values: Floats) -> float:
    """Root mean square of what is known; NaN where nothing is."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def _median_fidelity(planes: Mapping[str, Floats]) -> float:
    size = np.abs(planes["reference"])
    bright = size > 0.1 * np.nanmax(size)
    return float(np.median(planes["fidelity"][bright])) if bright.any() else math.nan


def _centre(plane: Plane) -> tuple[float, float]:
    """The reference point of the projection where it is in the image, else the middle."""
    ny, nx = plane.values.shape
    x, y = (float(plane.header.get(key, 0.0)) - 1 for key in ("CRPIX1", "CRPIX2"))
    zenithal = str(plane.header.get("CTYPE1", "")).endswith(("TAN", "SIN", "ARC", "STG", "ZEA", "ZPN", "NCP"))
    return (x, y) if zenithal and 0 <= x < nx and 0 <= y < ny else ((nx - 1) / 2, (ny - 1) / 2)


def figures_of(a: Floats, b: Floats, noise: Sequence[Floats | None] = (None, None)) -> dict[str, float]:
    """Figures of a map b against a reference a, both (ny, nx), NaN where either has no value.

    ``rms reference``, ``rms map``, ``rms difference`` and ``mean ...`` (about zero, over pixels with both); ``correlation``
    (Pearson); ``gain``, ``offset`` and their errors, equation (1); ``peak ratio``: b over a where \\|a\\| is largest; ``chi2``
    and its number of pixels, equation (3), where a noise is known.
    """
    both = np.isfinite(a) & np.isfinite(b)
    x, y = a[both], b[both]
    found: dict[str, float] = {}
    for name, values in (("reference", x), ("map", y), ("difference", y - x)):
        found[f"mean {name}"], found[f"rms {name}"] = float(values.mean()), rms(values)
    scatter = x.std() * y.std()
    found["correlation"] = float(((x - x.mean()) * (y - y.mean())).mean() / scatter) if scatter > 0 else math.nan
    fit, error = _line(a, b, both)
    found["gain"], found["gain error"], found["offset"], found["offset error"] = fit[0], error[0], fit[1], error[1]
    peak = int(np.abs(x).argmax())
    found["peak reference"], found["peak ratio"] = float(x[peak]), float(y[peak] / x[peak]) if x[peak] else math.nan
    squares = [n[both] ** 2 for n in noise if n is not None]
    if squares:
        variance = np.sum(squares, axis=0)
        used = np.isfinite(variance) & (variance > 0)
        found["chi2"], found["chi2 pixels"] = float(((y - x)[used] ** 2 / variance[used]).sum()), float(np.count_nonzero(used))
    return found


def _line(a: Floats, b: Floats, both: NDArray[np.bool_]) -> tuple[tuple[float, float], tuple[float, float]]:
    """(gain, offset) and their standard errors."""
    row, column = np.nonzero(both)
    x, y = a[both], b[both]
    x0 = float(x.mean())
    part = (row - row.min()) * BLOCKS // (np.ptp(row) + 1) * BLOCKS + (column - column.min()) * BLOCKS // (np.ptp(column) + 1)
    terms = (np.ones_like(x), x - x0, y, (x - x0) ** 2, (x - x0) * y)
    sums = np.array([np.bincount(part, t, BLOCKS**2) for t in terms])
    whole = sums.sum(axis=1)
    used = np.flatnonzero(sums[0])
    fits = np.array([_solved(whole), *(_solved(whole - sums[:, k]) for k in used)])
    fits[:, 1] -= fits[:, 0] * x0
    left = fits[1:]
    n = len(left)
    error = np.sqrt((n - 1) / n * ((left - left.mean(axis=0)) ** 2).sum(axis=0)) if n > 2 else np.full(2, math.nan)
    return (float(fits[0, 0]), float(fits[0, 1])), (float(error[0]), float(error[1]))


def _solved(sums: Floats) -> tuple[float, float]:
    """Slope, and value at x0, from n, sum x, sum y, sum x^2, sum x y, x counted from x0."""
    n, sx, sy, sxx, sxy = map(float, sums)
    variance = n * sxx - sx**2
    if not variance > 1e-12 * n * sxx:
        return math.nan, math.nan
    gain = (n * sxy - sx * sy) / variance
    return gain, (sy - gain * sx) / n
