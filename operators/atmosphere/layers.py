"""`AtmosphereLayers`: turbulent layers of water vapour that drift over the telescope, their emission and their opacity.

The water along a line of sight is

    PWV_los = airmass PWV (1 + y),    y = p sum_l a_l g_l,    sum_l a_l^2 = 1                                    (1)

with g_l the unit-variance von Karman field of layer l (`turbulence`), seen through the near-field beam at the layer's
distance, and p the ensemble rms. Emission and transmission of the band follow from radiative transfer at PWV (1 + y) and the
elevation of the ray. All of it is smooth, so it is computed at nodes (`nodes`) and interpolated by `SmoothField`s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from zonda.core.configuration.parameters import Parameters, quantity
from zonda.core.configuration.units import Angle, Fraction, Metres, MetresPerSecond
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import InputError
from zonda.core.instrument import SPEED_OF_LIGHT, Band, Telescope
from zonda.core.operator import Operator
from zonda.core.smooth import SmoothField, coarse_times

from . import weather
from .band import BandAtmosphere
from .geometry import Track, axes, axes_at, crossing, rays, tracks
from .nodes import (
    MARGIN,
    LayerModel,
    Nodes,
    candidate_steps,
    choose_nodes,
    differential_rms,
    some,
    time_error,
)
from .radiative_transfer import ELEVATION_MAX, ELEVATION_MIN
from .turbulence import Turbulence, interpolate
from .weather_sources import air_of

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant

    from .weather import Profile

Floats = NDArray[np.float64]

LOG_NORMAL_FROM = 0.15
"""PWV rms from which y is exp(s g - s^2 var(g) / 2) - 1, so that water stays positive (below, 1 + y < 0 takes 6.7 sigma)."""

SMALLEST_DIFFERENCE = 1e-5
"""Share of the fluctuation that must differ between detectors for `tolerance` to be judged by it."""

SPEEDS = 4096
"""Samples of a scan, at least half as many and evenly spaced, from which the distribution of its speed is taken."""

CELLS_AT_ONCE = 1 << 20
"""Lattice points made at a time: bounds the memory."""

CELLS_IN_ALL = 4e9
"""Lattice points of one layer and scan beyond which the run is refused."""


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
class Fluctuations:
    """What `AtmosphereLayers.exec` evaluates: emission [K_RJ] and relative transmission about their means."""

    emission: SmoothField
    transmission: SmoothField


class AtmosphereLayers(Operator):
    """Turbulent layers of water vapour, seen through near-field beams, as emission and opacity of the band.

    Sets ``observation.smooth["atmosphere"]`` (mean emission, K_RJ) and ``["transmission"]`` (band-mean e^-tau), and adds the
    fluctuation of the emission to the stream ``atmosphere`` and that of the transmission, relative, to ``transmission``.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset({"atmosphere", "transmission"})

    pwv: Metres | None = Field(None, gt=0, le=weather.PWV_MAX)
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
    """Accuracy of the turbulence: its covariance is within 0.16 % or 0.03 % of the variance."""
    lattice: float = Field(0.6, gt=0, le=0.6)
    """Largest spacing of the turbulence lattice, in units of the beam's sigma at the layer (a power of two metres is used)."""
    tolerance: Fraction = quantity("1 %", ge=1e-4, le=1)
    """Rms error of the evaluation at nodes, as a fraction of what the focal-plane mean, subtracted, leaves of the atmosphere."""

    _origin: Any = PrivateAttr(None)
    _source: Any = PrivateAttr(None)
    _tracks: dict[str, Track] = PrivateAttr(default_factory=dict)
    _air: dict[Any, tuple[Profile, BandAtmosphere]] = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> AtmosphereLayers:
        if self.layers > 1 and not self.lowest < self.highest:
            raise ValueError("lowest must be below highest")
        of_many = {"highest", "weights"} & self.model_fields_set
        if self.layers == 1 and of_many:
            raise ValueError(f"{sorted(of_many)[0]} needs several layers; a single one lies at lowest")
        if isinstance(self.wind, list) and len(self.wind) != self.layers:
            raise ValueError(f"wind lists {len(self.wind)} winds for {self.layers} layers")
        return self

    def observe(self, data: Data) -> None:
        """Note when the run begins and how its scans follow each other: all of them look through the same drifting air."""
        self._origin, self._source = data.scene.time, data.scene.weather
        self._tracks = dict(zip((o.name for o in data.observations), tracks(data.observations), strict=True))

    def prepare(self, observation: Observation) -> Fluctuations:
        """Draw the turbulence at the nodes; set the smooth means."""
        track = self._tracks.get(observation.name) or tracks([observation])[0]
        profile, band = self._weather(observation)
        pwv = self.pwv or profile.pwv
        layers = self._layers(profile)
        models = [_model(layer, track, observation, self.outer_scale) for layer in layers]
        for what, text in profile.stated:
            if what != "wind" or self.wind == "profile":
                observation.tally.state(self.label, what, text)
        beams = [_turbulence(self, observation, n, m) for n, m in enumerate(models)]
        variance = sum(m.amplitude**2 * b.variance for m, b in zip(models, beams, strict=True))
        scale = self.pwv_rms / math.sqrt(variance) if self.pwv_rms_after_beam else self.pwv_rms

        key = f"{self.label} plan"  # kept for the companion runs
        if key not in observation.resolved:
            observation.resolved[key] = _plan(self, observation, track, layers, models, variance, band, pwv)
        plan: Plan = observation.resolved[key]
        index = coarse_times(observation.n_samples, plan.step)
        index = np.r_[index[0] + plan.step * np.arange(-MARGIN, 0), index, index[-1] + plan.step * np.arange(1, MARGIN + 1)]
        seconds = float(observation.seconds[0]) + index / observation.sample_rate
        u = rays(axes_at(observation.boresight_azel, index, plan.step), plan.nodes.xi, plan.nodes.eta)
        inside = (index >= 0) & (index < observation.n_samples)
        elevation = np.arcsin(u[2])
        # The margin of the spline is an extrapolated path: it stays inside the limits of the radiative transfer.
        elevation[:, ~inside] = np.clip(elevation[:, ~inside], ELEVATION_MIN, ELEVATION_MAX)

        g = np.zeros(elevation.shape)
        for layer, beam in zip(layers, beams, strict=True):
            across, along = track.positions(crossing(u), seconds, layer.height, layer.wind)
            sample(beam, across, along, layer.amplitude, g)
        y = self._water(g, scale, variance)
        y = self._clip(observation, y, pwv, band)

        def field(values: Floats) -> SmoothField:
            return SmoothField.from_values(plan.nodes.weights, values, plan.step, observation.n_samples)

        observation.smooth["atmosphere"] = field(band.emission(pwv, elevation))
        observation.smooth["transmission"] = field(band.transmission(pwv, elevation))
        self._state(observation, track, plan, models, beams, pwv, scale, variance)
        ratio = np.expm1(band.log_transmission_difference(pwv, pwv * y, elevation))
        return Fluctuations(field(band.emission_difference(pwv, pwv * y, elevation)), field(ratio))

    def exec(self, block: Block, state: Fluctuations) -> None:
        """Add the fluctuations to the block's ``atmosphere`` and ``transmission``."""
        for name, field in (("atmosphere", state.emission), ("transmission", state.transmission)):
            if name in block.detdata:
                block.detdata[name] += field.evaluate(block.detectors, block.samples, np.empty(block.shape, block.dtype))
            else:
                field.evaluate(block.detectors, block.samples, block.new(name))

    # ------------------------------------------------------------------------------------------------------------------------

    def _weather(self, observation: Observation) -> tuple[Profile, BandAtmosphere]:
        """One weather for the run: the scene's at its start."""
        time: Instant = self._origin or observation.start
        band: Band = observation.instrument.band
        key = (repr(observation.site), time, self.pwv, repr(band), repr(self._source), observation.seed)
        if key not in self._air:
            profile = air_of(self._source, observation.site, time, observation.seed, self.pwv)
            rise = math.exp(7 * self._log_width(1.0)) if self.pwv_rms >= LOG_NORMAL_FROM else 1 + 8 * self.pwv_rms
            largest = min((self.pwv or profile.pwv) * max(rise, 1.05), weather.PWV_MAX)
            self._air[key] = profile, BandAtmosphere(band, profile, largest)
        return self._air[key]

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

    def _clip(self, observation: Observation, y: Floats, pwv: float, band: BandAtmosphere) -> Floats:
        top = band.pwv_max / pwv - 1
        clipped = np.clip(y, -1.0, top)
        observation.tally.count(self.label, "node values of the water clipped to the table", int((clipped != y).sum()))
        return clipped

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
    ) -> None:
        def say(what: str, text: str) -> None:
            observation.tally.state(self.label, what, text)

        before, after = scale, scale * math.sqrt(variance)
        say("mean PWV", f"{pwv * 1e3:.3f} mm" + ("" if self.pwv else " (of the weather)"))
        say("PWV rms", f"{before:.3%} of the mean before the beam, {after:.3%} after it")
        say("distribution of the water", "log-normal" if self.pwv_rms >= LOG_NORMAL_FROM else "normal")
        parts = (
            f"{m.height:.0f} m: {scale * m.amplitude * math.sqrt(b.variance):.3%}" for m, b in zip(models, beams, strict=True)
        )
        say("PWV rms after the beam, per layer", ", ".join(parts))
        sizes = (f"{b.sigma:.3g} m / {b.spacing:g} m" for b in beams)
        say("beam sigma / lattice spacing, per layer", ", ".join(dict.fromkeys(sizes)))
        say("turbulence covariance", f"within {beams[0].fidelity.error:.1%} of the variance ({self.fidelity})")
        say("nodes", f"{plan.nodes}; expected rms error {plan.focal_plane_error:.1e} of the fluctuation")
        say("step in time", f"{plan.step} samples; expected rms error {plan.time_error:.1e} of the fluctuation")
        say("error allowed", f"{plan.tolerance:.1e} of the fluctuation each, for nodes and for the step")
        say(
            "differential signal", f"{plan.differential:.1e} of the fluctuation is left after subtraction of the focal-plane mean"
        )
        kind = "horizontal (wide throw)" if track.horizontal else "transverse to the mean line of sight"
        say("plane of the turbulence", f"{kind}; squared separations within {track.bound:.1%}")


