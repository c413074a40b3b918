"""Bounds and costs of the atmosphere's effects, see `core.plan`.

Of a layer l with share a_l, variance s_l^2 behind the beam, and the band's emission T(PWV), one calibrated sample has the rms

    K a_l s_l,    K = p PWV dT/dPWV epsilon / (zeta <e^-tau>)                                                     (1)

and, where what all detectors have in common is removed, at most K times what their differences from the mean leave of it
(`nodes.differential_rms`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.instrument import Band
from zonda.core.plan.estimate import Choice, Cost, Effect, Estimate, Traits, add, full
from zonda.core.types import Floats

from .averaging import shares
from .resolution import make_plan
from .turbulence.geometry import Track, axes, crossing, rays, tracks
from .turbulence.lattice import FIDELITIES
from .turbulence.nodes import LayerModel, differential_rms, some
from .weather.bands import BandAtmosphere, _BandTransfer
from .weather.radiative_transfer import ELEVATION_MAX, ELEVATION_MIN

if TYPE_CHECKING:
    from zonda.core.data import Observation
    from zonda.core.plan.context import Context

    from .layers import AtmosphereLayers, Layer

INSTANTS = 200
"""Of a scan at which the speed through the air is looked at."""

SAFETY = 1.25
"""Factor on the ensemble rms: the rms of one scan scatters about it, the more the slower the drift over the telescope."""

POINT, TRANSFER, LATTICE = 1.2e-8, 6e-8, 4e-8
"""Seconds per point (node x time) of one layer and of the radiative transfer and splines; per lattice point."""

CHOICE = 0.02, 2e-5
"""Seconds that the choice of nodes and steps takes for each scan: a + b per detector."""

PAYS = 0.3
"""Seconds of evaluation from which coarser nodes are looked for."""


@dataclass(frozen=True)
class Air:
    """What `AtmosphereLayers` knows of one observation before it draws anything.

    ``kelvin``: K of equation (1), of the detector that sees most. ``uneven``: rms of K over the detectors, of the largest.
    ``variances`` s_l^2. ``stretch`` of distances along the elevation.
    """

    band: BandAtmosphere
    profile: Any
    pwv: float
    layers: list[Layer]
    models: list[LayerModel]
    variances: list[float]
    kelvin: float
    stretch: float
    elevations: tuple[float, float]
    velocities: list[Floats]
    points: dict[float, float] = field(default_factory=dict)
    averages: dict[str, list[float]] = field(default_factory=dict)
    uneven: float = 0.0

    @property
    def rms(self) -> float:
        """Of one calibrated sample, K."""
        return self.kelvin * math.sqrt(sum(m.amplitude**2 * v for m, v in zip(self.models, self.variances, strict=True)))

    def faster(self, layer: int, frequency: float) -> float:
        """rms of what of a layer is faster than a frequency [Hz], K.

        Along a ray at speed v the covariance exp(-(v t)^2 / 4 e) has the share erfc(2 pi f sqrt(e) / v) beyond f.
        """
        from scipy.special import erfc

        e, w = self.components[layer]
        argument = 2 * math.pi * frequency * np.divide.outer(np.sqrt(e), np.maximum(np.hypot(*self.velocities[layer]), 1e-6))
        return self.kelvin * self.models[layer].amplitude * math.sqrt(max(float(w @ erfc(argument).mean(1)), 0.0))

    @cached_property
    def components(self) -> list[tuple[Floats, Floats]]:
        """Covariance of each layer as sum w exp(-r^2 / 4 e)."""
        return [m.gaussian() for m in self.models]


def air(operator: AtmosphereLayers, observation: Observation) -> Air:
    """See `Air`. Worked out once for the last observation that was asked for."""
    known = operator._looked.get("air")
    if known is None or known[0] is not observation or known[1] != operator:
        known = operator._looked["air"] = (observation, operator.model_copy(), _air(operator, observation))
    return known[2]


def _air(operator: AtmosphereLayers, observation: Observation) -> Air:
    from .layers import _model, _turbulence

    track = operator._tracks.get(observation.name) or tracks([observation])[0]
    profile, band = operator._weather(observation)
    pwv = operator.pwv or profile.pwv
    layers = operator._layers(profile)
    models = [_model(operator, layer, track, observation) for layer in layers]
    variances = [_turbulence(operator, observation, n, m).variance for n, m in enumerate(models)]
    elevation = observation.elevation
    low, high = float(elevation.min()), float(elevation.max())
    gains = _gains(observation, band, pwv, low)
    largest = float(gains.max())
    scale = operator.pwv_rms
    if operator.pwv_rms_after_beam:
        scale /= math.sqrt(sum(m.amplitude**2 * v for m, v in zip(models, variances, strict=True)))
    stretch = 1 / math.sin(track.elevation) if track.kind == "horizontal" else 1.0
    velocities = _velocities(observation, track, layers)
    uneven = float(gains.std()) / max(largest, 1e-30)
    made = (band, profile, pwv, layers, models, variances, scale * largest, stretch, (low, high), velocities)
    return Air(*made, uneven=uneven)


def _gains(observation: Observation, band: BandAtmosphere, pwv: float, elevation: float) -> Floats:
    """(n_det,) what a relative change of the water makes in a calibrated sample, K: dT/dlnPWV epsilon / (zeta e^-tau), where the
    boresight has this elevation."""
    plane, step = observation.focalplane, 1e-3
    at = np.clip(elevation + plane.eta, ELEVATION_MIN, ELEVATION_MAX)
    passed = np.maximum(np.asarray(band.transmission(pwv, at), np.float64), 1e-6)
    slope = np.abs(np.asarray(band.emission_difference(pwv, pwv * step, at), np.float64)) / step
    return np.asarray(slope * plane.illumination_efficiency / (plane.main_beam_efficiency * passed), np.float64)


def _velocities(o: Observation, track: Track, layers: list[Layer]) -> list[Floats]:
    """Velocities (2, n) [m/s] of the boresight's ray through the air of each layer, at some instants of the scan."""
    if o.n_samples < 2:
        return [np.zeros((2, 1))] * len(layers)
    at = np.unique(np.linspace(0, o.n_samples - 2, INSTANTS).astype(int))
    both = np.stack([at, at + 1], axis=1).ravel()
    x = track.unroll(crossing(rays(axes(o.boresight_azel[both]), np.zeros(1), np.zeros(1)))[:, 0]).reshape(2, -1, 2)
    velocity = (x[:, :, 1] - x[:, :, 0]) * o.sample_rate
    return [layer.height * velocity - (track.drift @ layer.wind)[:, None] for layer in layers]


