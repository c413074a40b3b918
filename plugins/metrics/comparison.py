"""Figures of `CompareMaps` and `MapSpectrum`: equations (1) and (2).

With a reference A, a map B and the threshold t of `CompareMaps`,

    fidelity    median of F = |A| / max(|B - A|, t rms(B - A)),
    |A| >= least max |A|                        (1)

With the power P_i of a map's rings i, their independent modes N_i, and the level W_i of white noise
in independent pixels,

    map_power   sum N_i P_i / sum N_i W_i,   smallest <= 1/k_i <= largest      (2)

    relative error   (sum N_i W_i^2)^1/2 / sum N_i W_i,
    of smoothed maps from draws of noise (radial)         (3)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, Fraction
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.figures import FigureMetric
from zonda.core.numerics.angles import angle_text
from zonda.operators.diagnostics.comparison.statistics import Comparison
from zonda.operators.diagnostics.map_spectra import MapSpectra

from .common import product_of


class Fidelity(FigureMetric):
    """Median fidelity of a map where its reference is bright, equation (1).

    It is measured by a `CompareMaps`. Of a map that is g times its reference everywhere it is 1 /
    |1 - g|, below the limit that the threshold sets.
    """

    reads: ClassVar[frozenset[str]] = frozenset({"comparison"})

    comparison: str = Field("comparison", pattern=r"^[A-Za-z0-9_.]+$")
    """Which one, by its name among the products: that of a `CompareMaps` with a name of its own."""
    least: Fraction = quantity("10 %", gt=0, le=1)
    """Share of the reference's peak from which a pixel counts; 100 %: the peak alone."""

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (1). Raises InputError where there is no comparison, or the reference is
        empty.
        """
        found = product_of(data, self.comparison, Comparison, "fidelity", "comparison, CompareMaps")
        size = np.abs(found.planes["reference"])
        peak = float(np.nanmax(size, initial=0.0))
        if peak == 0:
            raise InputError(
                "the reference is empty", place="fidelity", cure="compare with a sky with a source"
            )
        return float(np.median(found.planes["fidelity"][size >= self.least * peak])), math.nan

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        where = f"where the reference has {100 * self.least:g} % of its peak"
        if self.least == 1:
            where = "at the reference's peak"
        return f"median of |reference| / max(|difference|, threshold) {where}"


class MapPower(FigureMetric):
    """Power spectral density of a map over that of white noise in its pixels, in a range of angular
    scales, equation (2).

    It is measured by a `MapSpectrum`. White noise has 1 on all scales; 1/f noise and the atmosphere
    add on large ones.
    """

    reads: ClassVar[frozenset[str]] = frozenset({"map_spectra"})

    spectra: str = Field("map_spectra", pattern=r"^[A-Za-z0-9_.]+$")
    """Which ones, by their name among the products: that of a `MapSpectrum` with a name of its own.
    """
    of: str = Field("source_free/map", pattern=r"^[A-Za-z0-9_/]+$")
    """Which map."""
    smallest: Angle = quantity("10 arcsec", gt=0)
    """Smallest angular scale, 1/k."""
    largest: Angle = quantity("20 arcsec", gt=0)
    """Largest angular scale."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.largest <= self.smallest:
            raise ValueError("largest must be larger than smallest")
        return self

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (2). Raises InputError where the map, its white level or modes of these scales
        are missing.
        """
        found = product_of(
            data, self.spectra, MapSpectra, "map_power", "product of map spectra, MapSpectrum"
        )
        rings = found.spectra
        if self.of not in rings.power or self.of not in rings.white:
            there = ", ".join(sorted(rings.power.keys() & rings.white.keys())) or "none"
            raise InputError(
                f"no spectrum and white level of the map {self.of!r} are known",
                place="map_power",
                cure=f"maps with a known level: {there}; name others in MapSpectrum.maps",
            )
        power, level = rings.power[self.of], rings.white[self.of]
        used = (rings.scale >= self.smallest) & (rings.scale <= self.largest) & np.isfinite(power)
        number, power, level = rings.modes[used], power[used], level[used]
        if not number.sum() > 0:
            cure = "choose scales between two pixels and the map's size, or a wider range"
            raise InputError(f"no ring lies {self._range()}", place="map_power", cure=cure)
        value = float(number @ power) / float(number @ level)
        if rings.draws is not None:
            together = rings.draws[:, used] @ (number * level)
            return value, value * float(together.std(ddof=1) / together.mean())
        return value, value * math.sqrt(float(number @ level**2)) / float(number @ level)

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        white = "that of white noise by NET and samples"
        return f"power of {self.of} over {white}, scales {self._range()}"

    def _range(self) -> str:
        return f"from {angle_text(self.smallest)} to {angle_text(self.largest)}"
