"""Radial power spectra of maps, beside the level of white noise; Q and U on the axes of the plane.

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
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import maps_of, noise_sources
from zonda.core.numerics.projection import frame_rotation, pixel_matrix
from zonda.core.numerics.sphere import FWHM_PER_SIGMA, local_axes
from zonda.core.output import Output, publish
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import Floats

from .comparison.radial import RadialSpectra, radial_spectra, ring_edges
from .series import check_map, key_of, kinds_of_maps
from .transfer_function import window_of

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
        q_and_u,
        between_meridians(directions, frame_rotation(product.frame)[2], north),
    )


def sphere_spectra(
    name: str,
    product: MapProduct,
    bins: int,
    least: float,
    place: str,
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
    edges = np.geomspace(lowest, largest, bins + 1)
    multipole = np.arange(largest + 1)
    ring = np.digitize(multipole, edges) - 1
    weight = 2.0 * multipole + 1
    ring[(ring < 0) | (ring >= bins)] = bins
    count = np.bincount(ring, weight, bins + 1)[:bins]

    def mean_of(values: Floats) -> Floats:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.bincount(ring, weight * values, bins + 1)[:bins] / count

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

    whole = np.zeros(healpy.nside2npix(plane.nside))
    values = np.where(window > 0, plane.signal, 0.0)
    whole[plane.pixels] = window * (values - (window * values).sum() / window.sum() * mean)
    return np.asarray(healpy.reorder(whole, n2r=True) if plane.nest else whole)


def _white(
    names: list[str],
    planes: list[MapProduct],
    window: Floats,
    area: float,
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


USABLE = frozenset({"TAN", "HEALPix"})
"""Kinds of maps of which there is a spectrum."""
SEVERAL_HEALPIX = "spectra of HEALPix maps are of one map at a time"
NO_MAP = "there is no TAN or HEALPix map of the signal"
CURE = "leave projection and contents of the map out"

HALVES = {"": "", "_E": " (E)", "_B": " (B)"}
"""How the spectra of the half-difference are called."""


@dataclass(frozen=True)
class MapSpectra:
    """Radial spectra of maps of one run.

    Attributes
    ----------
    spectra
        Of each map by its name among the products; ``half_difference`` of the first.
    names
        As pictures call them.
    fwhm
        The beam's, rad.
    """

    spectra: RadialSpectra
    names: dict[str, str]
    fwhm: float


class MapSpectrum(Output):
    """Radial power spectra of maps, with the level of white noise: what is left of 1/f noise at
    each angular scale.

    Of the map and of what holds noise alone (half the difference of two halves of the samples, the
    source-free map), or of the `maps` that are named. Makes the product ``map_spectra`` (a
    `MapSpectra`), or one under this step's own name where it has one; where there is an output
    folder, it is written there as a table (ECSV).

    Of maps of I, Q and U the spectra are those of I (``map``), E and B (``map_E``, ``map_B``), with
    the cross spectra ``map_TE``, ``map_TB`` and ``map_EB``, in COSMO's convention; name ``map_Q``
    for that of Q. Spectra of a HEALPix map are those of its spherical harmonics (healpy), of one
    map at a time.
    """

    requires = frozenset({"map"})
    provides = frozenset({"map_spectra"})
    one_band = True

    maps: list[str] = Field([], max_length=7)
    """Names of products, e.g. [map, source_free/map]. Default: the map and what holds noise alone.
    """
    bins: int = Field(24, ge=2, le=500)
    """Number of rings, of equal width in the logarithm of the scale."""
    least_coverage: float = Field(0.1, ge=0, lt=1)
    """Where the (beam-smoothed) samples per pixel are below this share of their 99th percentile,
    the window is zero.
    """
    taper: Angle | None = Field(None, gt=0)
    """Width of the window's cosine edge; where absent, it reaches to the middle."""

    def check(self, data: Data) -> list[str]:
        """Raises PipelineError where the maps that will be made are none of which there is a
        spectrum.
        """
        for name in self.maps:
            check_map(data, name, self.label)
        made = kinds_of_maps(data)
        kinds = [made.get(name.rpartition("/")[2], "TAN") for name in self.maps]
        if len(kinds) > 1 and "HEALPix" in kinds:
            raise PipelineError(
                SEVERAL_HEALPIX,
                place=self.label,
                cure="name one map in each MapSpectrum",
            )
        if bad := [name for name, kind in zip(self.maps, kinds, strict=True) if kind not in USABLE]:
            raise PipelineError(f"there is no TAN map {bad[0]!r}", place=self.label, cure=CURE)
        if not self.maps and made and not set(made.values()) & USABLE:
            raise PipelineError(NO_MAP, place=self.label, cure=CURE)
        return []

    def finalize(self, data: Data) -> None:
        """Raises PipelineError where there is no map, or none of which there is a spectrum."""
        found = self.spectra(data.products)
        publish(data, key_of(self, "map_spectra"), found, {"": found.spectra.columns("K")})

    def spectra(self, products: Mapping[str, Any]) -> MapSpectra:
        """Spectra of maps among the products of a run. Raises PipelineError."""
        every = maps_of(products, split=False).items()
        whole = {name: product for name, product in every if product.contents == "all"}
        flat = {name: product for name, product in whole.items() if product.projection == "TAN"}
        flat |= {name: product for name, product in maps_of(flat).items() if name not in whole}
        usable = [name for name in whole if "/" not in name and whole[name].projection in USABLE]
        names = self.maps or usable[:1]
        spheres = [n for n in names if n in whole and whole[n].projection == "HEALPix"]
        if spheres and len(names) > 1:
            cure = "name one map in each MapSpectrum"
            raise PipelineError(SEVERAL_HEALPIX, place=self.label, cure=cure)
        if spheres:
            product = whole[names[0]]
            sphere = sphere_spectra(names[0], product, self.bins, self.least_coverage, self.label)
            return MapSpectra(sphere, {name: name for name in sphere.power}, product.fwhm)
        if missing := [name for name in names if name not in flat]:
            cure = f"name some of these: {', '.join(flat)}" if flat else CURE
            raise PipelineError(f"there is no TAN map {missing[0]!r}", place=self.label, cure=cure)
        if not names:
            raise PipelineError(NO_MAP, place=self.label, cure=CURE)
        return self._of_planes(flat, names)

    def _of_planes(self, flat: Mapping[str, MapProduct], names: list[str]) -> MapSpectra:
        """Spectra of TAN maps, of polarized ones those of I, E and B."""
        first = flat[names[0]]
        planes: dict[str, Floats] = {}
        noise: dict[str, Floats] = {}
        polarized: dict[str, tuple[str, str]] = {}
        shown: list[Any] = [(name, flat[name], "signal") for name in names]
        if not self.maps:
            for of, (product, plane) in noise_sources(flat, names[0]).items():
                half = of == "half_difference"
                shown.append((of if half else f"source_free/{names[0]}", product, plane))
        for name, product, plane in shown:
            planes[name], parts = getattr(product, plane), [product]
            if product.polarization is not None:
                parts = list(product.by_stokes().values())
                polarized[name] = f"{name}_Q", f"{name}_U"
                q_and_u = np.stack([getattr(part, plane) for part in parts[1:]])
                planes.update(zip(polarized[name], on_the_plane(product, q_and_u), strict=True))
            if plane == "signal" and not name.startswith("noiseless/"):
                own = (name, *polarized.get(name, ()))
                noise.update(zip(own, (part.noise for part in parts), strict=True))
        if any(values.shape != first.signal.shape for values in planes.values()):
            cure = "name maps of one step"
            raise PipelineError("the maps have different grids", place=self.label, cure=cure)
        window = window_of(first, None, self.taper, self.least_coverage)
        known = {name: np.where(window > 0, values, np.nan) for name, values in noise.items()}
        white = {name: np.nan_to_num(v) for name, v in known.items() if np.isfinite(v).any()}
        sigma = first.smoothed_by / FWHM_PER_SIGMA
        edges = ring_edges(first.signal.shape, first.pixel, self.bins)
        spectra = radial_spectra(planes, window, first.pixel, edges, white, sigma, polarized)
        words = {
            f"half_difference{end}": f"half the difference{more}, {first.difference}"
            for end, more in HALVES.items()
        }
        called = {name: words.get(name, name) for name in spectra.power}
        return MapSpectra(spectra, called, first.fwhm)