def atmosphere_traits(operator: AtmosphereLayers, observation: Observation) -> Traits:
    """rms of the fluctuation, and of what of it is faster than a frequency."""
    a = air(operator, observation)

    def faster(frequency: float) -> float:
        return min(math.sqrt(sum(a.faster(k, frequency) ** 2 for k in range(len(a.models)))), a.rms)

    return Traits(rms=a.rms, faster=faster)


def atmosphere_estimate(operator: AtmosphereLayers, context: Context) -> Estimate:
    """Layers, their resolution, the band's spectrum, ozone, slopes with elevation. As for the observation at the lowest
    elevation."""
    a = air(operator, context.lowest)
    effects = [*_layer_effects(operator, context, a), *_resolution(operator, context, a), *_spectral(operator, context, a)]
    effects += _slopes(context, a)
    points = _points(operator, context, a, operator.tolerance) / len(context.observations)
    layers = len(a.layers) - len(set(operator.omit))
    fixed = 0.02 + (POINT * layers + TRANSFER) * points
    choice = CHOICE[0] + CHOICE[1] * context.first.n_detectors
    once = 0.05 + choice * len(context.observations)  # companions use the same plan
    cost = Cost(fixed + LATTICE * _cells(operator, context.first, a), per_sample=0.6e-9, once=once, bytes=20.0 * points + 60e6)
    return Estimate(tuple(effects), cost, _without(operator, context, effects))


