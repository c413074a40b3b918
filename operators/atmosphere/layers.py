"""`AtmosphereLayers`: turbulent layers of water vapour that drift over the telescope, their emission and their opacity.

The water along a line of sight is

    PWV_los = airmass PWV (1 + y),    y = p sum_l a_l g_l,    sum_l a_l^2 = 1                                    (1)

with g_l the unit-variance von Karman field of layer l (`turbulence`), seen through the near-field beam at the layer's
distance, and p the ensemble rms. Emission and transmission of the band follow from radiative transfer at PWV (1 + y) and the
elevation of the ray (`response`). All of it is smooth, so it is computed at nodes (`nodes`) and interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, PrivateAttr, field_validator, model_validator

from zonda.core.configuration.diagnostics import refusal
from zonda.core.configuration.parameters import Parameters, quantity
from zonda.core.configuration.units import Angle, Fraction, Metres, MetresPerSecond
from zonda.core.data import Block, Data, Observation, Tally
from zonda.core.errors import InputError, PointingError, ZondaError
from zonda.core.instrument import SPEED_OF_LIGHT, Band, Telescope
from zonda.core.knobs import Knob
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.core.types import Floats

from .fluctuations import AtNodes, OfDetectors, times
from .path_delay import delay_per_vapour
from .resolution import Plan, make_plan
from .response import Response
from .turbulence.beams import GAUSSIAN_FWHM, Aperture, rayleigh_distance, widened
from .turbulence.geometry import Track, axes_at, rays, tracks
from .turbulence.lattice import Turbulence
from .turbulence.lines_of_sight import LinesOfSight
from .turbulence.nodes import LayerModel, times_with_margin
from .turbulence.sampling import Drifting, Layers
from .weather import profiles
from .weather.absorption import AbsorptionTable
from .weather.bands import BandAtmosphere
from .weather.radiative_transfer import ELEVATION_MAX, ELEVATION_MIN
from .weather.sources import air_of, on_the_ground

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate, Traits

    from .weather.profiles import Profile

LOG_NORMAL_FROM = 0.15
"""PWV rms from which y is exp(s g - s^2 var(g) / 2) - 1, so that water stays positive (below, 1 + y < 0 takes 6.7 sigma)."""

PLANES = {
    "transverse": "transverse to the mean line of sight",
    "cone": "the unrolled cone of the mean elevation (wide throw or field)",
    "horizontal": "horizontal (the throw is too wide to unroll)",
}

CERTAIN = 5.0
"""Sigma up to which the water must lie inside the table: what is beyond is clipped, and counted."""

LARGEST_DEVIATION = 8
"""Sigma of the water that `response` covers by polynomials; beyond, it takes the slow way."""

EDGE_TAPER = 10.0
"""dB: power at the rim of a tapered aperture below that at its centre, where none is given."""


class Wind(Parameters):
    """A horizontal wind."""

    speed: MetresPerSecond = Field(ge=0, le=200)
    """How fast the air moves."""
    direction: Angle = quantity("270 deg")
    """Where the wind comes from, from north through east, as weather reports give it (270 deg: a west wind)."""

    @property
    def vector(self) -> Floats:
        """Velocity of the air towards (east, north), m/s."""
        return -self.speed * np.array([math.sin(self.direction), math.cos(self.direction)])


@dataclass(frozen=True)
class Layer:
    """One layer: height above the site [m], share a_l, and velocity of its air (east, north) [m/s]."""

    height: float
    amplitude: float
    wind: Floats


@dataclass(frozen=True)
class _Laid:
    """What `AtmosphereLayers.configure` hands on to `prepare`: weather, layers as one observation sees them, nodes and steps."""

    profile: Profile
    band: BandAtmosphere
    pwv: float
    layers: list[Layer]
    models: list[LayerModel]
    beams: list[Turbulence]
    variance: float
    plan: Plan


@dataclass(frozen=True)
class _Drawn:
    """What `AtmosphereLayers.prepare` made of one observation."""

    operator: AtmosphereLayers
    state: AtNodes
    means: dict[str, SmoothField]
    tally: Tally


class _Provides:
    """The streams of an `AtmosphereLayers`: those of every one, and its `outputs`."""

    def __get__(self, operator: AtmosphereLayers | None, owner: type) -> frozenset[str]:
        return frozenset({"atmosphere", "transmission", *(operator.outputs if operator else ())})


class AtmosphereLayers(Operator):
    """Turbulent layers of water vapour, seen through near-field beams, as emission and opacity of the band.

    Sets ``observation.smooth["atmosphere"]`` (mean emission, K_RJ) and ``["transmission"]`` (band-mean e^-tau), and adds the
    fluctuation of the emission to the stream ``atmosphere`` and that of the transmission, relative, to ``transmission``.
    With `outputs` it also makes streams of the fluctuation along each line of sight: ``pwv`` (m), ``opacity`` (of the band)
    and ``path_delay`` (m of excess path, non-dispersive).
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[Any] = _Provides()
    knows_means: ClassVar[bool] = True
    prepares_ahead: ClassVar[bool] = True
    only_tells: ClassVar[bool] = True
    knobs: ClassVar[tuple[Knob, ...]] = (
        Knob("tolerance", ("30 %", "10 %", "3 %", "1 %", "0.3 %", "0.1 %"), "layers evaluated at nodes of field and time"),
        Knob("lattice", (0.6, 0.3, 0.15), "turbulence interpolated between the points of its lattice"),
        Knob("fidelity", ("default", "fine"), "covariance of the turbulence by compact kernels", redraws=True),
        Knob("layers", (5, 10, 20), "thin sheets for a continuous atmosphere", redraws=True),
    )

    pwv: Metres | None = Field(None, gt=0, le=profiles.PWV_MAX)
    """Mean precipitable water vapour at zenith; where absent, that of the scene's `weather` (by default the climatology's median
    for the date and hour). A scene whose weather gives another PWV is refused: it would be given twice."""
    pwv_rms: Fraction = quantity("0.5 %", ge=0, le=1)
    """Ensemble rms of the water along a line of sight, as a fraction of its mean (at one point of the sky, over all weather)."""
    pwv_rms_after_beam: bool = False
    """Whether `pwv_rms` is what the telescope sees, or what a pencil beam would see (the beam smooths a part away)."""
    layers: int = Field(10, ge=1, le=200)
    """Number of layers, evenly spaced from `lowest` to `highest` (a single one lies at `lowest`)."""
    lowest: Metres = quantity("500 m", gt=0, le=20000)
    """Height of the lowest layer above the site."""
    highest: Metres = quantity("5000 m", gt=0, le=20000)
    """Height of the highest layer above the site."""
    weights: Literal["vapour", "equal"] = "vapour"
    """How the fluctuation is shared among the layers: by vapour density times thickness, or equally."""
    outer_scale: Metres = quantity("500 m", gt=0)
    """Outer scale r0 of the turbulence (van Marrewijk et al. 2024), a length in the von Karman covariance."""
    wind: Literal["profile"] | Wind | list[Wind] = "profile"
    """The weather's wind at each layer's height (see `weather: wind`), or one wind for all layers, or a list of one for each."""
    fidelity: Literal["default", "fine"] = "default"
    """Accuracy of the turbulence: its covariance is within 0.08 % or 0.01 % of the variance (docs/atmosphere.md)."""
    beam: Literal["gaussian", "top_hat", "tapered"] = "gaussian"
    """Footprint in a layer: the paper's Gaussian of FWHM D, the uniform disc of diameter D, or one that falls towards its rim."""
    edge_taper: float | None = Field(None, gt=0, le=60)
    """With `beam: tapered`, dB by which the illumination's power falls from the centre to the rim; 10 where absent."""
    outputs: list[Literal["pwv", "opacity", "path_delay"]] = Field(default_factory=list)
    """Further streams to make: fluctuations of the line-of-sight water (m), of the band's opacity, of the wet path delay (m)."""
    spectra: str = "am"
    """Cross-sections of the air: a registered table of them (`zonda plugins`); am's in cells of 0.5 GHz by default."""
    omit: list[int] = Field(default_factory=list)
    """Layers that are left out, the lowest is 0; the others stay as they are (their shares, their air)."""
    lattice: float | None = Field(None, gt=0, le=0.8)
    """Largest spacing of the turbulence lattice, in units of the beam's sigma at the layer (a power of two metres is used);
    where absent that of the `fidelity`, 0.8 or 0.5."""
    tolerance: Fraction = quantity("1 %", ge=1e-4, le=1)
    """Rms error of the evaluation at nodes over the field, and of that at steps in time, each as a fraction of what the
    focal-plane mean, subtracted, leaves of the atmosphere (without nodes: of the steps alone, 1.4 times as much)."""

    _origin: Any = PrivateAttr(None)
    _source: Any = PrivateAttr(None)
    _tracks: dict[str, Track] = PrivateAttr(default_factory=dict)
    _air: dict[Any, tuple[Profile, BandAtmosphere]] = PrivateAttr(default_factory=dict)
    _looked: dict[str, Any] = PrivateAttr(default_factory=dict)

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
    def _consistent(self) -> AtmosphereLayers:
        if self.layers > 1 and not self.lowest < self.highest:
            raise ValueError("lowest must be below highest")
        of_many = {"highest", "weights"} & self.model_fields_set
        if self.layers == 1 and of_many:
            raise ValueError(f"{sorted(of_many)[0]} needs several layers; a single one lies at lowest")
        if any(not 0 <= k < self.layers for k in self.omit):
            raise ValueError(f"omit names layers 0 to {self.layers - 1}, the lowest first")
        if isinstance(self.wind, list) and len(self.wind) != self.layers:
            raise ValueError(f"wind lists {len(self.wind)} winds for {self.layers} layers")
        if self.edge_taper is not None and self.beam != "tapered":
            raise ValueError("edge_taper is for beam: tapered")
        return self

    def observe(self, data: Data) -> None:
        """Note when the run begins and how its scans follow each other: all of them look through the same drifting air."""
        self.agree(data)
        self._tracks = dict(zip((o.name for o in data.observations), tracks(data.observations), strict=True))

    def agree(self, data: Data, before: Mapping[str, Any] | None = None) -> Mapping[str, Any] | None:
        """Say what the load will be about: map makers lay out their sums for the noise that follows from it."""
        self._origin, self._source = data.scene.time, data.scene.weather
        for observation in data.observations:
            observation.expected_load = partial(self._expected_load, observation)
        return None

    def configure(self, observation: Observation) -> None:
        """Set the smooth means: noise levels that follow from the load need them before any step is prepared."""
        drawn = self._drawn(observation)
        if drawn is not None:
            observation.smooth.update(drawn.means)
            return
        laid = observation.resolved[f"{self.label} laid out"] = self._lay_out(observation)
        _means(observation, laid.plan, laid.band, laid.pwv)

    def prepare(self, observation: Observation) -> AtNodes | OfDetectors:
        """Lay out the turbulence, draw it at the nodes.

        What is drawn at nodes is kept for the companion runs, which see the same air, unless it is larger than the pointing.
        """
        drawn = self._drawn(observation)
        if drawn is not None:
            observation.smooth.update(drawn.means)
            observation.tally.update(drawn.tally)
            return drawn.state
        key = f"{self.label} drawn {observation.seed}"
        whole, observation.tally = observation.tally, Tally()
        try:
            state = self._prepare(observation)
            if isinstance(state, AtNodes) and state.nbytes <= observation.boresight_azel.nbytes:
                means = {name: observation.smooth[name] for name in ("atmosphere", "transmission")}
                observation.resolved[key] = _Drawn(self, state, means, observation.tally)
        finally:
            whole.update(observation.tally)
            observation.tally = whole
        return state

    def _drawn(self, observation: Observation) -> _Drawn | None:
        """What an earlier run of the same observation drew."""
        drawn: _Drawn | None = observation.resolved.get(f"{self.label} drawn {observation.seed}")
        return drawn if drawn is not None and drawn.operator is self else None

    def _expected_load(self, observation: Observation) -> tuple[float, float]:
        profile, band = self._weather(observation)
        elevation = min(max(float(np.median(observation.elevation)), ELEVATION_MIN), ELEVATION_MAX)
        pwv = self.pwv or profile.pwv
        return float(band.emission(pwv, elevation)), float(band.transmission(pwv, elevation))

    def _lay_out(self, observation: Observation) -> _Laid:
        _check_pointing(observation)
        track = self._track(observation)
        profile, band = self._weather(observation)
        pwv = self.pwv or profile.pwv
        layers = self._layers(profile)
        wind = None if self.wind == "profile" else layers[0].wind
        observation.weather = on_the_ground(profile, self._origin or observation.start, wind)
        models = [_model(self, layer, track, observation) for layer in layers]
        beams = [_turbulence(self, observation, n, m) for n, m in enumerate(models)]
        variance = sum(m.amplitude**2 * b.variance for m, b in zip(models, beams, strict=True))
        key = f"{self.label} plan"  # kept for the companion runs
        if key not in observation.resolved:
            winds = [layer.wind for layer in layers]
            made = make_plan(observation, track, models, winds, variance, self.tolerance, band, pwv, self.pwv_rms)
            observation.resolved[key] = made
        return _Laid(profile, band, pwv, layers, models, beams, variance, observation.resolved[key])

    def _track(self, observation: Observation) -> Track:
        return self._tracks.get(observation.name) or tracks([observation])[0]

    def _prepare(self, observation: Observation) -> AtNodes | OfDetectors:
        if f"{self.label} laid out" not in observation.resolved:
            self.configure(observation)
        laid: _Laid = observation.resolved.pop(f"{self.label} laid out")
        profile, band, pwv, layers, models, beams = laid.profile, laid.band, laid.pwv, laid.layers, laid.models, laid.beams
        variance, plan, track = laid.variance, laid.plan, self._track(observation)
        for what, text in profile.stated:
            if what != "wind" or self.wind == "profile":
                observation.tally.state(self.label, what, text)
        scale = self.pwv_rms / math.sqrt(variance) if self.pwv_rms_after_beam else self.pwv_rms
        parts = zip(beams, layers, plan.steps, strict=True)
        drifting = [Drifting(beam, layer.height, layer.amplitude, layer.wind, step) for beam, layer, step in parts]
        drifting = [d for k, d in enumerate(drifting) if k not in self.omit]
        n = observation.n_samples
        first, count = times(slice(0, n), plan.step)
        kind = np.float64 if plan.nodes.shape else np.float32
        points = plan.nodes.xi, plan.nodes.eta
        turbulence = Layers(observation, track, *points, drifting, plan.step, first, first + count, kind)

        shares, heights = np.array([layer.amplitude for layer in layers]), np.array([layer.height for layer in layers])
        vapour_height = float(shares @ heights / shares.sum())
        per_vapour = delay_per_vapour(np.asarray(profile.at(heights).temperature), shares)
        path = turbulence.paths[plan.step]
        names = ("emission", "transmission", *dict.fromkeys(self.outputs))
        self._check_range(scale, variance, pwv)
        y_range = self._range(scale, variance, band.pwv_max / pwv - 1)
        response = Response(band, pwv, *y_range, path.low, path.high, vapour_height, per_vapour, names)

        def water(g: Floats, own: slice) -> Floats:
            return self._clip(observation, self._water(g, scale, variance), band.pwv_max / pwv - 1, own)

        self._state(observation, track, plan, models, beams, pwv, scale, variance, path)
        if "path_delay" in self.outputs:
            observation.tally.state(self.label, "wet path delay", f"{per_vapour:.3f} times the water (non-dispersive)")
        make = AtNodes.make if plan.nodes.shape else OfDetectors
        state = make(plan.nodes, turbulence, water, response, plan.step, n)
        self._state_drawn(observation, state)
        return state

    def collect(self, data: Data, observation: Observation, state: AtNodes | OfDetectors) -> None:
        """Report the mean and rms of the water that was drawn while the blocks were worked on."""
        self._state_drawn(observation, state)

    def memory(self, observation: Observation) -> int:
        """Tables, tiles of the turbulence, weights of some nodes. The nodes themselves are chosen in `prepare`."""
        return 100_000_000 + 700 * observation.n_detectors + 40 * observation.n_samples

    def in_time_order(self, observation: Observation, state: AtNodes | OfDetectors) -> bool:
        """Where detectors are evaluated one by one and the scan is long, all of them share the air of the moment."""
        return not state.fits

    def traits(self, observation: Observation) -> Traits:
        """rms of the fluctuation."""
        from .planning import atmosphere_traits

        return atmosphere_traits(self, observation)

    def estimate(self, context: Context) -> Estimate:
        """Layers, their resolution, the spectrum of the air, slopes with elevation."""
        from .planning import atmosphere_estimate

        return atmosphere_estimate(self, context)

    def exec(self, block: Block, state: AtNodes | OfDetectors) -> None:
        """Add the fluctuations to the block's ``atmosphere`` and ``transmission``, and to the `outputs`."""
        streams: dict[str, str] = {"emission": "atmosphere", "transmission": "transmission"}
        streams.update((name, name) for name in self.outputs)
        made = {}
        for name, stream in streams.items():
            there = stream in block.detdata
            made[name] = block.buffer(f"{self.label} {name}", block.shape) if there else block.new(stream, zero=False)
        state.into(block.detectors, block.samples, made)
        for name, stream in streams.items():
            if block.detdata[stream] is not made[name]:
                block.detdata[stream] += made[name]

    # ------------------------------------------------------------------------------------------------------------------------

    def _weather(self, observation: Observation) -> tuple[Profile, BandAtmosphere]:
        """One weather for the run: the scene's at its start."""
        time: Instant = self._origin or observation.start
        band: Band = observation.instrument.band
        key = (repr(observation.site), time, self.pwv, repr(band), repr(self._source), observation.seed, self.spectra)
        if key not in self._air:
            profile = air_of(self._source, observation.site, time, observation.seed, self.pwv)
            rise = math.exp(7 * self._log_width(1.0)) if self.pwv_rms >= LOG_NORMAL_FROM else 1 + 8 * self.pwv_rms
            largest = min((self.pwv or profile.pwv) * max(rise, 1.05), profiles.PWV_MAX)
            self._air[key] = profile, BandAtmosphere(band, profile, largest, self._table())
        return self._air[key]

    def _table(self) -> AbsorptionTable:
        from zonda.core.registry import spectra

        table = spectra.create(self.spectra)
        if not isinstance(table, AbsorptionTable):
            raise InputError(
                f"spectra {self.spectra!r} is {type(table).__name__}, not an AbsorptionTable",
                place=self.label,
                cure="choose another table, or mend the plugin (docs/plugins.md)",
            )
        return table

    def _layers(self, profile: Profile) -> list[Layer]:
        heights = np.linspace(self.lowest, self.highest, self.layers)
        air = profile.at(heights)
        share = np.ones(self.layers) if self.weights == "equal" else np.asarray(air.vapour_density) * _thickness(heights)
        if not share.sum() > 0:
            raise InputError("the air is dry at every layer", place=self.label, cure="set weights: equal, or lower the layers")
        share = share / np.sqrt((share**2).sum())
        if isinstance(self.wind, str):
            winds = list(np.stack([air.wind_east, air.wind_north], axis=-1))
        elif isinstance(self.wind, Wind):
            winds = [self.wind.vector] * self.layers
        else:
            winds = [w.vector for w in self.wind]
        return [Layer(float(h), float(a), np.asarray(w, np.float64)) for h, a, w in zip(heights, share, winds, strict=True)]

    def _log_width(self, variance: float) -> float:
        """s of the log-normal map: exp(s g) has the relative rms p where g has the given variance."""
        return math.sqrt(math.log1p(self.pwv_rms**2) / variance)

    def _water(self, g: Floats, scale: float, variance: float) -> Floats:
        """y of equation (1), or its log-normal form of equal mean and rms."""
        if self.pwv_rms < LOG_NORMAL_FROM:
            return scale * g
        s = self._log_width(variance if self.pwv_rms_after_beam else 1.0)
        return np.expm1(s * g - s * s * variance / 2)

    def _range(self, scale: float, variance: float, top: float) -> tuple[float, float]:
        """Fluctuations that may come up."""
        ends = self._water(LARGEST_DEVIATION * math.sqrt(variance) * np.array([-1.0, 1.0]), scale, variance)
        return max(float(ends[0]), -1.0), min(float(ends[1]), top)

    def _check_range(self, scale: float, variance: float, pwv: float) -> None:
        """Refuse water whose distribution the table would cut."""
        most = pwv * (1 + float(self._water(np.array([CERTAIN * math.sqrt(variance)]), scale, variance)[0]))
        if most > profiles.PWV_MAX:
            least = math.log(max(profiles.PWV_MAX / pwv, 1.0))
            width = CERTAIN - math.sqrt(max(CERTAIN**2 - 2 * least, 0.0))
            fits = (profiles.PWV_MAX / pwv - 1) / CERTAIN
            fits = fits if fits < LOG_NORMAL_FROM else math.sqrt(math.expm1(width**2))
            raise InputError(
                f"a PWV of {pwv * 1e3:.3g} mm with a rms of {self.pwv_rms:.3g} of it reaches {most * 1e3:.3g} mm at {CERTAIN:g} "
                f"sigma; the limit is {profiles.PWV_MAX * 1e3:.0f} mm",
                place=self.label,
                cure=f"lower pwv_rms to {fits:.1%} or less, or the PWV",
            )

    def _clip(self, observation: Observation, y: Floats, top: float, own: slice) -> Floats:
        count = 0
        if y.min() < -1 or y.max() > top:
            clipped = np.clip(y, -1.0, top)
            count, y = int((clipped != y)[:, own].sum()), clipped
        observation.tally.count(self.label, "values of the water clipped to the table", count)
        return y

    def _state_drawn(self, observation: Observation, state: AtNodes | OfDetectors) -> None:
        count, total, squares = state.drawn()
        if count:
            mean = total / count
            rms = math.sqrt(max(squares / count - mean**2, 0.0))
            text = f"mean {mean:+.3%}, rms {rms:.3%} of the mean PWV, over the field and the scan"
            observation.tally.state(self.label, "water of this realization", text)

    def _state(
        self,
        observation: Observation,
        track: Track,
        plan: Plan,
        models: list[LayerModel],
        beams: list[Turbulence],
        pwv: float,
        scale: float,
        variance: float,
        path: LinesOfSight,
    ) -> None:
        def say(what: str, text: str) -> None:
            observation.tally.state(self.label, what, text)

        before, after = scale, scale * math.sqrt(variance)
        if self.pwv_rms >= LOG_NORMAL_FROM:
            s = self._log_width(variance if self.pwv_rms_after_beam else 1.0)
            before, after = (math.sqrt(math.expm1(s * s * v)) for v in (1.0, variance))
        say("mean PWV", f"{pwv * 1e3:.3f} mm" + ("" if self.pwv else " (of the weather)"))
        say("PWV rms", f"{before:.3%} of the mean before the beam, {after:.3%} after it")
        say("distribution of the water", "log-normal" if self.pwv_rms >= LOG_NORMAL_FROM else "normal")
        parts = (
            f"{m.height:.0f} m: {scale * m.amplitude * math.sqrt(b.variance):.3%}" for m, b in zip(models, beams, strict=True)
        )
        say("PWV rms after the beam, per layer", ", ".join(parts))
        sizes = (f"{b.sigma:.3g} m / {b.spacing:g} m" for b in beams)
        say("beam sigma / lattice spacing, per layer", ", ".join(dict.fromkeys(sizes)))
        telescope, band = observation.instrument.telescope, observation.instrument.band
        sines = math.sin(track.elevation) / np.array([path.high, path.low])
        ends = [widened(telescope.diameter, SPEED_OF_LIGHT / band.centre, models[-1].distance * k) for k in (*sines, 1.0)]
        text = f"{ends[0] / ends[2]:.3f} to {ends[1] / ends[2]:.3f} of the one used, in the highest layer"
        say("width of the beam over the elevations of field and scan", text)
        if self.beam != "gaussian":
            far = rayleigh_distance(telescope.diameter, SPEED_OF_LIGHT / band.centre)
            beyond = sum(m.distance > far for m in models)
            say("footprint", f"{self.beam}; {beyond} of {len(models)} layers lie beyond {far:.0f} m, where beams lose their rim")
        say("turbulence covariance", f"within {beams[0].fidelity.error:.1%} of the variance ({self.fidelity})")
        error = f"; expected rms error {plan.focal_plane_error:.1e} of the fluctuation" if plan.nodes.shape else ""
        say("nodes", f"{plan.nodes}{error}")
        several = len(set(plan.steps)) > 1
        steps = f"{min(plan.steps)} to {max(plan.steps)} samples, by layer" if several else f"{min(plan.steps)} samples"
        say("step in time", f"{steps}; expected rms error {plan.time_error:.1e} of the fluctuation")
        say("nodes and step of the mean emission", f"{plan.mean_nodes}; {plan.mean_step} samples")
        both = "each, for nodes and for the step" if plan.nodes.shape else "x sqrt(2) for the step"
        say("error allowed", f"{plan.tolerance:.1e} of the fluctuation {both}")
        say(
            "differential signal", f"{plan.differential:.1e} of the fluctuation is left after subtraction of the focal-plane mean"
        )
        say("plane of the turbulence", f"{PLANES[track.kind]}; squared separations within {track.bound:.1%}")
        if track.kind == "cone":
            say("wind on the unrolled cone", f"drifts within {track.drift_bound:.1%} at the ends of the scan")


