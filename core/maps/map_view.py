"""Maps as writers and pictures see them: named planes on one pixelization."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..types import AnyFloats
from .map_product import MapProduct

PLANES = ("signal", "hits", "weights", "noise", "half_difference")
"""Planes a map product may have; `signal` always, but for a map of hits alone."""


@dataclass
class MapView:
    """Planes of one map.

    Attributes
    ----------
    name
        Of the product, e.g. ``noiseless/map``.
    planes
        ``signal``, ``hits`` ...: (ny, nx) each on a WCS grid, (n_pix,) on HEALPix; NaN where nothing is known.
    units
        FITS units by plane; none for counts.
    header
        FITS header with the WCS; None for HEALPix.
    nside, pixels, nest, frame
        HEALPix: resolution, pixel numbers (n_pix,) int64, ordering, astropy frame name.
    fwhm, smoothed
        Resolution of the map, rad, 0 where unknown: the beam's; of a smoothed map that of beam and smoothing, in quadrature.
    centre
        (lon, lat) of the map's centre in ``frame``, rad.
    """

    name: str
    planes: dict[str, AnyFloats]
    units: dict[str, str] = field(default_factory=dict)
    header: Any = None
    nside: int = 0
    pixels: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    nest: bool = False
    frame: str = "icrs"
    fwhm: float = 0.0
    centre: tuple[float, float] = (0.0, 0.0)
    smoothed: bool = False

    @classmethod
    def of(cls, name: str, product: MapProduct) -> MapView:
        """The planes that a product has."""
        has = PLANES if product.contents == "all" else ("hits",)
        planes = {k: np.asarray(getattr(product, k)) for k in has if getattr(product, k) is not None}
        weight = "K-2" if product.weighting == "inverse_variance" else ""
        units = {"signal": "K", "noise": "K", "half_difference": "K", "weights": weight, "hits": ""}
        pixels = product.pixels if product.pixels is not None else np.zeros(0, np.int64)
        return cls(
            name,
            planes,
            {k: units[k] for k in planes},
            product.header,
            product.nside,
            pixels,
            product.nest,
            product.frame,
            math.hypot(product.fwhm, product.smoothed_by),
            product.centre,
            product.smoothed_by > 0,
        )

    @property
    def is_healpix(self) -> bool:
        return self.nside > 0

    @property
    def wcs(self) -> Any:
        """`astropy.wcs.WCS` of the header."""
        from astropy.wcs import WCS

        return WCS(self.header, naxis=2)

    def flat(self, size: int = 400) -> MapView:
        """A HEALPix map on a grid of at most ``size`` x ``size`` points of a plane about its centre, for pictures; any other map
        as it is.

        The plane is the tangent plane, or for maps of more than 60 deg the equal-area one (ZEA); the grid reaches as far as the
        pixels. Each point takes the value of the HEALPix pixel it lies in.
        """
        if not self.is_healpix:
            return self
        import healpy as hp

        wcs, (nx, ny) = self._plane(size)
        x, y = np.meshgrid(np.arange(nx), np.arange(ny))
        world = wcs.pixel_to_world_values(x, y)
        known = np.isfinite(world[0]) & np.isfinite(world[1])
        lon, lat = np.where(known, world, 0.0)
        wanted = np.where(known, hp.ang2pix(self.nside, lon, lat, nest=self.nest, lonlat=True), -1)
        order = np.argsort(self.pixels)
        place = np.clip(np.searchsorted(self.pixels, wanted, sorter=order), 0, len(order) - 1)
        found = order[place]
        there = self.pixels[found] == wanted
        planes = {k: np.where(there, v[found], 0 if k == "hits" else np.nan) for k, v in self.planes.items()}
        return MapView(
            self.name,
            planes,
            self.units,
            wcs.to_header(relax=True),
            frame=self.frame,
            fwhm=self.fwhm,
            centre=self.centre,
            smoothed=self.smoothed,
        )

    def _plane(self, size: int) -> tuple[Any, tuple[int, int]]:
        """A WCS about the centre, and the numbers (nx, ny) of points that take in every pixel."""
        import healpy as hp
        from astropy.wcs import WCS

        lon, lat = np.degrees(self.centre)
        directions = np.array(hp.pix2vec(self.nside, self.pixels, nest=self.nest))
        far = float((hp.ang2vec(lon, lat, lonlat=True) @ directions).min(initial=1.0)) < 0.86
        wcs = WCS(naxis=2)
        axes = ("RA", "DEC") if self.frame == "icrs" else ("GLON", "GLAT")
        wcs.wcs.ctype = [f"{a}{'-' * (8 - len(a) - 3)}{'ZEA' if far else 'TAN'}" for a in axes]
        wcs.wcs.crval = [float(lon), float(lat)]
        wcs.wcs.crpix = [1.0, 1.0]
        wcs.wcs.cdelt = [-1.0, 1.0]
        x, y = wcs.wcs_world2pix(*hp.pix2ang(self.nside, self.pixels, nest=self.nest, lonlat=True), 0)
        spare = np.degrees(hp.nside2resol(self.nside))
        places = np.stack([x, y]) if x.size else np.zeros((2, 1))
        low, high = places.min(axis=1) - spare, places.max(axis=1) + spare
        step = float((high - low).max()) / size
        numbers = np.maximum(1, np.ceil((high - low) / step - 1e-9)).astype(int)
        wcs.wcs.cdelt = [-step, step]
        wcs.wcs.crpix = (1 - (low + high) / 2 / step + (numbers - 1) / 2).tolist()
        return wcs, (int(numbers[0]), int(numbers[1]))


def maps_of(products: Mapping[str, Any]) -> dict[str, MapProduct]:
    """Every map among ``data.products``, by name, the main run's first; not those of runs that a step made for itself (_NAME)."""
    found = (n for n, p in products.items() if isinstance(p, MapProduct) and not n.startswith("_"))
    names = sorted(found, key=lambda n: ("/" in n, n))
    return {name: products[name] for name in names}


