"""Parameters of the map makers, and the two halves of the samples whose difference is a map of
noise (a jackknife).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle, Seconds
from zonda.core.mapmaker import MapMaker
from zonda.core.numerics.projection import boresights
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


SHORTEST, LONGEST, PART = 0.05, 0.2, 0.15
"""Limits of a baseline [s] where none is given; its share of the time in which the focal plane is
crossed."""
INSTANTS = 1000
"""Instants of a scan from which its median speed is found."""


class LikelihoodParameters(MapParameters):
    """Noise model, iteration, and what is taken off."""

    largest_pixel = (
        0.5,
        "what varies within a pixel is taken for noise, and spread over the map (0.4 to 3 % of the"
        " sky's rms at half of the beam, 7 % with modes: 0)",
    )
    baseline: Seconds | None = Field(None, gt=0, examples=["0.2 s"])
    """Length of a baseline: noise is white within it, but for the free modes. Where absent, 0.15
    of the time in which the scan crosses the focal plane, from 0.05 to 0.2 s."""
    modes: int = Field(3, ge=0, le=20)
    """Modes that detectors share, each with a spectrum of its own. 0: baselines of independent
    detectors (destriping with a noise prior)."""
    free: int = Field(1, ge=0, le=20)
    """Number of modes without weight at any frequency, within baselines too. Without modes
    there are none."""
    group: Literal["band", "wafer", "all"] = "band"
    """The detectors that share modes: those of a band, of each wafer, which then has `modes` and
    `free` of its own, or of all bands of the camera, whose maps are then found together."""
    trend: int = Field(1, ge=0, le=10)
    """Degree of the polynomial of each detector's scan that is taken off."""
    noise: Literal["estimated", "simulated"] | InputPath = "estimated"  # type: ignore[assignment]
    """Where the noise model comes from: `estimated` from the streams; `simulated`, the closed forms
    of the scene's white noise, pink noise and atmosphere; or a table of ``zonda noise``, whose
    white levels and spectra are taken, modes being found in the streams."""
    refine: int = Field(1, ge=0, le=5)
    """Times that noise is estimated again, from data minus the map."""
    tolerance: float = Field(1e-4, gt=0, lt=0.1)
    """Norm of the residual at which the iteration ends, over that of the right side."""
    undetermined: Literal["none", "mean", "plane"] | None = None
    """What is taken off the map of I, weighted by its hits, since the data hardly determine it;
    where absent, a plane of a TAN image, the mean of other maps."""

    @field_validator("noise", mode="before")
    @classmethod
    def _no_noise_of_pixels(cls, value: Any) -> Any:
        if value in ("net", "scatter"):
            raise ValueError(f"{value} belongs to BinMap; write estimated or simulated")
        return value

    @model_validator(mode="before")
    @classmethod
    def _no_mask(cls, values: Any) -> Any:
        if isinstance(values, dict) and "mask" in values:
            raise ValueError(
                "leave mask out: it belongs to filters, and nothing is filtered here; the noise is"
                " estimated from data minus the map (refine)"
            )
        return values

    patterns: int = Field(0, ge=0, le=10)
    """How many of the patterns that the data determine least are found and become planes of the
    map, with their pictures. Finding them may take as long as the map, or several times as long."""

    @model_validator(mode="after")
    def _of_likelihood(self) -> LikelihoodParameters:
        if "free" not in self.model_fields_set:
            self.__dict__["free"] = min(self.free, self.modes)
        if self.free > self.modes:
            text = f"free: {self.free} of {self.modes} modes"
            raise ValueError(f"{text}; set free to {self.modes} or less, or modes to {self.free}")
        if self.contents == "hits" or self.weights == "uniform":
            raise ValueError(
                "contents: hits and weights: uniform belong to BinMap: these maps are weighted by"
                " their noise"
            )
        if self.noise == "simulated" and "refine" in self.model_fields_set:
            raise ValueError("refine belongs to noise: estimated; simulated noise stays as it is")
        if self.noise == "simulated" and self.group == "all":
            raise ValueError(
                "noise: simulated is that of one band; with group: all it is estimated, or a table"
            )
        if self.split != "scans":
            raise ValueError("half_difference is that of even and odd scans; write true or scans")
        if self.undetermined == "plane" and self.kind != "TAN":
            raise ValueError("undetermined: plane is for TAN images; choose none or mean")
        return self

    def baseline_of(self, observation: Observation) -> float:
        """Length of a baseline, s: modes that are not free change while the focal plane is crossed,
        at the median speed of the boresight.
        """
        if self.baseline is not None:
            return self.baseline
        some = np.arange(0, observation.n_samples - 1, max(observation.n_samples // INSTANTS, 1))
        one, other = (boresights(observation.boresight_radec[some + k]) for k in (0, 1))
        speed = observation.sample_rate * np.sqrt(((other - one) ** 2).sum(axis=0))
        field = 2 * observation.focalplane.radius + observation.instrument.beam_fwhm
        middle = float(np.median(speed)) if some.size else 0.0
        crossed = min(max(PART * field / middle, SHORTEST), LONGEST) if middle > 0 else LONGEST
        return max(crossed, 4 / observation.sample_rate)

    def groups_of(self, observation: Observation) -> NDArray[np.intp]:
        """(n_det,) number of the group of each detector."""
        plane = observation.focalplane
        return np.asarray(plane.wafer if self.group == "wafer" else 0 * plane.wafer, np.intp)

    @property
    def model(self) -> str:
        """Origin of the noise model, in words."""
        if isinstance(self.noise, Path):
            return f"white levels and spectra of {self.noise.name}, modes from the streams"
        return "closed forms of the scene" if self.noise == "simulated" else "from the streams"

    @property
    def noise_from(self) -> Literal["net", "streams", "table"]:
        """Origin of the white level, as of `MapArrays`."""
        if isinstance(self.noise, Path):
            return "table"
        return "net" if self.noise == "simulated" else "streams"

    @property
    def refined(self) -> int:
        """Solutions from which noise is estimated again; none if it is simulated."""
        return 0 if self.noise == "simulated" else self.refine

    @property
    def taken_off(self) -> Literal["none", "mean", "plane"]:
        """The name of the pattern that is taken off the map of I."""
        return self.undetermined or ("plane" if self.kind == "TAN" else "mean")