@dataclass(frozen=True)
class Plan:
    """Nodes and step in time; the error allowed and those expected, relative to the rms of the fluctuation after the beam."""

    nodes: Nodes
    step: int
    tolerance: float
    focal_plane_error: float
    time_error: float
    differential: float


def beam_sigma(telescope: Telescope, band: Band, distance: float) -> float:
    """Standard deviation [m] of the beam at a distance [m] along the line of sight: D sqrt(1 + (z/z_r)^2) / 2.3548.

    From the paper's near-field FWHM(z) = D sqrt(z^-2 + z_r^-2) rad, z_r = pi (D/2)^2 / lambda at the band centre.
    """
    rayleigh = math.pi * (telescope.diameter / 2) ** 2 * band.centre / SPEED_OF_LIGHT
    return telescope.diameter * math.hypot(1.0, distance / rayleigh) / math.sqrt(8 * math.log(2))


def sample(beam: Turbulence, across: Floats, along: Floats, amplitude: float, out: Floats) -> None:
    """out += amplitude x the field at (across, along) [m], each (n_node, n_time), in boxes of at most `CELLS_AT_ONCE` points.

    Raises `InputError` where that would take more than `CELLS_IN_ALL` points.
    """
    x, y = across / beam.spacing, along / beam.spacing
    todo, made = [(slice(0, x.shape[0]), slice(0, x.shape[1]))], 0.0
    while todo:
        nodes, times = todo.pop()
        px, py = x[nodes, times], y[nodes, times]
        i0, i1 = math.floor(px.min()) - 1, math.floor(px.max()) + 3
        j0, j1 = math.floor(py.min()) - 1, math.floor(py.max()) + 3
        cells = (i1 - i0) * (j1 - j0)
        if cells > CELLS_AT_ONCE and px.size > 1:
            todo.extend(_halves(nodes, times, px, py))
            continue
        made += cells
        if made > CELLS_IN_ALL:
            raise InputError(
                f"a beam of {beam.sigma:.3g} m sweeps over more than {CELLS_IN_ALL:.0e} lattice points of one layer",
                place="atmosphere",
                cure="shorten the scans, narrow the field of view, or raise the lowest layer",
            )
        coefficients = beam.coefficients(i0, i1, j0, j1)
        part = np.zeros(px.shape)
        interpolate(coefficients, i0, j0, np.ascontiguousarray(px), np.ascontiguousarray(py), amplitude, part)
        out[nodes, times] += part