@dataclass(frozen=True)
class NoiseFigure:
    """How noisy a map is near its centre.

    ``of``: ``half_difference`` or ``source_free``; ``rms``: in K, NaN where there is no pixel; ``smoothed``: the same after
    smoothing with the beam (NaN where the map cannot be or is already smoothed).
    """

    product: str
    of: Literal["half_difference", "source_free"]
    rms: float
    smoothed: float


def noise_figures(maps: Mapping[str, MapProduct], diameter: float) -> list[NoiseFigure]:
    """Weighted rms about zero within ``diameter`` / 2 [rad] of the centre, of what holds noise alone: `noise_sources`."""
    found = []
    for name in maps:
        for of, (product, plane) in noise_sources(maps, name).items():
            rms = product.rms(diameter / 2, of=plane)
            again = product.header is not None and product.fwhm > 0 and not product.smoothed_by
            smoothed = product.smoothed_rms(product.fwhm, diameter / 2, of=plane) if again else math.nan
            found.append(NoiseFigure(name, of, rms, smoothed))
    return found


def noise_sources(
    maps: Mapping[str, MapProduct], name: str
) -> dict[Literal["half_difference", "source_free"], tuple[MapProduct, Literal["signal", "half_difference"]]]:
    """For a map of the main run: which product's which plane holds noise alone; nothing for companion runs."""
    found: dict[Literal["half_difference", "source_free"], tuple[MapProduct, Literal["signal", "half_difference"]]] = {}
    if "/" in name:
        return found
    if maps[name].half_difference is not None:
        found["half_difference"] = (maps[name], "half_difference")
    free = maps.get(f"source_free/{name}")
    if free is not None and free.signal.shape == maps[name].signal.shape:
        found["source_free"] = (free, "signal")
    return found