def _without(operator: AtmosphereLayers, context: Context, effects: list[Effect]) -> dict[str, float]:
    """All layers; the mean emission, where no filter takes it out; and what other modes would then be removed."""
    found = add(*(e.size for e in effects if e.name.startswith("layer ")))
    if not any(t.response for t in context.traits.values()):
        found = add(found, {"tod": context.mean_emission, "map_rms": context.mean_emission})
    return add(found, context.other_modes(operator.label)) if context.removes_common else found


def left_of_layer(context: Context, a: Air, k: int) -> float:
    """rms of layer k in one calibrated sample after the common mode is gone, K: what the detectors see apart, and what they see
    alike with other gains."""
    model = a.models[k]
    whole = a.kelvin * model.amplitude * math.sqrt(a.variances[k])
    if not context.removes_common:
        return whole
    xi, eta = some(context.first.focalplane.xi, context.first.focalplane.eta)
    return math.hypot(a.kelvin * differential_rms(xi, eta, [model], a.stretch), _gain_scatter(context, a) * whole)


def _gain_scatter(context: Context, a: Air) -> float:
    """Relative rms of the detectors' gains: known ones, and the calibration's errors."""
    return math.hypot(a.uneven, *(t.gain_error for t in context.traits.values()))


def _correlated(operator: AtmosphereLayers, context: Context, model: LayerModel, wind: Any) -> float:
    """Integral of the correlation over time, s: the beam or what of the outer scale the filters pass, over the wind's speed."""
    speed = max(float(np.hypot(*wind)), 0.1)
    slow = max(4 * model.sigma, min(operator.outer_scale, 20 * model.sigma)) / speed
    return min(slow, 1 / context.cut) if context.cut > 0 else slow


def _layer_effects(operator: AtmosphereLayers, context: Context, a: Air) -> list[Effect]:
    text = "1.25 p PWV dT/dPWV epsilon / (zeta e^-tau) a_l x " + (
        "rms left of the layer after subtraction of the detectors' mean" if context.removes_common else "rms behind the beam"
    )
    effects = []
    averages, spectra = _averages(operator, context, a), _spectral_shares(context, a)
    for k, (layer, model) in enumerate(zip(a.layers, a.models, strict=True)):
        rms = SAFETY * left_of_layer(context, a, k)
        bound = context.bound(rms, _correlated(operator, context, model, layer.wind), common=True)
        bound["map_rms"] = min(bound["map_rms"], averages[k] * rms)
        if context.before_filters:
            bound["tod"] = SAFETY * a.kelvin * model.amplitude * math.sqrt(a.variances[k])
        opacity = _opacity_share(a) * operator.pwv_rms * model.amplitude * math.sqrt(a.variances[k])
        bound |= context.sky_error(opacity)
        bound["psd"] = min(SAFETY**2 * spectra[k], 1.0)
        choices = [full(f"at {layer.height:.0f} m")]
        if k in operator.omit:
            choices = [full(f"at {layer.height:.0f} m: left out by the pipeline")]
        elif not operator.outputs:
            seconds = POINT * _points(operator, context, a, operator.tolerance)
            choices.append(Choice("dropped", "left out", {"omit": [k]}, bound=bound, formula=text, seconds=seconds))
        effects.append(Effect(f"layer {k}", tuple(choices), bound, text))
    return effects


def _averages(operator: AtmosphereLayers, context: Context, a: Air) -> list[float]:
    """See `averaging.shares`; worked out once for an observation."""
    key = str(context.coverage)
    if key not in a.averages:
        a.averages[key] = shares(operator, context, a)
    return a.averages[key]


def _left(operator: AtmosphereLayers, context: Context, a: Air) -> tuple[float, float]:
    """rms of what subtraction of the mean leaves of the fluctuation: of a sample, and of its mean in a pixel, K."""
    left = [left_of_layer(context, a, k) for k in range(len(a.models))]
    mapped = ((x * y) ** 2 for x, y in zip(left, _averages(operator, context, a), strict=True))
    return math.sqrt(sum(x * x for x in left)), math.sqrt(sum(mapped))


