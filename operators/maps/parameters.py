"""The parameters of `BinMap`, and the two halves of the samples whose difference is a map of noise
(a jackknife).
"""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle
from zonda.core.mapmaker import MapMaker
from zonda.core.observation import Observation

Split = Literal["scans", "detectors", "halves", "directions", "radii"]

DIFFERENCES: dict[Split, str] = {
    "scans": "even - odd scans",
    "detectors": "even - odd detectors",
    "halves": "first - second half of each scan",
    "directions": "rising - falling azimuth",
    "radii": "inner - outer detectors",
}
"""Halves of the samples, of which the second is subtracted from the first."""

Mask = NDArray[np.bool_]


def halves_of(split: Split, observation: Observation) -> list[tuple[Mask, Mask]]:
    """(detectors (n_det,), samples (n_samp,)) of either half of an observation; of `scans` one
    part, which is all of it.

    Detectors are counted as in the focal plane, azimuth is that of the boresight. `radii`: the half
    of the detectors nearest to the middle of the focal plane, and the rest; detectors at one radius
    are counted as in the focal plane.
    """
    detectors, samples = (
        np.ones(observation.n_detectors, np.bool_),
        np.ones(observation.n_samples, np.bool_),
    )
    if split == "scans":
        return [(detectors, samples)]
    if split == "detectors":
        even = np.arange(detectors.size) % 2 == 0
        return [(even, samples), (~even, samples)]
    if split == "radii":
        order = np.argsort(
            np.hypot(observation.focalplane.xi, observation.focalplane.eta),
            kind="stable",
        )
        inner = np.zeros_like(detectors)
        inner[order[: (order.size + 1) // 2]] = True
        return [(inner, samples), (~inner, samples)]
    first = np.arange(samples.size) < samples.size / 2
    if split == "directions" and samples.size > 1:
        first = np.gradient(np.unwrap(observation.azimuth)) > 0
    return [(detectors, first), (detectors, ~first)]


WIDEST_SMOOTH = 0.1
"""FWHM of a map's smoothing, rad."""


class MapParameters(MapMaker):
    """Pixels, weights, noise and planes of a map."""

    largest_pixel: ClassVar[tuple[float, str]] = 1.0, "sources are averaged away"
    """Largest pixel without a warning, in beams, and what larger ones do."""

    pixel: Angle = quantity("2 arcsec", gt=0)
    """Side of a pixel."""
    width: Angle | None = Field(None, gt=0, examples=["10 arcmin"])
    """Width of the map; where absent, it covers the scans."""
    height: Angle | None = Field(None, gt=0, examples=["10 arcmin"])
    """Height of the map; where absent, the width if that is given, else it covers the scans."""
    centre: Target | None = None
    """Centre of the map; where absent, the scans' target; of several targets the middle of all
    scans.
    """
    projection: Literal["TAN", "CAR"] = "TAN"
    """Projection of the image: TAN (tangent plane), or CAR (plate carrée), whose pixels are those
    of pixell's full-sky maps. Width and height are those on the sky at the centre."""
    frame: Literal["icrs", "galactic"] = "icrs"
    """Celestial frame of the map."""
    nside: int | None = Field(None, ge=1, le=2**20)
    """Make a HEALPix map of this resolution (a power of two) instead of an image."""
    ordering: Literal["ring", "nested"] = "ring"
    """HEALPix pixel order."""
    weights: Literal["uniform", "inverse_variance"] = "inverse_variance"
    """Equal weights, or weights by the inverse variance that follows from each detector's NET."""
    noise: Literal["net", "scatter"] = "net"
    """Noise of each pixel: from the detectors' NET, or from the scatter of its samples. From the
    NET also where the scene has no white noise; the log then says so."""
    stokes: Literal["I", "IQU"] = "I"
    """`IQU`: solve for I, Q and U in each pixel (polarized detectors are needed). Q and U are
    COSMO's, from the meridians of `frame`."""
    condition_limit: float = Field(1000.0, ge=2.0, le=1e7)
    """Of I, Q and U: pixels in which the condition number of the samples' angles is larger are NaN,
    and counted. It is 2 at best, where polarizers are perfect."""
    contents: Literal["all", "hits"] = "all"
    """`hits`: count the samples in each pixel, no more; a plan then simulates no signal at all."""
    half_difference: bool | Split = True
    """Keep two halves of the samples apart and make a noise map of their difference: even and odd
    scans (`scans` or true; needs two), even and odd detectors, the first and the second half of
    each scan, samples of rising and of falling azimuth, or inner and outer detectors (`radii`)."""
    crosslinking: bool = False
    """Keep the directions in which detectors moved through each pixel: 0 where they crossed evenly,
    1 where all moved along one line."""
    visits: bool = False
    """Count the scans that have samples in each pixel."""
    scan_hits: bool = False
    """Keep the hits of each scan in each pixel."""
    smooth: Angle | Literal["beam"] | None = Field(None, examples=["9 arcsec"])
    """Smooth the map with a Gaussian of this FWHM, or with the instrument's beam; the resolution is
    then that of both, added in quadrature."""
    product: str = Field("map", pattern=r"^[A-Za-z0-9_]+$")
    """Name of the map among the products."""

    @property
    def kind(self) -> str:
        """Its projection, HEALPix, or hits."""
        return "hits" if self.contents == "hits" else "HEALPix" if self.nside else self.projection

    @property
    def split(self) -> Split:
        """The halves that are kept apart."""
        return (
            "scans"
            if isinstance(self.half_difference, bool) or self.contents == "hits"
            else self.half_difference
        )

    @field_validator("nside")
    @classmethod
    def _power_of_two(cls, value: int | None) -> int | None:
        if value is not None and value & (value - 1):
            raise ValueError(f"nside must be a power of two, got {value}")
        return value

    @field_validator("centre")
    @classmethod
    def _on_the_sky(cls, value: Target | None) -> Target | None:
        if value is not None and value.frame == "horizontal":
            raise ValueError(
                "the centre of a map must be fixed on the sky; give ICRS or galactic coordinates"
            )
        return value

    @field_validator("smooth")
    @classmethod
    def _positive(cls, value: float | str | None) -> float | str | None:
        if isinstance(value, float) and value <= 0:
            raise ValueError("smooth must be positive; leave it out for no smoothing")
        if isinstance(value, float) and value > WIDEST_SMOOTH:
            raise ValueError(
                f"smooth must be at most {WIDEST_SMOOTH:g} rad (5.7 deg): the kernel would be wider"
                " than any map"
            )
        return value

    @model_validator(mode="after")
    def _polarized(self) -> MapParameters:
        if self.stokes == "I":
            if "condition_limit" in self.model_fields_set:
                raise ValueError("condition_limit belongs to stokes: IQU")
            return self
        if self.noise == "scatter":
            raise ValueError(
                "noise: scatter is for maps of I; with stokes: IQU noise follows from the NET"
            )
        if self.contents == "hits":
            raise ValueError("contents: hits needs no stokes: IQU; leave that out")
        if self.half_difference == "detectors":
            cure = "set half_difference to scans, halves, directions or radii"
            raise ValueError(
                "even and odd detectors of pairs see one polarization each, which determines no I,"
                f" Q and U; {cure}"
            )
        return self

    @model_validator(mode="after")
    def _one_grid(self) -> MapParameters:
        image_only = {"pixel", "width", "height", "centre", "projection"} & self.model_fields_set
        if self.nside is not None and image_only:
            raise ValueError(
                f"{sorted(image_only)[0]} belongs to an image, nside to a HEALPix map; give one of"
                " them"
            )
        if (
            self.projection == "CAR"
            and abs(self.pixel * (n := round(math.pi / self.pixel)) / math.pi - 1) > 1e-9
        ):
            cure = f"{math.degrees(math.pi / n) * 3600:.9g} arcsec"
            raise ValueError(
                "in a CAR map 180 deg must be a whole number of pixels; the nearest that fits is"
                f" {cure}"
            )
        if self.nside is None and "ordering" in self.model_fields_set:
            raise ValueError("ordering belongs to a HEALPix map; give nside too")
        return self