def _halves(nodes: slice, times: slice, x: Floats, y: Floats) -> list[tuple[slice, slice]]:
    """Cut where it makes the boxes smaller: in time, or between nodes once they spread more than the path is long."""
    spread = np.ptp(x, axis=0).max() + np.ptp(y, axis=0).max()
    path = np.ptp(x, axis=1).max() + np.ptp(y, axis=1).max()
    if x.shape[1] > 1 and (path >= spread or x.shape[0] == 1):
        middle = (times.start + times.stop) // 2
        return [(nodes, slice(middle, times.stop)), (nodes, slice(times.start, middle))]
    middle = (nodes.start + nodes.stop) // 2
    return [(slice(middle, nodes.stop), times), (slice(nodes.start, middle), times)]


def _thickness(heights: Floats) -> Floats:
    return np.asarray(np.gradient(heights) if len(heights) > 1 else np.ones(1), np.float64)


def _model(layer: Layer, track: Track, observation: Observation, outer_scale: float) -> LayerModel:
    distance = layer.height / math.sin(track.elevation)
    sigma = beam_sigma(observation.instrument.telescope, observation.instrument.band, distance)
    return LayerModel(layer.amplitude, layer.height, distance, outer_scale, sigma)


def _turbulence(operator: AtmosphereLayers, observation: Observation, number: int, model: LayerModel) -> Turbulence:
    """The layer's field. Keyed by seed, operator and layer, not by observation: all scans see the same air."""
    return Turbulence(
        observation.seed,
        operator.label,
        "layer",
        number,
        outer_scale=model.outer_scale,
        sigma=model.sigma,
        lattice=operator.lattice,
        fidelity=operator.fidelity,
    )