def _spectral_shares(context: Context, a: Air) -> list[float]:
    """Largest share that each layer has of the stream's power in a range of frequency (20 from 1 / duration to Nyquist),
    white noise included."""
    o = context.first
    grid = np.geomspace(1 / o.duration, o.sample_rate / 2, 21) if o.duration * o.sample_rate > 4 else np.array([0.0, 1.0])
    power = np.array([[a.faster(k, float(f)) ** 2 for f in grid] for k in range(len(a.models))])
    each = np.maximum(power[:, :-1] - power[:, 1:], 0.0)
    total = each.sum(axis=0) + context.noise**2 * 2 * np.diff(grid) / o.sample_rate
    return [float(v) for v in (each / np.maximum(total, 1e-300)).max(axis=1)]


def _in_proportion(operator: AtmosphereLayers, context: Context, a: Air, share: float, correlated: float) -> dict[str, float]:
    """Bound of an error that is ``share`` of the fluctuation."""
    sample, pixel = _left(operator, context, a)
    bound = context.bound(SAFETY * share * sample, correlated, common=True)
    bound["map_rms"] = min(bound["map_rms"], SAFETY * share * pixel)
    return bound | {"psd": 2 * share + share**2}


def _points(operator: AtmosphereLayers, context: Context, a: Air, tolerance: float) -> float:
    """Points (nodes x times) at which the turbulence is evaluated, all observations; as for the first one."""
    if tolerance not in a.points:
        o = context.first
        track = operator._tracks.get(o.name) or tracks([o])[0]
        variance = sum(m.amplitude**2 * v for m, v in zip(a.models, a.variances, strict=True))
        winds = [layer.wind for layer in a.layers]
        plan = make_plan(o, track, a.models, winds, variance, tolerance, a.band, a.pwv, operator.pwv_rms)
        share = sum(plan.step / s for s in plan.steps) / len(plan.steps)
        a.points[tolerance] = len(plan.nodes.xi) * o.n_samples / plan.step * share
    return a.points[tolerance] * context.times / context.first.n_samples


def _cells(operator: AtmosphereLayers, o: Observation, a: Air) -> float:
    """Lattice points that one scan sweeps over: (throw x distance) x (height of the field x distance + drift) / spacing^2."""
    field = 2 * o.focalplane.radius
    across = float(np.ptp(np.unwrap(o.azimuth))) * math.cos(a.elevations[0]) + field
    along = a.elevations[1] - a.elevations[0] + field
    total = 0.0
    for k, (layer, model) in enumerate(zip(a.layers, a.models, strict=True)):
        spacing = 0.75 * _lattice(operator) * model.sigma  # a power of two metres
        drift = float(np.hypot(*layer.wind)) * o.duration
        sides = (across * model.distance + drift) / spacing + 30, along * model.distance / spacing + 30
        total += sides[0] * sides[1] * (k not in operator.omit)
    return total


def _lattice(operator: AtmosphereLayers) -> float:
    return operator.lattice or FIDELITIES[operator.fidelity].lattice


def _opacity_share(a: Air) -> float:
    """d ln <e^-tau> / d ln PWV."""
    step = 1e-3
    return abs(float(a.band.log_transmission_difference(a.pwv, a.pwv * step, a.elevations[0]))) / step


def _resolution(operator: AtmosphereLayers, context: Context, a: Air) -> list[Effect]:
    """Nodes and steps in time; lattice; fidelity."""
    xi, eta = some(context.first.focalplane.xi, context.first.focalplane.eta)
    left = math.hypot(a.kelvin * differential_rms(xi, eta, a.models, a.stretch), _gain_scatter(context, a) * a.rms)
    left = max(left, 0.01 * a.rms if len(xi) == 1 else 0.0)
    correlated = max(_correlated(operator, context, m, layer.wind) for m, layer in zip(a.models, a.layers, strict=True))
    choices = [full(f"within {operator.tolerance:g} of what the detectors' mean leaves")]
    text = "(sqrt 2 + 0.1) tolerance x rms left after subtraction of the detectors' mean: nodes, steps in time, mean emission"
    now = _points(operator, context, a, operator.tolerance)
    for tolerance in (0.03, 0.1, 0.3):
        if tolerance > operator.tolerance:
            rms = 1.52 * (tolerance + operator.tolerance) * left
            bound = context.bound(rms, correlated, common=True) | {"psd": (rms / max(context.noise, a.rms, 1e-30)) ** 2}
            saved = 0.0
            if now * POINT * len(a.layers) > PAYS and context.affords(bound):
                saved = POINT * len(a.layers) * (now - _points(operator, context, a, tolerance))
            what = f"within {tolerance:g}"
            choices.append(Choice("coarse", what, {"tolerance": tolerance}, bound=bound, formula=text, seconds=saved))
    effects = [Effect("detector nodes and time steps", tuple(choices), context.bound(left, correlated, True), text)]
    fidelity = FIDELITIES[operator.fidelity]
    wrong = _in_proportion(operator, context, a, 0.5 * fidelity.structure_error, correlated)
    text = "half the covariance's relative error x rms: how much the ensemble's rms is off"
    effects.append(Effect("turbulence lattice", (full(f"{operator.fidelity}, {_lattice(operator):g} of the beam"),), wrong, text))
    return effects


