"""The transfer function at one angular scale.

With a the map of the sky alone without filters, b the same behind them, and the ring of wavenumbers
|ln(k scale)| <= width / 2 under the window of `TransferFunction`,

    T = Re sum b a* / sum |a|^2,
    S = (sum |b|^2 / sum |a|^2)^(1/2).                                        (1)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.figures import FigureMetric
from zonda.core.numerics.angles import angle_text
from zonda.core.signal import Signal
from zonda.operators.diagnostics.transfer_function import compare, window_of

from .common import SKY_ALONE, UNFILTERED, flat, map_of, needs_signal, needs_tan


class TransferAt(FigureMetric):
    """Share of the sky that the filters leave at one angular scale, equation (1). A claim about it
    must state its window.
    """

    scale: Angle = quantity("60 arcsec", gt=0)
    """Angular scale 1/k."""
    width: float = Field(0.5, gt=0, le=3)
    """Width of the ring in ln k."""
    kind: Literal["in_phase", "amplitude"] = "in_phase"
    """T, the share that is left in phase; or S, the definition of the paper, which counts what
    comes from elsewhere, too.
    """
    modes: Literal["sky", "full"] = "sky"
    """Singular modes of the sky alone, or of the complete data."""
    radius: Angle | None = Field(None, gt=0)
    """Window: use only what lies this near to the map's centre."""
    taper: Angle | None = Field(None, gt=0)
    """Width of the window's cosine edge; where absent, it reaches to the middle."""
    least_coverage: float = Field(0.1, ge=0, lt=1)
    """Where the samples per pixel are below this share of their 99th percentile, the window is
    zero.
    """
    map: str = Field("map", pattern=r"^[A-Za-z0-9_]+$")
    """Which map, by its name among the products."""

    def needs(self) -> tuple[Signal, ...]:
        """The sky alone, with filters and without."""
        if self.modes == "sky":
            return SKY_ALONE, UNFILTERED
        return Signal(only=["sky"], modes="full"), Signal(
            only=["sky"], modes="full", filters="none"
        )

    def named_signals(self) -> tuple[str, ...]:
        """None but those of `needs`."""
        return ()

    def look(self, kinds: Mapping[str, str]) -> None:
        """A TAN map of the signal."""
        needs_signal(kinds, "transfer_at", self.map)
        needs_tan(kinds.get(self.map, "TAN"), "transfer_at")

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (1); the standard error is that from the scatter of the ring's modes, for T
        alone.
        """
        after, before = (
            flat(map_of(data, "transfer_at", name, self.map), "transfer_at") for name in names
        )
        window = window_of(before, self.radius, self.taper, self.least_coverage)
        edges = np.exp(np.array([-0.5, 0.5]) * self.width) / self.scale
        rings = compare(before.signal, after.signal, window, before.pixel, edges)
        value = float((rings.transfer if self.kind == "in_phase" else rings.amplitude)[0])
        if not math.isfinite(value):
            cure = "choose a scale between two pixels and the window's diameter, or a larger width"
            raise InputError(
                f"no mode of {angle_text(self.scale)} has power in the window",
                place="transfer_at",
                cure=cure,
            )
        return value, float(rings.error[0]) if self.kind == "in_phase" else math.nan

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        window = (
            f"window within {angle_text(self.radius)}" if self.radius else "window of the coverage"
        )
        what = "share left in phase" if self.kind == "in_phase" else "root of the ratio of power"
        ring = f"transfer function at {angle_text(self.scale)}, ring of {self.width:g} in ln k"
        return f"{ring}: {what}, {window}, modes: {self.modes}"
