"""Model of the atmosphere of an observation before any of it is drawn: built once, for the run and
for planning.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from zonda.core.configuration.diagnostics import refusal
from zonda.core.configuration.parameters import Parameters, quantity
from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import Angle, Fraction, Metres, MetresPerSecond
from zonda.core.data import Data
from zonda.core.errors import InputError, ZondaError
from zonda.core.instrument import SPEED_OF_LIGHT, Band, Telescope
from zonda.core.numerics.smooth import SmoothField
from zonda.core.numerics.sphere import FWHM_PER_SIGMA
from zonda.core.observation import LoadSpectra, Observation
from zonda.core.operator import Operator
from zonda.core.registry import spectra
from zonda.core.types import Floats
from zonda.core.weather import PWV_MAX, GroundWeather, WeatherSource

from .distribution import Fluctuation, Slab, largest_pwv
from .resolution import Resolution, choose_resolution
from .response import NAMES, LayerTerms, kappa
from .turbulence.beams import Aperture, widened
from .turbulence.covariance import beam_correlation
from .turbulence.geometry import ScanPlane, axes_at, rays, scan_planes
from .turbulence.lattice import Turbulence
from .turbulence.nodes import Layer, times_with_margin
from .weather.absorption import AbsorptionTable
from .weather.bands import BandAtmosphere
from .weather.profiles import Profile
from .weather.radiative_transfer import ELEVATION_MAX, ELEVATION_MIN
from .weather.sources import on_the_ground, profile_of

EDGE_TAPER = 10.0
"""dB: power at the rim of a tapered aperture below that at its centre, where none is given."""

ONE_VALUE = 0.01
"""Relative change of the fluctuation's rms with elevation within a scan up to which one value
serves the whole scan.
"""

AIRMASS_STEP = 0.05
"""Of ln(airmass), between which the load's integrals over the passband are interpolated."""

MODELS_KEPT = 2
"""Observations whose models are kept: one is prepared while the one before is worked on."""


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