def _spectral(operator: AtmosphereLayers, context: Context, a: Air) -> list[Effect]:
    """The band's spectrum and ozone: what the fluctuation would be off by, by radiative transfer at one frequency, without O3."""
    band, layers = context.first.instrument.band, replace(a.profile.layers, spectra=operator._table())
    middle = Band(name="middle", low=f"{band.centre - 0.25e9!r} Hz", high=f"{band.centre + 0.25e9!r} Hz")
    correlated = max(_correlated(operator, context, m, layer.wind) for m, layer in zip(a.models, a.layers, strict=True))
    elevation = a.elevations[0]
    right = _slope(_BandTransfer(band, layers), a.pwv, elevation)
    one = _slope(_BandTransfer(middle, layers), a.pwv, elevation)
    clear = _slope(_BandTransfer(band, replace(layers, o3=np.zeros_like(layers.o3))), a.pwv, elevation)
    effects = []
    for name, what, other in (
        ("spectral resolution", "the band, in cells of 0.5 GHz", one),
        ("ozone", "the profile's", clear),
    ):
        share = abs(other / right - 1)
        text = "|ratio of dT/dPWV / e^-tau - 1| x rms of the fluctuation, by radiative transfer " + (
            "at the band's centre alone" if other is one else "without ozone"
        )
        effects.append(Effect(name, (full(what),), _in_proportion(operator, context, a, share, correlated), text))
    return effects


def _slope(transfer: _BandTransfer, pwv: float, elevation: float) -> float:
    """dT/dPWV over <e^-tau>."""
    (low, log_t, _), (high, _, _) = transfer(pwv * 0.99, [elevation])[0], transfer(pwv * 1.01, [elevation])[0]
    return (high - low) / (0.02 * pwv) / math.exp(log_t)


def _slopes(context: Context, a: Air) -> list[Effect]:
    """Emission and opacity over the elevations of the scan. The high-pass filter takes the mean emission out analytically."""
    low, high = max(a.elevations[0], math.radians(4.5)), a.elevations[1]
    for o in context.observations:
        low, high = min(low, float(o.elevation.min())), max(high, float(o.elevation.max()))
    emission = abs(float(a.band.emission(a.pwv, low) - a.band.emission(a.pwv, high)))
    opacity = abs(float(a.band.log_transmission(a.pwv, low) - a.band.log_transmission(a.pwv, high)))
    plane = context.first.focalplane
    share = float((plane.illumination_efficiency / plane.main_beam_efficiency).max()) / float(a.band.transmission(a.pwv, low))
    size = context.bound(emission * share, context.first.duration, True)
    gone = "removed analytically by the high-pass filter" if context.cut > 0 else "in float64 beside the stream"
    noise = context.bound(opacity / 2 * math.sqrt(sum(t.loudest**2 for t in context.traits.values()))) | {"psd": opacity}
    return [
        Effect("mean emission with elevation", (full(gone),), size, "difference of the band's emission over the elevations seen"),
        Effect("opacity with elevation", (full("calibrated at the current elevation"),), noise | context.sky_error(opacity),
               "difference of the opacity over the elevations seen, x half the noise, x the sky"),
    ]  # fmt: skip
