"""Figures of aperture photometry: flux densities within a circle, and what filters leave of them.

aperture_flux     F of a map                                 (`core.maps.apertures`, (1))
aperture_ratio    F of the map, or of the sky behind the filters / F of the sky without them
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.figures import FigureMetric
from zonda.core.maps.apertures import Aperture, ApertureFlux, flux_within, in_frame
from zonda.core.maps.noise_figures import is_quiet, maps_of, noise_alone
from zonda.core.numerics.sphere import angle_text
from zonda.core.signal import Signal, product_name, stream_of

from .common import map_of, needs_signal, sky_alone


class _InAperture(FigureMetric):
    """A flux density within a circle."""

    map: str = Field("map", pattern=r"^[A-Za-z0-9_]+$")
    """Which map, by its name among the products."""

    radius: Angle = quantity("1 arcmin", gt=0, le=0.5)
    """Of the circle."""
    inner: Angle = quantity("0 arcmin", ge=0, le=0.5)
    """Inner radius of the annulus whose mean brightness is taken off."""
    outer: Angle = quantity("0 arcmin", ge=0, le=0.5)
    """Outer radius of it; 0: nothing is taken off."""
    centre: Target | None = None
    """Of the circle; where absent that of the map."""
    spectral_index: float = Field(0.0, ge=-100, le=100)
    """Slope of the flux density, S ~ frequency^index, within the band."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.outer and not self.radius <= self.inner < self.outer:
            raise ValueError("radius <= inner < outer is needed")
        return self

    def look(self, kinds: Mapping[str, str]) -> None:
        """A map of the signal."""
        needs_signal(kinds, self.own_name(), self.map)

    def flux(self, data: Data, signal: str) -> ApertureFlux:
        """Find it in the map of a signal, with its error from all but the sky, else from the
        half-difference.
        """
        product = map_of(data, self.own_name(), signal, self.map)
        product = product if product.polarization is None else product.stokes("I")
        maps = maps_of(data.products)
        name = product_name(stream_of(signal), self.map)
        quiet = is_quiet(data.provenance.get("runs", {}), name)
        if quiet:
            product = product.with_planes(noise=np.zeros(product.hits.shape))
        return flux_within(
            product,
            Aperture(self.radius, self.inner, self.outer),
            None if self.centre is None else in_frame(product, self.centre),
            None if quiet else noise_alone(maps, name),
            self.spectral_index,
        )

    def where(self) -> str:
        """The circle in words."""
        ring = ""
        if self.outer:
            ring = f", less the mean from {angle_text(self.inner)} to {angle_text(self.outer)}"
        return f"within {angle_text(self.radius)} of {self.centre or 'the centre'}{ring}"


class ApertureFluxDensity(_InAperture):
    """Flux density of a map within a circle, and its error from what holds noise alone
    (`core.maps.apertures`, equations (1) and (2)).
    """

    signal: str = Field("", pattern=r"^[A-Za-z0-9_]*$")
    """Of which signal of the pipeline, e.g. noiseless; empty: the complete one."""

    @property
    def unit(self) -> str:
        """Unit of a flux density."""
        return "Jy"

    @classmethod
    def own_name(cls) -> str:
        return "aperture_flux"

    def named_signals(self) -> tuple[str, ...]:
        """The one that is chosen."""
        return (self.signal,)

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Flux density and its error."""
        found = self.flux(data, self.signal)
        return found.flux, found.error

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        found = self.flux(data, self.signal)
        lost = f"; {100 * found.missing:.2g} % of it has no value" if found.missing > 1e-3 else ""
        return (
            f"flux density of {self.signal or 'the map'} {self.where()}{lost}, noise: {found.noise}"
        )


class ApertureRatio(_InAperture):
    """Flux density within a circle over that of the sky alone without filters, in the same pixels
    with the same beam: what the filters leave of it.
    """

    of: Literal["map", "sky"] = "map"
    """Recovered from the complete map, or from the sky alone behind the filters (no noise)."""
    modes: Literal["sky", "full"] = "sky"
    """Of `of: sky`: singular modes of the sky alone, or of the complete data."""

    def needs(self) -> tuple[Signal, ...]:
        """The sky alone without filters; and with them."""
        filtered, plain = sky_alone(self.modes)
        return (plain,) if self.of == "map" else (plain, filtered)

    def named_signals(self) -> tuple[str, ...]:
        """The complete signal, if it is that."""
        return ("",) if self.of == "map" else ()

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Ratio, and its error: that of the map."""
        before = self.flux(data, names[0]).flux
        if before == 0:
            cure = "choose a circle with a source in it"
            raise InputError("the sky is empty there", place="aperture_ratio", cure=cure)
        found = self.flux(data, names[1] if self.of == "sky" else "")
        return found.flux / before, found.error / abs(before)

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        what = "the map" if self.of == "map" else f"the filtered sky, modes: {self.modes}"
        return f"flux density {self.where()}, of {what} / of the sky without filters"
