"""Spectra of maps of I, Q and U: Q and U on the axes of the plane; and power spectra of HEALPix
maps.

A HEALPix map m with the window w has the pseudo power spectrum (Hivon et al. 2002, without their
coupling matrix)

    P(k) = C_l(w m) / mean(w^2),   k = l / 2 pi,   (1)

of I, E and B and their cross spectra, by healpy's `anafast`; the mean of w^2 is that over the
sphere. White noise of standard error n in pixels of area A has A sum w^2 n^2 / sum w^2. A ring has
sum (2 l + 1) mean(w^2)^2 / mean(w^4) / 2 independent modes. The window mixes multipoles that are
nearer than the inverse of its size, and some of E into B there.
"""

from __future__ import annotations

import math

import numpy as np

from zonda.core.errors import PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.projection import frame_rotation, pixel_matrix
from zonda.core.numerics.sphere import local_axes
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import Floats

from .comparison.radial import RadialSpectra

LARGEST_NSIDE = 2048
"""Of a map whose power spectrum is taken: that takes minutes and gigabytes beyond."""
CROSS = {"TE": 3, "EB": 4, "TB": 5}
"""Rows of `anafast`."""


def on_the_plane(product: MapProduct, q_and_u: Floats) -> Floats:
    """(2, ny, nx) Q and U of a TAN map from the meridians of its frame, turned to the axes of its
    plane.
    """
    to_plane = pixel_matrix(product.wcs)
    x, y, z = to_plane[2]
    # 90 deg north of the tangent point
    north = local_axes(float(np.arctan2(y, x)), float(np.arctan2(z, np.hypot(x, y))))[2]
    row, column = np.indices(product.signal.shape, np.float64)
    rays = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(to_plane).T
    directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return turned_by(
        q_and_u, between_meridians(directions, frame_rotation(product.frame)[2], north)
    )


def sphere_spectra(
    name: str, product: MapProduct, bins: int, least: float, place: str
) -> RadialSpectra:
    """Equation (1) of a HEALPix map: of I, and of E and B (``NAME_E``, ``NAME_B``) of a polarized
    one.

    The window is the samples per pixel in units of their 99th percentile, at most 1, and 0 below
    ``least``. Raises PipelineError about ``place`` for a map with too many pixels.
    """
    import healpy

    if product.nside > LARGEST_NSIDE:
        cure = f"set nside of the map to {LARGEST_NSIDE} or less, or make a TAN map"
        raise PipelineError(
            f"the spectrum of a map of nside {product.nside} would take gigabytes",
            place=place,
            cure=cure,
        )
    planes = list(product.by_stokes().values())
    number = healpy.nside2npix(product.nside)
    seen = product.hits[product.known]
    share = product.hits / (float(np.percentile(seen, 99)) if seen.size else 1.0)
    known = np.logical_and.reduce([np.isfinite(plane.signal) for plane in planes])
    window = np.where(known & (share >= least), np.minimum(share, 1.0), 0.0)
    second, fourth = (float((window**power).sum()) / number for power in (2, 4))
    if not second > 0:
        raise PipelineError("no pixel has enough samples", place=place, cure="lower least_coverage")
    maps = [_windowed(plane, window, mean=plane is planes[0]) for plane in planes]
    largest = 2 * product.nside
    found = (
        np.atleast_2d(healpy.anafast(maps if len(maps) > 1 else maps[0], lmax=largest, iter=1))
        / second
    )
    lowest = max(2.0, math.pi / math.sqrt(4 * math.pi * np.count_nonzero(window) / number))
    edges, multipole = np.geomspace(lowest, largest, bins + 1), np.arange(largest + 1)
    ring, weight = np.digitize(multipole, edges) - 1, 2.0 * multipole + 1
    ring[(ring < 0) | (ring >= bins)] = bins
    count = np.bincount(ring, weight, bins + 1)[:bins]

    def mean_of(values: Floats) -> Floats:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.bincount(ring, weight * values, bins + 1)[:bins] / count)

    names = [name, f"{name}_E", f"{name}_B"][: len(planes)]
    white = _white(names, planes, window, 4 * math.pi / number)
    power = {key: mean_of(found[k]) for k, key in enumerate(names)}
    cross = (
        {f"{name}_{both}": mean_of(found[row]) for both, row in CROSS.items()}
        if len(planes) > 1
        else {}
    )
    return RadialSpectra(
        edges / (2 * math.pi),
        mean_of(multipole / (2 * math.pi)),
        power,
        count * second**2 / fourth / 2,
        {key: np.full(bins, level) for key, level in white.items()},
        np.full(bins, math.nan),
        cross,
    )


def _windowed(plane: MapProduct, window: Floats, mean: bool) -> Floats:
    """The plane times the window on the whole sphere, in the order RING; ``mean``: less its
    mean.
    """
    import healpy

    whole, values = (
        np.zeros(healpy.nside2npix(plane.nside)),
        np.where(window > 0, plane.signal, 0.0),
    )
    whole[plane.pixels] = window * (values - (window * values).sum() / window.sum() * mean)
    return np.asarray(healpy.reorder(whole, n2r=True) if plane.nest else whole)


def _white(
    names: list[str], planes: list[MapProduct], window: Floats, area: float
) -> dict[str, float]:
    """Levels of white noise of maps that are not smoothed and whose noise is known; E and B have
    the mean of Q and U.
    """
    if planes[0].smoothed_by or not all(
        np.isfinite(plane.noise[window > 0]).any() for plane in planes
    ):
        return {}
    square = window**2 / (window**2).sum()
    levels = [area * float((square * np.nan_to_num(plane.noise) ** 2).sum()) for plane in planes]
    if len(levels) > 1:
        levels[1:] = [(levels[1] + levels[2]) / 2] * 2
    return dict(zip(names, levels, strict=True))