def _plan(
    operator: AtmosphereLayers,
    observation: Observation,
    track: Track,
    layers: list[Layer],
    models: list[LayerModel],
    variance: float,
    band: BandAtmosphere,
    pwv: float,
) -> Plan:
    """The coarsest nodes and step that keep each error below the tolerance: of the fluctuation, and of the mean emission."""
    xi, eta = observation.focalplane.xi, observation.focalplane.eta
    rms = math.sqrt(variance)
    stretch = 1 / math.sin(track.elevation) if track.horizontal else 1.0
    left = differential_rms(*some(xi, eta), models, stretch)
    # Of the rms of the fluctuation. A single detector, or none apart, is judged as if a hundredth were left.
    tolerance = operator.tolerance * (left / rms if left > SMALLEST_DIFFERENCE * rms else 0.01)

    path = _Path(observation, xi, eta)
    elevations = np.quantile(path.elevation, [0.0, 0.5, 1.0])
    slope = float(np.max(abs(_slope(band, pwv, elevations))))
    # What the mean emission may be wrong by, K_RJ: as much as the fluctuation (or 0.01 % of the water where there is none).
    kelvin = float(band.emission(pwv, elevations[1]))
    allowed = max(tolerance * kelvin * max(operator.pwv_rms, 1e-4), 1e-9)

    at_least = 1
    while True:
        nodes, error = choose_nodes(xi, eta, models, tolerance * rms, stretch, at_least)
        if nodes.shape is None or _mean_error(nodes, xi, eta, band, pwv, elevations) <= allowed:
            break
        at_least = max(nodes.shape) + 1

    for step in candidate_steps(observation.n_samples):
        if step == 1:
            late = 0.0
            break
        delta_x, delta_el = path.errors(step)
        if slope * delta_el > allowed:
            continue
        deltas = [float(np.sqrt((track.matrix @ delta_x * m.height) ** 2).max()) for m in models]
        speeds = [path.speeds(track, layer) for layer in layers]
        late = time_error(models, speeds, deltas, step / observation.sample_rate)
        if late <= tolerance * rms:
            break
    return Plan(nodes, step, tolerance, error / rms, late / rms, left / rms)


