"""Radial power spectra of maps, beside the level of white noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import maps_of, noise_sources
from zonda.core.numerics.angles import FWHM_PER_SIGMA
from zonda.core.output import Output
from zonda.core.types import Floats

from .comparison.radial import RadialSpectra, radial_spectra, ring_edges
from .series import check_map, key_of, kinds_of_maps, publish
from .stokes_spectra import on_the_plane, sphere_spectra
from .transfer_function import window_of

USABLE = frozenset({"TAN", "HEALPix"})
"""Kinds of maps of which there is a spectrum."""
SEVERAL_HEALPIX = "spectra of HEALPix maps are of one map at a time"
NO_MAP, CURE = (
    "there is no TAN or HEALPix map of the signal",
    "leave projection and contents of the map out",
)

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

    requires: ClassVar[frozenset[str]] = frozenset({"map"})
    provides: ClassVar[frozenset[str]] = frozenset({"map_spectra"})
    one_band: ClassVar[bool] = True

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
                SEVERAL_HEALPIX, place=self.label, cure="name one map in each MapSpectrum"
            )
        if bad := [name for name, kind in zip(self.maps, kinds, strict=True) if kind not in USABLE]:
            raise PipelineError(f"there is no TAN map {bad[0]!r}", place=self.label, cure=CURE)
        if not self.maps and made and not set(made.values()) & USABLE:
            raise PipelineError(NO_MAP, place=self.label, cure=CURE)
        return []

    def finalize(self, data: Data) -> None:
        """Raises PipelineError where there is no map, or none of which there is a spectrum."""
        found = map_spectra(
            data.products, Wanted(self.maps, self.bins, self.least_coverage, self.taper), self.label
        )
        publish(data, key_of(self, "map_spectra"), found, {"": found.spectra.columns("K")})


@dataclass(frozen=True)
class Wanted:
    """Requested spectra: names of maps (empty: the map and what holds noise alone), rings, least
    coverage, taper [rad].
    """

    maps: list[str]
    bins: int
    least: float
    taper: float | None


def map_spectra(products: Mapping[str, Any], wanted: Wanted, place: str) -> MapSpectra:
    """Spectra of maps among the products of a run. Raises PipelineError about ``place``."""
    whole = {
        name: product
        for name, product in maps_of(products, split=False).items()
        if product.contents == "all"
    }
    flat = {name: product for name, product in whole.items() if product.projection == "TAN"}
    flat |= {name: product for name, product in maps_of(flat).items() if name not in whole}
    usable = [name for name in whole if "/" not in name and whole[name].projection in USABLE]
    names = wanted.maps or usable[:1]
    if len(names) == 1 and names[0] in whole and whole[names[0]].projection == "HEALPix":
        product = whole[names[0]]
        found = sphere_spectra(names[0], product, wanted.bins, wanted.least, place)
        return MapSpectra(found, {name: name for name in found.power}, product.fwhm)
    if len(names) > 1 and any(
        name in whole and whole[name].projection == "HEALPix" for name in names
    ):
        raise PipelineError(SEVERAL_HEALPIX, place=place, cure="name one map in each MapSpectrum")
    if missing := [name for name in names if name not in flat]:
        cure = f"name some of these: {', '.join(flat)}" if flat else CURE
        raise PipelineError(f"there is no TAN map {missing[0]!r}", place=place, cure=cure)
    if not names:
        raise PipelineError(NO_MAP, place=place, cure=CURE)
    return _of_planes(flat, names, wanted, place)


def _of_planes(
    flat: Mapping[str, MapProduct], names: list[str], wanted: Wanted, place: str
) -> MapSpectra:
    """Spectra of TAN maps, of polarized ones those of I, E and B."""
    first = flat[names[0]]
    planes: dict[str, Floats] = {}
    noise: dict[str, Floats] = {}
    polarized: dict[str, tuple[str, str]] = {}

    def add(name: str, product: MapProduct, plane: str = "signal") -> None:
        planes[name] = getattr(product, plane)
        if product.polarization is not None:
            polarized[name] = f"{name}_Q", f"{name}_U"
            q_and_u = np.stack([getattr(product.stokes(which), plane) for which in "QU"])
            planes.update(zip(polarized[name], on_the_plane(product, q_and_u), strict=True))

    def add_noise(name: str, product: MapProduct) -> None:
        own = [product] if name not in polarized else list(product.by_stokes().values())
        noise.update(
            zip((name, *polarized.get(name, ())), (each.noise for each in own), strict=True)
        )

    for name in names:
        add(name, flat[name])
        if not name.startswith("noiseless/"):
            add_noise(name, flat[name])
    if not wanted.maps:
        for of, (product, plane) in noise_sources(flat, names[0]).items():
            name = "half_difference" if of == "half_difference" else f"source_free/{names[0]}"
            add(name, product, plane)
            if plane == "signal":
                add_noise(name, product)
    if any(values.shape != first.signal.shape for values in planes.values()):
        raise PipelineError(
            "the maps have different grids", place=place, cure="name maps of one step"
        )
    window = window_of(first, None, wanted.taper, wanted.least)
    known = {name: np.where(window > 0, values, np.nan) for name, values in noise.items()}
    sigma = first.smoothed_by / FWHM_PER_SIGMA
    white = {
        name: np.nan_to_num(values) for name, values in known.items() if np.isfinite(values).any()
    }
    edges = ring_edges(first.signal.shape, first.pixel, wanted.bins)
    spectra = radial_spectra(planes, window, first.pixel, edges, white, sigma, polarized)
    words = {
        f"half_difference{end}": f"half the difference{more}, {first.difference}"
        for end, more in HALVES.items()
    }
    return MapSpectra(spectra, {name: words.get(name, name) for name in spectra.power}, first.fwhm)
