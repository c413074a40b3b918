"""Differences of a map from a reference: values, difference, fidelity and SNR.

    B = g A + o,
    g and o by least squares, A without error                                                  (1)
    fidelity F = |A| / max(|B - A|, t rms(B - A))                                                (2)
    chi^2 = sum (B - A)^2 / (n_A^2 + n_B^2)                                                      (3)

A is the reference, B the map. In means, fits and rms, pixels of different size count with their
solid angles, and those that repeat another (columns of a CAR image beyond a full turn) not at all.
(2) with t = 0.7 is the fidelity of ALMA's memo 398 (Pety, Gueth & Guilloteau 2001): the threshold
keeps it from being large by chance. The standard error of g and o is that of a jackknife: the fit
is repeated without each of `BLOCKS`^2 parts of the field, so that neighbouring pixels need not be
independent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from zonda.core.maps.apertures import COMPLETE, Aperture
from zonda.core.maps.grid import ImagePixels, MapGrid, image_grid
from zonda.core.numerics.sphere import angles, beam_area
from zonda.core.types import Bools, Floats

from .planes import Plane, cell_of, common, on_a_plane
from .radial import Profiles, RadialSpectra, profiles, radial_spectra, ring_edges, tapered

BLOCKS = 6
"""Parts of the field along each side that the jackknife leaves out in turn."""
THRESHOLD = 0.7
"""t of equation (2)."""
EVEN = 1e-3
"""Relative difference of solid angles of pixels that count as equal."""
UNEVEN = 0.1
"""Relative difference of solid angles that the notes tell of."""
ZENITHAL = ("TAN", "SIN", "ARC", "STG", "ZEA", "ZPN", "NCP")
"""Projections about a point, which is the middle of a map that holds it."""


@dataclass(frozen=True)
class Comparison:
    """Two maps on one grid and with one beam.

    Attributes
    ----------
    names
        Of the reference and of the map.
    planes
        (ny, nx) each: ``reference``, ``map``, ``difference`` (map - reference), ``fidelity``;
        ``snr`` of the map where its noise is known, and ``reference_snr``.
    header
        Celestial WCS of all of them.
    unit, fwhm, pixel
        Of the values; resolution, and side of a pixel, rad. ``fwhm`` 0: not known.
    values
        By name, see `values_of`.
    spectra, profiles
        Of ``reference``, ``map`` and ``difference``.
    notes
        How the maps were brought together.
    centre
        (longitude, latitude) [rad] of the profiles' centre, in the frame of the map.
    label
        Of the step that made it.
    noise
        Of ``snr`` and ``reference_snr``: what stands behind the noise, in words, and the measured
        factor on it (None: there is no map of the noise alone).
    """

    names: tuple[str, str]
    planes: dict[str, Floats]
    header: dict[str, Any]
    unit: str
    fwhm: float
    pixel: float
    values: dict[str, float]
    spectra: RadialSpectra
    profiles: Profiles
    notes: list[str]
    centre: tuple[float, float]
    label: str = "compare"
    noise: dict[str, tuple[str, float | None]] = field(default_factory=dict)


def compare(
    reference: Plane,
    other: Plane,
    fwhm: float | None = None,
    threshold: float = THRESHOLD,
    bins: int = 24,
    label: str = "compare",
    apertures: Sequence[float] = (),
) -> Comparison:
    """Compare a map with a reference. Raises InputError for maps that cannot be compared
    (`planes.common`).

    Parameters
    ----------
    fwhm
        Common resolution, rad; None: the wider of the two.
    threshold
        t of equation (2).
    bins
        Number of rings.
    apertures
        Radii [rad] about the centre within which both are integrated: ``reference within RADIUS``
        and ``map within RADIUS`` of the values, in the unit times sr; NaN where less than
        `COMPLETE` of the circle has values.
    """
    a, b, notes = common(reference, other, fwhm)
    centre = _centre(a)
    names = (reference.name, other.name)
    a, b = _cropped(a, b)
    grid = a.grid
    both = np.isfinite(a.values) & np.isfinite(b.values)
    planes = {
        "reference": np.where(both, a.values, np.nan),
        "map": np.where(both, b.values, np.nan),
    }
    difference = planes["difference"] = planes["map"] - planes["reference"]
    areas, weights = _weights(grid, both)
    floor = threshold * rms(difference, weights)
    with np.errstate(invalid="ignore", divide="ignore"):
        planes["fidelity"] = np.abs(planes["reference"]) / np.maximum(np.abs(difference), floor)
        noise = {}
        for name, plane, of in (("snr", b, "map"), ("reference_snr", a, "reference")):
            if plane.noise is not None and np.isfinite(plane.noise[both]).any():
                planes[name] = np.where(
                    both & (plane.noise > 0),
                    plane.values / plane.noise,
                    np.nan,
                )
                noise[name] = plane.noise_in_words, plane.factor
                notes.append(f"noise of the {of}: {plane.noise_in_words}")
    pixel = a.pixel
    width = max(a.fwhm or 0.0, b.fwhm or 0.0)
    maps = {name: planes[name] for name in ("reference", "map", "difference")}
    found = profiles(maps, grid.distance(centre), areas, max(pixel, width / 2), beam_area(width))
    noisy = [plane for plane in (a, b) if plane.noise is not None and not plane.quiet]
    values = values_of(
        planes["reference"],
        planes["map"],
        [plane.noise for plane in noisy],
        weights,
        _places(a, centre),
    )
    for radius in apertures:
        shares, missing = Aperture(radius).weights(grid, centre, both)
        for name in ("reference", "map"):
            flux = float((shares[both] * planes[name][both]).sum())
            values[f"{name} within {radius!r}"] = flux if missing <= 1 - COMPLETE else math.nan
    values["pixels"] = float(np.count_nonzero(both & (weights > 0)))
    values["median fidelity where the reference is above 10 % of its peak"] = _median_fidelity(
        planes
    )
    if "chi2" in values:
        values["chi2 values"] = min(
            values["chi2 pixels"], *(plane.independent(both) for plane in noisy)
        )
    header = a.header
    if a.pixels is not None:
        header, planes = on_a_plane(a.pixels, planes)
        maps = {name: planes[name] for name in maps}
    flat = image_grid(header, planes["map"].shape)
    cell = cell_of(flat)
    known = np.isfinite(planes["map"])
    spectra = radial_spectra(maps, tapered(known, cell), cell, ring_edges(known.shape, cell, bins))
    areas = np.broadcast_to(flat.areas, flat.shape)[known & np.isfinite(flat.areas)]
    if areas.size and areas.max() > (1 + UNEVEN) * areas.min():
        notes.append(
            "solid angles of the pixels: they differ by a factor of"
            f" {areas.max() / areas.min():.3g}; scales of spectra are the middle's"
        )
    about = header, a.unit, width, pixel
    return Comparison(names, planes, *about, values, spectra, found, notes, centre, label, noise)


def _cropped(a: Plane, b: Plane) -> tuple[Plane, Plane]:
    """The part of both in which both have values."""
    both = np.isfinite(a.values) & np.isfinite(b.values)
    part: Any = both
    if a.pixels is not None:
        where: Any = {"pixels": replace(a.pixels, pixels=a.pixels.pixels[both])}
    else:
        rows, columns = (np.flatnonzero(both.any(axis=axis)) for axis in (1, 0))
        part = tuple(slice(int(n[0]), int(n[-1]) + 1) for n in (rows, columns))
        cards = a.header.items()
        header = {k: v for k, v in cards if k and isinstance(v, bool | int | float | str)}
        for key, cut in (("CRPIX1", part[1]), ("CRPIX2", part[0])):
            header[key] = float(header.get(key, 0.0)) - cut.start
        where = {"header": header}
    first, second = (
        replace(
            plane,
            values=plane.values[part],
            noise=None if plane.noise is None else plane.noise[part],
            alone=None,
            **where,
        )
        for plane in (a, b)
    )
    return first, second


def _weights(grid: MapGrid, known: Bools) -> tuple[Floats, Floats]:
    """Solid angles of the pixels [sr], 0 for those that repeat another; and what pixels count:
    equal ones 1 each.
    """
    areas = np.broadcast_to(np.nan_to_num(np.where(grid.once, grid.areas, 0.0)), known.shape)
    used = areas[known & (areas > 0)]
    if used.size and used.max() < (1 + EVEN) * used.min():
        return areas, (areas > 0).astype(np.float64)
    return areas, areas


def _places(plane: Plane, centre: tuple[float, float]) -> tuple[Floats, Floats]:
    """Places of the pixels, up and across: numbers of rows and columns; of HEALPix offsets in
    latitude and longitude.
    """
    if plane.pixels is None:
        row, column = np.indices(plane.values.shape, np.float64)
        return np.asarray(row), np.asarray(column)
    longitude, latitude = angles(plane.pixels.directions())
    around = np.mod(longitude - centre[0] + np.pi, 2 * np.pi) - np.pi
    return np.asarray(latitude - centre[1]), np.asarray(around)


def rms(values: Floats, weights: Floats | None = None) -> float:
    """Root mean square of what is known; NaN where nothing is."""
    w = np.ones(values.shape) if weights is None else weights
    known = np.isfinite(values) & (w > 0)
    if not known.any():
        return math.nan
    return float(np.sqrt(np.average(values[known] ** 2, weights=w[known])))


def _median_fidelity(planes: Mapping[str, Floats]) -> float:
    size = np.abs(planes["reference"])
    bright = size > 0.1 * np.nanmax(size)
    return float(np.median(planes["fidelity"][bright])) if bright.any() else math.nan


def _centre(plane: Plane) -> tuple[float, float]:
    """(longitude, latitude) [rad], in the frame of the grid, of the reference point of the
    projection where it is in the image, else of its middle; of HEALPix of the mean of the
    pixels."""
    grid = plane.grid
    if not isinstance(grid, ImagePixels):
        longitude, latitude = angles(grid.directions()[np.isfinite(plane.values)].mean(axis=0))
        return float(longitude), float(latitude)
    ny, nx = grid.shape
    x, y = (float(plane.header.get(key, 0.0)) - 1 for key in ("CRPIX1", "CRPIX2"))
    if not (grid.kind in ZENITHAL and 0 <= x < nx and 0 <= y < ny):
        x = (nx - 1) / 2
        y = (ny - 1) / 2
    middle = grid.at(x, y)
    if not np.isfinite(middle).all():  # a corner of the projection that is not on the sky
        middle = np.nanmean(grid.directions()[np.isfinite(plane.values)], axis=0)
    longitude, latitude = angles(middle)
    return float(longitude), float(latitude)


def values_of(
    a: Floats,
    b: Floats,
    noise: Sequence[Floats | None] = (None, None),
    weights: Floats | None = None,
    places: tuple[Floats, Floats] | None = None,
) -> dict[str, float]:
    """Figures of a map b against a reference a, both of one shape, NaN where either has no value.

    ``rms reference``, ``rms map``, ``rms difference`` and ``mean ...`` (about zero, over pixels
    with both); ``correlation`` (Pearson); ``gain``, ``offset`` and their errors, equation (1);
    ``peak ratio``: b over a where \\|a\\| is largest; ``chi2`` and its number of pixels, equation
    (3), where a noise is known.

    ``weights``: of the pixels, 0 for those that repeat another; default 1. ``places``: where they
    are (row, column), for the parts of the jackknife; default those of an image.
    """
    weight = np.ones(a.shape) if weights is None else weights
    both = np.isfinite(a) & np.isfinite(b) & (weight > 0)
    x = a[both]
    y = b[both]
    w = weight[both] / weight[both].sum()
    found: dict[str, float] = {}
    for name, values in (("reference", x), ("map", y), ("difference", y - x)):
        found[f"mean {name}"], found[f"rms {name}"] = float((w * values).sum()), rms(values, w)
    u = x - found["mean reference"]
    v = y - found["mean map"]
    scatter = rms(u, w) * rms(v, w)
    found["correlation"] = float((w * u * v).sum() / scatter) if scatter > 0 else math.nan
    where: Any = np.indices(a.shape, np.float64) if places is None else places
    fit, error = _line(x, y, w, [place[both] for place in where])
    found |= {"gain": fit[0], "gain error": error[0], "offset": fit[1], "offset error": error[1]}
    peak = int(np.abs(x).argmax())
    found["peak reference"] = float(x[peak])
    found["peak ratio"] = float(y[peak] / x[peak]) if x[peak] else math.nan
    squares = [n[both] ** 2 for n in noise if n is not None]
    if squares:
        variance = np.sum(squares, axis=0)
        used = np.isfinite(variance) & (variance > 0)
        found["chi2"] = float(((y - x)[used] ** 2 / variance[used]).sum())
        found["chi2 pixels"] = float(np.count_nonzero(used))
    return found


def _line(x: Floats, y: Floats, w: Floats, places: Sequence[Floats]) -> tuple[Any, Any]:
    """(gain, offset) and their standard errors, of values with weights at places (up, across)."""
    x0 = float((w * x).sum() / w.sum())
    up, across = (
        np.minimum((p - p.min()) / (np.ptp(p) * (1 + 1e-9) + 1e-300) * BLOCKS, BLOCKS - 1)
        for p in places
    )
    part = up.astype(np.int64) * BLOCKS + across.astype(np.int64)
    terms = (w, w * (x - x0), w * y, w * (x - x0) ** 2, w * (x - x0) * y)
    sums = np.array([np.bincount(part, t, BLOCKS**2) for t in terms])
    whole = sums.sum(axis=1)
    used = np.flatnonzero(sums[0])
    fits = np.array([_solved(whole), *(_solved(whole - sums[:, k]) for k in used)])
    fits[:, 1] -= fits[:, 0] * x0
    n = len(used)
    scatter = ((fits[1:] - fits[1:].mean(axis=0)) ** 2).sum(axis=0)
    error = np.sqrt((n - 1) / n * scatter) if n > 2 else np.full(2, math.nan)
    return fits[0].tolist(), error.tolist()


def _solved(sums: Floats) -> tuple[float, float]:
    """Slope, and value at x0, from n, sum x, sum y, sum x^2, sum x y, x counted from x0."""
    n, sx, sy, sxx, sxy = map(float, sums)
    variance = n * sxx - sx**2
    if not variance > 1e-12 * n * sxx:
        return math.nan, math.nan
    gain = (n * sxy - sx * sy) / variance
    return gain, (sy - gain * sx) / n
