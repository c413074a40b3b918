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
from zonda.core.numerics.angles import ARCSEC, FWHM_PER_SIGMA
from zonda.core.numerics.transforms import gaussian_taps
from zonda.core.output import Output
from zonda.core.storage.ecsv import Column, write_ecsv
from zonda.core.storage.files import product_path
from zonda.core.types import Floats

from .comparison.radial import RadialSpectra, radial_spectra, ring_edges
from .series import about, key_of
from .transfer_function import window_of


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

    def columns(self) -> list[Column]:
        """The table, largest scale first."""
        s, plain = self.spectra, {name: name.replace("/", "_") for name in self.spectra.power}
        return [
            Column("scale", s.scale / ARCSEC, "arcsec", "1 / mean wavenumber of the ring"),
            Column("wavenumber", 1 / s.scale, "rad-1", "mean over the ring's modes"),
            *(Column(plain[n], p, "K2 sr", "power spectral density") for n, p in s.power.items()),
            *(Column(f"{plain[n]}_white", p, "K2 sr", "of independent pixels with the map's noise") for n, p in s.white.items()),
            Column("modes", s.modes, "", "independent modes; relative standard error of the power: modes^-1/2"),
        ]


class MapSpectrum(Output):
    """Radial power spectra of maps, with the level of white noise: what is left of 1/f noise at each angular scale.

    Of the map and of what holds noise alone (half the difference of two halves of the samples, the source-free map), or of the
    `maps` that are named. Makes the product ``map_spectra`` (a `MapSpectra`), or one under this step's own name where it has
    one; where there is an output folder, it is written there as a table (ECSV).
    """

    requires: ClassVar[frozenset[str]] = frozenset({"map"})
    provides: ClassVar[frozenset[str]] = frozenset({"map_spectra"})
    one_band: ClassVar[bool] = True

    maps: list[str] = Field([], max_length=7)
    """Names of products, e.g. [map, source_free/map]. Default: the map and what holds noise alone."""
    bins: int = Field(24, ge=2, le=500)
    """Number of rings, of equal width in the logarithm of the scale."""
    least_coverage: float = Field(0.1, ge=0, lt=1)
    """Where the (beam-smoothed) samples per pixel are below this share of their 99th percentile, the window is zero."""
    taper: Angle | None = Field(None, gt=0)
    """Width of the window's cosine edge; where absent, it reaches to the middle."""

    def finalize(self, data: Data) -> None:
        """Raises PipelineError where there is no TAN map."""
        found = map_spectra(maps_of(data.products), self.maps, self.label, (self.bins, self.least_coverage, self.taper))
        key = key_of(self, "map_spectra")
        data.products[key] = found
        if data.output is not None:
            write_ecsv(product_path(data.output, data.named(key), ".ecsv"), found.columns(), about(data))


def map_spectra(
    maps: Mapping[str, MapProduct], wanted: list[str], place: str, settings: tuple[int, float, float | None]
) -> MapSpectra:
    """Spectra of ``wanted`` maps. ``settings``: rings, least coverage, taper [rad]. Raises PipelineError about ``place``."""
    bins, least, taper = settings
    flat = {name: product for name, product in maps.items() if product.projection == "TAN" and product.contents == "all"}
    if missing := [name for name in wanted if name not in flat]:
        cure = f"name some of these: {', '.join(flat)}" if flat else "leave nside, projection and contents of the map out"
        raise PipelineError(f"there is no TAN map {missing[0]!r}", place=place, cure=cure)
    names = wanted or [name for name in flat if "/" not in name][:1]
    if not names:
        raise PipelineError(
            "there is no TAN map of the signal", place=place, cure="leave nside, projection and contents of the map out"
        )
    first = flat[names[0]]
    planes: dict[str, Floats] = {name: flat[name].signal for name in names}
    noise = {name: flat[name].noise for name in names if not name.startswith("noiseless/")}
    if not wanted:
        for of, (product, plane) in noise_sources(flat, names[0]).items():
            key = "half_difference" if of == "half_difference" else f"source_free/{names[0]}"
            planes[key] = getattr(product, plane)
    if any(values.shape != first.signal.shape for values in planes.values()):
        raise PipelineError("the maps have different grids", place=place, cure="name maps of one step")
    window = window_of(first, None, taper, least)
    known = {name: np.where(window > 0, values, np.nan) for name, values in noise.items() if name == names[0] or wanted}
    sigma = first.smoothed_by / FWHM_PER_SIGMA
    side = gaussian_taps(sigma / first.pixel)
    left = 2 * float(side @ side) - side[0] ** 2  # what smoothing leaves of the noise of independent pixels: (sum K^2)^(1/2)
    white = {name: np.nan_to_num(values) / left for name, values in known.items() if np.isfinite(values).any()}
    edges = ring_edges(first.signal.shape, first.pixel, bins)
    spectra = radial_spectra(planes, window, first.pixel, edges, white, sigma)
    words: dict[str, Any] = {"half_difference": f"half the difference, {first.difference}"}
    return MapSpectra(spectra, {name: str(words.get(name, name)) for name in planes}, first.fwhm)
