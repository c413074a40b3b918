"""The parameters of `HighpassFilter` and of `CommonModeFilter`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Hertz, Seconds
from zonda.core.operator import Operator

from .source_mask import SourceMask


class HighpassParameters(Operator):
    """The parameters of `HighpassFilter`."""

    frequency: Hertz = quantity("0.08 Hz", gt=0)
    """Cutoff: lower frequencies are removed (`brick_wall`), or attenuated as the fourth power of
    the frequency (`bessel`).
    """
    response: Literal["brick_wall", "bessel"] = "brick_wall"
    """Brick wall without phase, or a causal Bessel filter with four poles."""
    degree: int | None = Field(3, ge=0, le=3)
    """Degree of the polynomial fitted to each detector's scan and removed first (1: a line; null:
    none, for `bessel` alone).
    """
    trim: Seconds = quantity("0 s", ge=0)
    """Time at either end of each scan that is flagged."""
    oversampling: float = Field(24.0, ge=8, le=1000)
    """Of the brick wall: coarse knots per cut cycle (M / (K / 2)); the low part's error at the cut
    is about oversampling^-4.
    """
    mask: SourceMask | None = None
    """Source whose samples are bridged to find the slow part, which is subtracted there too:
    equation (1) of `source_mask`.
    """

    @model_validator(mode="after")
    def _has_a_degree(self) -> HighpassParameters:
        if self.degree is None and self.response == "brick_wall":
            raise ValueError(
                "a brick wall needs a degree of 0 or more; degree: null belongs to response: bessel"
            )
        if self.response == "bessel" and "oversampling" in self.model_fields_set:
            raise ValueError(
                "oversampling belongs to response: brick_wall; the Bessel filter is exact"
            )
        return self


class CommonModeParameters(Operator):
    """The parameters of `CommonModeFilter`."""

    modes: int = Field(1, ge=1, le=100)
    """How many modes to remove."""
    group: Literal["band", "wafer", "all"] = "band"
    """Whose modes are found together: those of all detectors of a band, of each wafer of it, or of
    all bands of the camera.
    """
    method: Literal["svd", "mean"] = "svd"
    """Singular modes, or the mean of all detectors at each instant (one mode), which needs little
    memory.
    """
    residual: float = Field(1e-6, gt=1e-12, lt=1e-1)
    """Largest residual of a removed mode, equation (2)."""
    gap: float = Field(0.9, gt=0, lt=1)
    """A mode is determined by the data while the next singular value is at most this times its own.
    """
    scale: Literal["none", "rms"] = "none"
    """`rms`: the modes are those of streams of unit rms, equation (4), as in the mapper of maria
    1.0.0.
    """
    mask: SourceMask | None = None
    """Source whose samples are not used to find the modes, which are subtracted there too. Where it
    covers all detectors at an instant, nothing is subtracted: choose it smaller than the field of
    view."""
    on_undetermined: Literal["mean", "skip", "remove"] = "mean"
    """What to do with a mode that is not determined: remove the detectors' mean (in place of the
    first), skip or remove it.
    """

    @model_validator(mode="after")
    def _one_mean(self) -> CommonModeParameters:
        if self.method == "mean" and self.modes != 1:
            raise ValueError(
                "method: mean removes one mode; leave modes at 1 or choose method: svd"
            )
        of_svd = {"residual", "gap", "on_undetermined"} & self.model_fields_set
        if self.method == "mean" and of_svd:
            raise ValueError(
                f"{sorted(of_svd)[0]} belongs to method: svd; the detectors' mean is exact and"
                " always determined"
            )
        if self.method == "mean" and self.scale == "rms":
            raise ValueError("scale: rms belongs to method: svd; the detectors' mean has no scale")
        return self
