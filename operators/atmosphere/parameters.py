"""Parameters of the turbulent layers, and the checks that need nothing else."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from zonda.core.configuration.diagnostics import refusal
from zonda.core.configuration.parameters import Parameters, quantity
from zonda.core.configuration.units import Angle, Fraction, Metres, MetresPerSecond
from zonda.core.errors import ZondaError
from zonda.core.operator import Operator
from zonda.core.types import Floats
from zonda.core.weather import PWV_MAX


class Wind(Parameters):
    """A horizontal wind."""

    speed: MetresPerSecond = Field(ge=0, le=200)
    """How fast the air moves."""
    direction: Angle = quantity("270 deg")
    """Where the wind comes from, from north through east, as weather reports give it (270 deg: a
    west wind).
    """

    @property
    def vector(self) -> Floats:
        """Wind velocity towards (east, north), m/s."""
        return -self.speed * np.array([math.sin(self.direction), math.cos(self.direction)])


class LayerParameters(Operator):
    """Parameters of `AtmosphereLayers`."""

    pwv: Metres | None = Field(None, gt=0, le=PWV_MAX)
    """Mean precipitable water vapour at zenith; where absent, that of the scene's `weather` (by
    default the climatology's median for the date and hour). A scene whose weather gives another PWV
    is refused: it would be given twice."""
    pwv_rms: Fraction = quantity("0.5 %", ge=0, le=1)
    """Ensemble rms of the line-of-sight water vapour, as a fraction of its mean (at one point of
    the sky, over all weather).
    """
    pwv_rms_at: Literal["scan", "zenith"] = "scan"
    """Where `pwv_rms` holds: at the scan's own elevation, or at the zenith. From there the
    turbulent slab between `lowest` and `highest` says what it is along the line of sight
    (docs/atmosphere.md): in metres of water, about airmass^(1/2) as much."""
    pwv_rms_after_beam: bool = False
    """Whether `pwv_rms` is what the telescope sees, or what a pencil beam would see (the beam
    smooths a part away).
    """
    layers: int = Field(10, ge=1, le=200)
    """Number of layers, evenly spaced from `lowest` to `highest` (a single one lies at `lowest`).
    """
    lowest: Metres = quantity("500 m", gt=0, le=20000)
    """Height of the lowest layer above the site."""
    highest: Metres = quantity("5000 m", gt=0, le=20000)
    """Height of the highest layer above the site."""
    weights: Literal["vapour", "equal"] = "vapour"
    """How the fluctuation is shared among the layers: by vapour density times thickness, or
    equally.
    """
    layer_response: Literal["layer", "column"] = "layer"
    """How a layer's water emits and absorbs: as at its height, or as the column does on average
    (van Marrewijk et al. 2024).
    """
    outer_scale: Metres = quantity("500 m", gt=0)
    """Outer scale r0 of the turbulence (van Marrewijk et al. 2024), a length in the von Karman
    covariance.
    """
    wind: Literal["profile"] | Wind | list[Wind] = "profile"
    """The weather's wind at each layer's height (see `weather: wind`), or one wind for all layers,
    or a list of one for each.
    """
    fidelity: Literal["default", "fine"] = "default"
    """Accuracy of the turbulence: its covariance is within 0.08 % or 0.01 % of the variance
    (docs/atmosphere.md).
    """
    beam: Literal["gaussian", "top_hat", "tapered"] = "gaussian"
    """Footprint in a layer: the paper's Gaussian of FWHM D, the uniform disc of diameter D, or one
    that falls towards its rim.
    """
    edge_taper: float | None = Field(None, gt=0, le=60)
    """With `beam: tapered`, dB by which the illumination's power falls from the centre to the rim;
    10 where absent.
    """
    outputs: list[Literal["pwv", "opacity", "path_delay"]] = Field(default_factory=list)
    """Further streams: fluctuations of the line-of-sight water vapour (m), of the band's opacity,
    of the wet path delay (m).
    """
    spectra: str = "am"
    """Absorption cross-sections of the atmosphere: a registered table (`zonda plugins`); am's in
    cells of 0.5 GHz by default.
    """
    omit: list[int] = Field(default_factory=list)
    """Layers to omit, the lowest is 0; the others do not change (their shares, their turbulence).
    """
    lattice: float | None = Field(None, gt=0, le=0.8)
    """Largest spacing of the turbulence lattice, in units of the beam's sigma at the layer (a power
    of two metres is used); where absent that of the `fidelity`, 0.8 or 0.5."""
    tolerance: Fraction = quantity("1 %", ge=1e-4, le=1)
    """Rms error of the evaluation at nodes over the field, and of that at steps in time, each as a
    fraction of what the focal-plane mean, subtracted, leaves of the atmosphere (without nodes: of
    the steps alone, 1.4 times as much)."""

    @field_validator("spectra")
    @classmethod
    def _known(cls, name: str) -> str:
        from zonda.core.registry import spectra

        try:
            spectra.get(name)
        except ZondaError as error:
            raise refusal(error) from None
        return name

    @model_validator(mode="after")
    def _consistent(self) -> LayerParameters:
        if self.layers > 1 and not self.lowest < self.highest:
            raise ValueError("lowest must be below highest")
        of_many = {"highest", "weights"} & self.model_fields_set
        if self.layers == 1 and of_many:
            raise ValueError(
                f"{sorted(of_many)[0]} needs several layers; a single one lies at lowest"
            )
        if self.layers == 1 and self.pwv_rms_at == "zenith":
            raise ValueError(
                "pwv_rms_at: zenith needs several layers: lowest to highest is the depth of the"
                " turbulence"
            )
        if any(not 0 <= k < self.layers for k in self.omit):
            raise ValueError(f"omit names layers 0 to {self.layers - 1}, the lowest first")
        if isinstance(self.wind, list) and len(self.wind) != self.layers:
            raise ValueError(f"wind lists {len(self.wind)} winds for {self.layers} layers")
        if self.edge_taper is not None and self.beam != "tapered":
            raise ValueError("edge_taper is for beam: tapered")
        return self