@dataclass(eq=False)
class AtmosphereModel:
    """The atmosphere above one observation: weather, the band's response to it, the layers as the
    telescope sees them.

    Attributes
    ----------
    parameters
        Of the operator.
    observation, plane
        The scan, and the plane that its turbulence is laid out in.
    profile, band
        The weather; emission and transmission of the band.
    ground
        The weather at the telescope.
    """

    parameters: LayerParameters
    observation: Observation
    plane: ScanPlane
    profile: Profile
    band: BandAtmosphere
    time: Instant
    _resolutions: dict[float, Resolution] = field(default_factory=dict)

    @property
    def pwv(self) -> float:
        """Mean PWV at zenith, m."""
        return self.parameters.pwv or self.profile.pwv

    @cached_property
    def layers(self) -> list[Layer]:
        """The layers, the lowest first."""
        p = self.parameters
        heights = np.linspace(p.lowest, p.highest, p.layers)
        shares, winds = _shares(p, self.profile, heights), _winds(p, self.profile, heights)
        layers = []
        for height, share, wind in zip(heights.tolist(), shares.tolist(), winds, strict=True):
            distance = self.plane.effective(height) / math.sin(self.plane.elevation)
            seen = self._footprint(distance)
            layers.append(Layer(share, height, distance, p.outer_scale, *seen, np.asarray(wind)))
        return layers

    def _footprint(self, distance: float) -> tuple[float, Aperture | None]:
        """Sigma of the beam at a distance along the line of sight, and its aperture if it has a
        rim.
        """
        p, instrument = self.parameters, self.observation.instrument
        if p.beam == "gaussian":
            return beam_sigma(instrument.telescope, instrument.band, distance), None
        width = _width(instrument.telescope, instrument.band, distance)
        aperture = Aperture(width, 0.0 if p.beam == "top_hat" else p.edge_taper or EDGE_TAPER)
        return aperture.sigma, aperture

    @cached_property
    def turbulence(self) -> list[Turbulence]:
        """The layers' fields. Keyed by seed, operator and layer, not by observation: all scans see
        the same atmosphere.
        """
        p = self.parameters
        return [
            Turbulence(
                self.observation.seed,
                p.label,
                "layer",
                number,
                outer_scale=layer.outer_scale,
                sigma=layer.sigma,
                aperture=layer.aperture,
                lattice=p.lattice,
                fidelity=p.fidelity,
            )
            for number, layer in enumerate(self.layers)
        ]

    @cached_property
    def fluctuation(self) -> Fluctuation:
        """The distribution of the PWV about its mean, at the scan's mean elevation."""
        p, variance = self.parameters, self._variance(self.layers)
        if p.pwv_rms_at == "scan":
            return Fluctuation(p.pwv_rms, p.pwv_rms_after_beam, variance)
        before = p.pwv_rms
        if p.pwv_rms_after_beam:
            before, _ = Fluctuation(p.pwv_rms, True, self._variance_at_zenith).before_and_after()
        return Fluctuation(
            before * float(self.slab.share(math.sin(self.elevation))),
            False,
            variance,
        )

    def strength(self, sine: Floats) -> Floats | None:
        """Factor by which the fluctuation at sines of the elevation exceeds that at the mean
        elevation; None: 1.

        Where `pwv_rms` holds at the zenith, in scans whose elevation changes by so much that it
        varies by `ONE_VALUE`.
        """
        return None if self._strength is None else np.interp(sine, *self._strength)

    @cached_property
    def _strength(self) -> tuple[Floats, Floats] | None:
        if self.parameters.pwv_rms_at == "scan":
            return None
        ends, wider = (elevation_range(self.observation, wider) for wider in (False, True))
        mean = float(self.slab.share(math.sin(self.elevation)))
        if np.abs(self.slab.share(np.sin(ends)) / mean - 1).max() <= ONE_VALUE:
            return None
        low, high = np.sin(wider)
        sines = np.linspace(low, high, 64)
        return sines, self.slab.share(sines) / mean

    @cached_property
    def slab(self) -> Slab:
        """The water between the lowest and the highest layer."""
        p = self.parameters
        return Slab(
            self.profile if p.weights == "vapour" else None,
            p.lowest,
            p.highest,
            p.outer_scale,
        )

    @property
    def elevation(self) -> float:
        """Mean elevation of the scan, rad, within the limits of the radiative transfer."""
        return _inside(float(np.mean(self.observation.elevation)))

    def _variance(self, layers: Sequence[Layer]) -> float:
        return sum(
            m.amplitude**2 * b.variance for m, b in zip(layers, self.turbulence, strict=True)
        )

    @cached_property
    def _variance_at_zenith(self) -> float:
        """Variance of the sum of the layers behind the beam, for a telescope that looks up."""
        total = 0.0
        for layer in self.layers:
            sigma, aperture = self._footprint(layer.height)
            one = (
                aperture.variance(layer.outer_scale)
                if aperture
                else float(beam_correlation(0.0, layer.outer_scale, sigma)[0])
            )
            total += layer.amplitude**2 * one
        return total

    @cached_property
    def kappa(self) -> dict[str, Floats]:
        """``emission`` and ``opacity`` (n_layer,) of water at each layer's height over the
        column's, at the mean elevation.

        1 where layers respond as the column does."""
        if self.parameters.layer_response == "column":
            return {name: np.ones(len(self.layers)) for name in NAMES}
        return kappa(self.band, self.pwv, self.elevation, self.heights)

    @property
    def heights(self) -> Floats:
        """(n_layer,) m above the site."""
        return np.array([layer.height for layer in self.layers])

    @cached_property
    def emitting(self) -> list[Layer]:
        """The layers, with their shares of the emission's fluctuation in place of those of the
        water's: kappa_l a_l.
        """
        if self.parameters.layer_response == "column":
            return self.layers
        shares = np.abs(self.kappa["emission"])
        return [
            replace(m, amplitude=m.amplitude * k)
            for m, k in zip(self.layers, shares.tolist(), strict=True)
        ]

    def terms(self, sines: tuple[float, float]) -> LayerTerms | None:
        """Contribution of the simulated layers to the column's response between two sines of the
        elevation.
        """
        if self.parameters.layer_response == "column":
            return None
        heights = self.heights[self.simulated]
        return LayerTerms.of(self.band, self.pwv, heights, self.fluctuation.scale, sines)

    @property
    def simulated(self) -> list[int]:
        """Numbers of the layers that are not omitted."""
        return [k for k in range(len(self.layers)) if k not in self.parameters.omit]

    def resolution(self, tolerance: float | None = None) -> Resolution:
        """Nodes and steps in time, for the parameters' tolerance or another."""
        tolerance = tolerance or self.parameters.tolerance
        if tolerance not in self._resolutions:
            emission = partial(self.band.emission, self.pwv)
            layers, rms = self.emitting, self.fluctuation.rms
            variance = self._variance(layers)
            # Of a saturated line only the air below is seen.
            if not variance > 1e-12 * self.fluctuation.variance:
                layers, variance = self.layers, self.fluctuation.variance
            found = choose_resolution(
                self.observation,
                self.plane,
                layers,
                variance,
                tolerance,
                emission,
                rms,
            )
            self._resolutions[tolerance] = found
        return self._resolutions[tolerance]

    @property
    def ground(self) -> GroundWeather:
        """The weather at the telescope."""
        return on_the_ground(
            self.profile,
            self.time,
            None if self.parameters.wind == "profile" else self.layers[0].wind,
        )

    def means(self) -> dict[str, SmoothField]:
        """Mean emission and transmission over the scan, at nodes of their own."""
        chosen, n = self.resolution(), self.observation.n_samples
        nodes, step = chosen.mean_nodes, chosen.mean_step
        index = times_with_margin(n, step)
        elevation = np.arcsin(
            rays(axes_at(self.observation.boresight_azel, index, step), nodes.xi, nodes.eta)[2]
        )
        # The margin of the spline is an extrapolated path: it stays inside the limits of the
        # radiative transfer.
        inside = (index >= 0) & (index < n)
        elevation[:, ~inside] = np.clip(elevation[:, ~inside], ELEVATION_MIN, ELEVATION_MAX)
        values = {"atmosphere": self.band.emission, "transmission": self.band.transmission}
        return {
            k: SmoothField.from_values(nodes.weights, f(self.pwv, elevation), step, n)
            for k, f in values.items()
        }