def beam_sigma(telescope: Telescope, band: Band, distance: float) -> float:
    """Standard deviation [m] of the beam at a distance [m] along the line of sight: D sqrt(1 + (z/z_r)^2) / 2.3548.

    From the paper's near-field FWHM(z) = D sqrt(z^-2 + z_r^-2) rad, z_r = pi (D/2)^2 / lambda at the band centre.
    """
    return widened(telescope.diameter, SPEED_OF_LIGHT / band.centre, distance) / GAUSSIAN_FWHM


def _check_pointing(observation: Observation) -> None:
    quaternions, lowest = observation.boresight_azel, 1.0
    for some in chunks(observation.n_samples):
        x, y, *_ = part = quaternions[some].T
        if not np.isfinite(part).all():
            bad = np.flatnonzero(~np.isfinite(quaternions).all(axis=1))
            raise PointingError(
                f"the boresight of sample {bad[0]} is not a number ({len(bad)} of {observation.n_samples} samples)",
                place=observation.name,
                cure="repair the pointing, or leave these samples out",
            )
        lowest = min(lowest, 1 - 2 * float((x * x + y * y).max()))
    if lowest > math.sin(ELEVATION_MIN) + 1e-9:
        return
    elevation = observation.elevation
    if 0 <= elevation.min() < ELEVATION_MIN:
        raise PointingError(
            f"the boresight is {math.degrees(elevation.min()):.2f} deg above the horizon at sample {elevation.argmin()}; "
            "the limits of the radiative transfer are 4.5 to 90 deg",
            place=observation.name,
            cure="choose a target or a time with a higher elevation",
        )


