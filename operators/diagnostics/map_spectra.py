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