def _slope(band: BandAtmosphere, pwv: float, elevation: Floats) -> Floats:
    """d emission / d elevation, K_RJ per rad."""
    h = 1e-4
    low = np.minimum(elevation, ELEVATION_MAX - h)
    return np.asarray((band.emission(pwv, low + h) - band.emission(pwv, low)) / h, np.float64)


def _mean_error(nodes: Nodes, xi: Floats, eta: Floats, band: BandAtmosphere, pwv: float, elevations: Floats) -> float:
    """Largest error of the mean emission interpolated over the focal plane, K_RJ, at some elevations of the boresight."""
    worst = 0.0
    for elevation in elevations:
        c, s = math.cos(elevation), math.sin(elevation)

        def at(x: Floats, e: Floats, c: float = c, s: float = s) -> Floats:
            return band.emission(pwv, np.arcsin((s + e * c) / np.sqrt(1 + x * x + e * e)))

        worst = max(worst, float(abs(at(xi, eta) - nodes.weights @ at(nodes.xi, nodes.eta)).max()))
    return worst


class _Path:
    """Lines of sight of three points of the focal plane over a scan, and how well a spline in time follows them."""

    def __init__(self, observation: Observation, xi: Floats, eta: Floats) -> None:
        self._observation = observation
        centre = np.array([(xi.min() + xi.max()) / 2, (eta.min() + eta.max()) / 2])
        points = np.array([centre, [xi.max(), eta.max()], [xi.min(), eta.max()]]).T
        self._xi: Floats = points[0] if len(xi) > 1 else xi
        self._eta: Floats = points[1] if len(xi) > 1 else eta
        u = rays(axes(observation.boresight_azel), self._xi, self._eta)
        self.crossing = crossing(u)
        self.elevation = np.arcsin(u[2])
        n = len(self.elevation[0])
        some = slice(None, None, 1 + n // SPEEDS)
        self._drift = np.diff(self.crossing[:, 0])[:, some] * observation.sample_rate if n > 1 else np.zeros((2, 1))

    def speeds(self, track: Track, layer: Layer, number: int = 64) -> Floats:
        """Speeds [m/s] in the layer at quantiles of the scan, shape (<= number,)."""
        v = (track.matrix @ layer.wind)[:, None] - layer.height * (track.matrix @ self._drift)
        return np.asarray(np.quantile(np.hypot(*v), (np.arange(number) + 0.5) / number), np.float64)

    def errors(self, step: int) -> tuple[Floats, float]:
        """Rms spline errors of the crossing X (2,) and of the elevation [rad], the worst of the three points."""
        o, n = self._observation, self._observation.n_samples
        index = coarse_times(n, step)
        index = np.r_[index[0] + step * np.arange(-MARGIN, 0), index, index[-1] + step * np.arange(1, MARGIN + 1)]
        u = rays(axes_at(o.boresight_azel, index, step), self._xi, self._eta)
        truth = np.concatenate([self.crossing.reshape(-1, n), self.elevation])
        values = np.concatenate([crossing(u).reshape(-1, len(index)), np.arcsin(u[2])])
        spline = SmoothField.from_values(np.eye(len(values)), values, step, n).evaluate(slice(0, len(values)), slice(0, n))
        rms = np.sqrt(((spline - truth) ** 2).mean(1)).reshape(3, -1).max(1)
        return rms[:2], float(rms[2])