def _means(observation: Observation, plan: Plan, band: BandAtmosphere, pwv: float) -> None:
    """Set the mean emission and transmission, at nodes of their own."""
    nodes, step = plan.mean_nodes, plan.mean_step
    elevation = _elevations(observation, nodes.xi, nodes.eta, step)
    for name, function in (("atmosphere", band.emission), ("transmission", band.transmission)):
        observation.smooth[name] = SmoothField.from_values(nodes.weights, function(pwv, elevation), step, observation.n_samples)


def _elevations(observation: Observation, xi: Floats, eta: Floats, step: int) -> Floats:
    """Elevations (len(xi), n_time) at the times that a `SmoothField` wants.

    The margin of the spline is an extrapolated path: it stays inside the limits of the radiative transfer.
    """
    index = times_with_margin(observation.n_samples, step)
    elevation = np.arcsin(rays(axes_at(observation.boresight_azel, index, step), xi, eta)[2])
    inside = (index >= 0) & (index < observation.n_samples)
    elevation[:, ~inside] = np.clip(elevation[:, ~inside], ELEVATION_MIN, ELEVATION_MAX)
    return np.asarray(elevation, np.float64)


def _thickness(heights: Floats) -> Floats:
    return np.asarray(np.gradient(heights) if len(heights) > 1 else np.ones(1), np.float64)


def _model(operator: AtmosphereLayers, layer: Layer, track: Track, observation: Observation) -> LayerModel:
    distance = track.effective(layer.height) / math.sin(track.elevation)
    telescope, band = observation.instrument.telescope, observation.instrument.band
    if operator.beam == "gaussian":
        return LayerModel(layer.amplitude, layer.height, distance, operator.outer_scale, beam_sigma(telescope, band, distance))
    taper = 0.0 if operator.beam == "top_hat" else operator.edge_taper or EDGE_TAPER
    aperture = Aperture(widened(telescope.diameter, SPEED_OF_LIGHT / band.centre, distance), taper)
    return LayerModel(layer.amplitude, layer.height, distance, operator.outer_scale, aperture.sigma, aperture)


def _turbulence(operator: AtmosphereLayers, observation: Observation, number: int, model: LayerModel) -> Turbulence:
    """The layer's field. Keyed by seed, operator and layer, not by observation: all scans see the same air."""
    return Turbulence(
        observation.seed,
        operator.label,
        "layer",
        number,
        outer_scale=model.outer_scale,
        sigma=model.sigma,
        aperture=model.aperture,
        lattice=operator.lattice,
        fidelity=operator.fidelity,
    )
