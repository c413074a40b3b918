"""Parameters of `MaximumLikelihoodMap`."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.units import Seconds
from zonda.core.numerics.projection import boresights
from zonda.core.observation import Observation

from .parameters import MapParameters

SHORTEST, LONGEST, PART = 0.05, 0.2, 0.15
"""Of a baseline, s, where none is given; share of the time in which the focal plane is crossed."""
INSTANTS = 1000
"""Of a scan at which its speed is looked at."""


class LikelihoodParameters(MapParameters):
    """Noise model, iteration, and what is taken off."""

    largest_pixel: ClassVar[tuple[float, str]] = (
        0.5,
        "what varies within a pixel is taken for noise, and spread over the map (0.2 to 2 % of the"
        " sky's rms at half of the beam, 7 % with modes: 0)",
    )
    baseline: Seconds | None = Field(None, gt=0, examples=["0.2 s"])
    """Length of a baseline: noise is white within it, but for the free modes. Where absent, 0.15
    of the time in which the scan crosses the focal plane, from 0.05 to 0.2 s."""
    modes: int = Field(3, ge=0, le=20)
    """Modes that detectors share, each with a spectrum of its own. 0: baselines of independent
    detectors (destriping with a noise prior)."""
    free: int = Field(1, ge=0, le=20)
    """How many of the modes have no weight at any frequency, within baselines too."""
    group: Literal["band", "wafer"] = "band"
    """The detectors that share modes: those of a band, or of each wafer, which then has `modes` and
    `free` of its own."""
    trend: int = Field(1, ge=0, le=10)
    """Degree of the polynomial of each detector's scan that is taken off."""
    noise: Literal["estimated", "simulated"] | InputPath = "estimated"  # type: ignore[assignment]
    """Where the noise model comes from: `estimated` from the streams; `simulated`, the closed forms
    of the scene's white noise, pink noise and atmosphere; or a table of ``zonda noise``, whose
    white levels and spectra are taken, modes being found in the streams."""
    refine: int = Field(1, ge=0, le=5)
    """How often noise is estimated again, from data minus the map."""
    tolerance: float = Field(1e-4, gt=0, lt=0.1)
    """Norm of the residual at which the iteration ends, over that of the right side."""
    undetermined: Literal["none", "mean", "plane"] | None = None
    """What is taken off the map of I, weighted by its hits, since the data hardly determine it;
    where absent, a plane of a TAN image, the mean of other maps."""

    @field_validator("group", mode="before")
    @classmethod
    def _bands_are_apart(cls, value: Any) -> Any:
        if value == "all":
            raise ValueError("each band has a map and modes of its own; write band or wafer")
        return value

    @field_validator("noise", mode="before")
    @classmethod
    def _no_noise_of_pixels(cls, value: Any) -> Any:
        if value in ("net", "scatter"):
            raise ValueError(f"{value} belongs to BinMap; write estimated or simulated")
        return value

    patterns: int = Field(0, ge=0, le=10)
    """How many of the patterns that the data determine least are found and become planes of the
    map, with their pictures. Finding them may take as long as the map, or several times as long."""

    @model_validator(mode="after")
    def _of_likelihood(self) -> LikelihoodParameters:
        if self.free > self.modes:
            raise ValueError(f"free: {self.free} of {self.modes} modes; set modes to {self.free}")
        if self.contents == "hits" or self.weights == "uniform":
            raise ValueError(
                "contents: hits and weights: uniform belong to BinMap: these maps are weighted by"
                " their noise"
            )
        if self.noise == "simulated" and "refine" in self.model_fields_set:
            raise ValueError("refine belongs to noise: estimated; simulated noise stays as it is")
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
    def refined(self) -> int:
        """Solutions from which noise is estimated again; none if it is simulated."""
        return 0 if self.noise == "simulated" else self.refine

    @property
    def taken_off(self) -> Literal["none", "mean", "plane"]:
        """The name of the pattern that is taken off the map of I."""
        return self.undetermined or ("plane" if self.kind == "TAN" else "mean")