@dataclass
class Models:
    """The scene of an operator's observations, and the last models that were built."""

    _time: Instant | None = field(default=None, compare=False)
    _weather: WeatherSource | None = field(default=None, compare=False)
    _planes: dict[str, ScanPlane] = field(default_factory=dict, compare=False)
    _bands: dict[Any, tuple[Profile, BandAtmosphere]] = field(default_factory=dict, compare=False)
    _made: list[tuple[str, AtmosphereModel]] = field(default_factory=list, compare=False)

    def of_run(self, data: Data) -> Models:
        """Models of a run, which begins at one time in one weather, and whose scans follow each
        other through the same layers.
        """
        planes = dict(
            zip((o.name for o in data.observations), scan_planes(data.observations), strict=True)
        )
        return Models(data.scene.time, data.scene.weather, planes, self._bands)

    def of(self, parameters: LayerParameters, observation: Observation) -> AtmosphereModel:
        """The model of one observation."""
        key = f"{parameters!r} {parameters.label} {observation.seed}"
        for known, model in self._made:
            if known == key and model.observation is observation:
                return model
        plane = self._planes.get(observation.name) or scan_planes([observation])[0]
        profile, band = self.weather(parameters, observation)
        # A planner changes parameters in copies of the operator; the model keeps those that it was
        # built with.
        made = AtmosphereModel(
            parameters.model_copy(),
            observation,
            plane,
            profile,
            band,
            self._time or observation.start,
        )
        self._made = [*self._made[1 - MODELS_KEPT :], (key, made)]
        return made

    def weather(
        self,
        parameters: LayerParameters,
        observation: Observation,
    ) -> tuple[Profile, BandAtmosphere]:
        """One weather for the run: the scene's at its start; and the band's response to it."""
        time, band = self._time or observation.start, observation.instrument.band
        vapour = parameters.pwv, parameters.pwv_rms, parameters.spectra
        key = (
            repr(observation.site),
            time,
            repr(band),
            repr(self._weather),
            observation.seed,
            *vapour,
        )
        if key not in self._bands:
            profile = profile_of(
                self._weather,
                observation.site,
                time,
                observation.seed,
                parameters.pwv,
            )
            largest = largest_pwv(parameters.pwv or profile.pwv, parameters.pwv_rms)
            self._bands[key] = (
                profile,
                BandAtmosphere(band, profile, largest, absorption_of(parameters)),
            )
        return self._bands[key]


