"""`AtmosphereLayers`: turbulent layers of water vapour that drift over the telescope, their
emission and their opacity.

The PWV along a line of sight is

    PWV_los = airmass PWV (1 + y),   y = p sum_l a_l g_l,
    sum_l a_l^2 = 1                                    (1)

with g_l the unit-variance von Karman field of layer l (`turbulence`), seen through the near-field
beam at the layer's distance, and p the ensemble rms. Emission and transmission of the band follow
from radiative transfer at PWV (1 + y) and the elevation of the ray (`response`). All of it is
smooth, so it is computed at nodes (`turbulence.nodes`) and interpolated.
"""

from __future__ import annotations

import math
import warnings
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, PrivateAttr, field_validator, model_validator

from zonda.core.block import Block
from zonda.core.configuration.diagnostics import refusal
from zonda.core.configuration.parameters import Parameters, quantity
from zonda.core.configuration.units import Angle, Fraction, Metres, MetresPerSecond
from zonda.core.data import Data
from zonda.core.errors import PointingError, ZondaError
from zonda.core.numerics.chunks import chunks
from zonda.core.observation import Observation
from zonda.core.operator import Operator
from zonda.core.plausible import PWV, doubt
from zonda.core.types import Floats
from zonda.core.weather import PWV_MAX

from .closed_form import closed_form
from .drawing import draw, state_drawn
from .fluctuations import AtNodes, OfDetectors
from .model import AtmosphereModel, ExpectedLoad, Models
from .weather.radiative_transfer import ELEVATION_MIN


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


class AtmosphereLayers(LayerParameters):
    """Turbulent layers of water vapour seen through near-field beams: their emission and
    transmission in the band.

    Sets ``observation.smooth["atmosphere"]`` (mean emission, K_RJ) and ``["transmission"]``
    (band-mean e^-tau), and adds the fluctuation of the emission to the stream ``atmosphere`` and
    that of the transmission, relative, to ``transmission``. With `outputs` it also makes streams of
    the fluctuation along each line of sight: ``pwv`` (m), ``opacity`` (of the band) and
    ``path_delay`` (m of excess path, non-dispersive).
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    on_request: ClassVar[frozenset[str]] = frozenset({"pwv", "opacity", "path_delay"})
    knows_means: ClassVar[bool] = True

    _models: Models = PrivateAttr(default_factory=Models)

    @property
    def provides(self) -> frozenset[str]:
        """Streams of every atmosphere, and `outputs`."""
        return frozenset({"atmosphere", "transmission", *self.outputs})

    def model(self, observation: Observation) -> AtmosphereModel:
        """Model of the atmosphere of an observation, before any of it is drawn."""
        return self._models.of(self, observation)

    def check(self, data: Data) -> list[str]:
        """The weather and what the band sees of it. Raises InputError or PointingError where a run
        cannot be seen through it.
        """
        models, lines = (
            Models(data.scene.time, data.scene.weather, {}, self._models._bands),
            list[str](),
        )
        for observation in data.observations:
            _check_pointing(observation)
        for alone in data.observations[0].of_each_band() if data.observations else ():
            model, band = models.of(self, alone), alone.instrument.band.name
            _ = (
                model.turbulence,
                model.ground,
            )  # what is wrong with layers is found as they are laid out
            every = np.concatenate(
                [
                    o.elevation[[o.elevation.argmin(), o.elevation.argmax()]]
                    for o in data.observations
                ]
            )
            emission = np.asarray(model.band.emission(model.pwv, every))
            if not lines:
                if text := doubt(f"{self.label}: PWV", model.pwv, PWV, "m"):
                    warnings.warn(text, stacklevel=2)
                lines.append(f"PWV {1e3 * model.pwv:.3g} mm at zenith")
            through = float(np.mean(model.band.transmission(model.pwv, every)))
            lines.append(
                f"{band}: emission {emission.min():.3g} to {emission.max():.3g} K_RJ, transmission"
                f" {through:.3g}"
            )
        return lines

    def observe(self, data: Data) -> None:
        """Note the start of the run and its scans, which share one drifting atmosphere; announce
        the load to map makers.
        """
        self._models = self._models.of_run(
            data
        )  # one of its own: copies of this step may be at work in other threads
        for observation in data.observations:
            ExpectedLoad(self._models, self, observation).announce()

    def configure(self, observation: Observation) -> None:
        """Set the smooth means: noise levels that follow from the load need them before any step is
        prepared.
        """
        _check_pointing(observation)
        model = self.model(observation)
        observation.weather = model.ground
        observation.smooth.update(model.means())

    def prepare(self, observation: Observation) -> AtNodes | OfDetectors:
        """Lay out the turbulence, draw it at the nodes."""
        if "atmosphere" not in observation.smooth:
            self.configure(observation)
        model = self.model(observation)
        if (spectrum := closed_form(model, observation)) is not None:
            observation.closed_forms.setdefault("atmosphere", []).append(spectrum)
        state = draw(model, self.label)
        state_drawn(model, self.label, state)
        return state

    def exec(self, block: Block, state: AtNodes | OfDetectors) -> None:
        """Add the fluctuations to the block's ``atmosphere`` and ``transmission``, and to the
        `outputs`.
        """
        names: dict[str, str] = {"emission": "atmosphere", "transmission": "transmission"}
        names.update((name, name) for name in self.outputs)
        made = {}
        for name, stream in names.items():
            there = stream in block.detdata
            made[name] = (
                block.buffer(f"{self.label} {name}", block.shape)
                if there
                else block.new(stream, zero=False)
            )
        state.into(block.detectors, block.samples, made)
        for name, stream in names.items():
            if block.detdata[stream] is not made[name]:
                block.detdata[stream] += made[name]

    def collect(self, data: Data, observation: Observation, state: AtNodes | OfDetectors) -> None:
        """Report the mean and rms of the PWV that was drawn while the blocks were worked on."""
        state_drawn(self.model(observation), self.label, state)


def _check_pointing(observation: Observation) -> None:
    quaternions, lowest = observation.boresight_azel, 1.0
    for chunk in chunks(observation.n_samples):
        x, y, *_ = part = quaternions[chunk].T
        if not np.isfinite(part).all():
            bad = np.flatnonzero(~np.isfinite(quaternions).all(axis=1))
            raise PointingError(
                f"the boresight of sample {bad[0]} is not a number ({len(bad)} of"
                f" {observation.n_samples} samples)",
                place=observation.name,
                cure="repair the pointing, or remove these samples",
            )
        lowest = min(lowest, 1 - 2 * float((x * x + y * y).max()))
    if lowest > math.sin(ELEVATION_MIN) + 1e-9:
        return
    elevation = observation.elevation
    if 0 <= elevation.min() < ELEVATION_MIN:
        raise PointingError(
            f"the boresight is {math.degrees(elevation.min()):.2f} deg above the horizon at sample"
            f" {elevation.argmin()}; the limits of the radiative transfer are 4.5 to 90 deg",
            place=observation.name,
            cure="choose a target or a time with a higher elevation",
        )