@dataclass(frozen=True)
class ExpectedLoad:
    """Announcement of an `AtmosphereLayers` to other steps: the expected load as a call, and its
    model.
    """

    models: Models
    parameters: LayerParameters
    observation: Observation

    def __call__(self) -> tuple[float, float]:
        """Mean emission [K_RJ] and transmission in the middle of a scan, before its model is
        built.
        """
        profile, band = self.models.weather(self.parameters, self.observation)
        elevation = _inside(float(np.median(self.observation.elevation)))
        pwv = self.parameters.pwv or profile.pwv
        return float(band.emission(pwv, elevation)), float(band.transmission(pwv, elevation))

    def announce(self) -> None:
        """Let other steps know, and the other bands of the camera (`Observation.common`)."""
        scan = self.observation
        scan.expected_load, scan.load_spectra = self, self.spectra
        loads: dict[str, ExpectedLoad] = scan.once((self.parameters.label, "loads"), dict)
        loads[scan.name] = self

    def spectra(self) -> LoadSpectra:
        """The atmosphere over the passband at elevations that the scan sees, before its model is
        built.
        """
        profile, band = self.models.weather(self.parameters, self.observation)
        low, high = np.log(np.sin(elevation_range(self.observation, True)))
        number = 2 + math.ceil((high - low) / AIRMASS_STEP)
        elevations = np.arcsin(np.minimum(np.exp(np.linspace(low, high, number)), 1.0))
        return band.transfer.spectra(self.parameters.pwv or profile.pwv, elevations.tolist())

    def model(self) -> AtmosphereModel:
        """The model that the observation was, or will be, drawn from."""
        return self.models.of(self.parameters, self.observation)


def _inside(elevation: float) -> float:
    """The elevation [rad], within the limits of the radiative transfer."""
    return min(max(elevation, ELEVATION_MIN), ELEVATION_MAX)


def elevation_range(observation: Observation, field: bool = False) -> Floats:
    """Lowest and highest elevation [rad] of the boresight, or of the field, within these limits."""
    elevation = observation.elevation
    reach = math.atan(observation.focalplane.radius) if field else 0.0
    ends = [float(elevation.min()) - reach, float(elevation.max()) + reach]
    return np.clip(ends, ELEVATION_MIN, ELEVATION_MAX)


def absorption_of(parameters: LayerParameters) -> AbsorptionTable:
    """The registered cross-sections that the parameters name."""
    table = spectra.create(parameters.spectra)
    if not isinstance(table, AbsorptionTable):
        raise InputError(
            f"spectra {parameters.spectra!r} is {type(table).__name__}, not an AbsorptionTable",
            place=parameters.label,
            cure="choose another table, or mend the plugin (docs/plugins.md)",
        )
    return table


def beam_sigma(telescope: Telescope, band: Band, distance: float) -> float:
    """Standard deviation [m] of the beam at a distance [m] along the line of sight: D sqrt(1 +
    (z/z_r)^2) / 2.3548.

    From the paper's near-field FWHM(z) = D sqrt(z^-2 + z_r^-2) rad, z_r = pi (D/2)^2 / lambda at
    the band centre.
    """
    return _width(telescope, band, distance) / FWHM_PER_SIGMA


def _width(telescope: Telescope, band: Band, distance: float) -> float:
    return widened(telescope.diameter, SPEED_OF_LIGHT / band.centre, distance)


def _shares(parameters: LayerParameters, profile: Profile, heights: Floats) -> Floats:
    """a_l: by vapour density times thickness, or equal."""
    share = np.ones(len(heights))
    if parameters.weights == "vapour":
        thickness = np.gradient(heights) if len(heights) > 1 else share
        share = np.asarray(profile.at(heights).vapour_density) * thickness
    if not share.sum() > 0:
        raise InputError(
            "the atmosphere is dry at every layer",
            place=parameters.label,
            cure="set weights: equal, or lower the layers",
        )
    return np.asarray(share / np.sqrt((share**2).sum()), np.float64)


def _winds(parameters: LayerParameters, profile: Profile, heights: Floats) -> Sequence[Floats]:
    wind = parameters.wind
    if isinstance(wind, str):
        found = profile.at(heights)
        return list(np.stack([found.wind_east, found.wind_north], axis=-1))
    return [one.vector for one in wind] if isinstance(wind, list) else [wind.vector] * len(heights)
