"""Bounds and costs of the atmosphere's effects, see `core.plan`.

Of a layer l with share a_l, variance s_l^2 behind the beam, the band's emission T(PWV), and its
kappa_l for water at that height (`layer_terms`; 1 where layers respond as the column does), one
calibrated sample has the rms

    K kappa_l a_l s_l,
    K = p PWV dT/dPWV epsilon / (zeta <e^-tau>)                                             (1)

and, where what all detectors have in common is removed, at most K times what their differences from
the mean leave of it (`nodes.differential_rms`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np

from zonda.core.instrument import Band
from zonda.core.knobs import Knob
from zonda.core.observation import Observation
from zonda.core.plan.context import OTHER_MODES, Context
from zonda.core.plan.estimate import Choice, Cost, Effect, Estimate, Traits, add, full
from zonda.core.plan.planning import Planning
from zonda.core.types import Floats

from .averaging import shares
from .drawing import bytes_of_units, in_time_order
from .layers import AtmosphereLayers
from .model import AtmosphereModel, absorption_of
from .turbulence.geometry import ScanPlane, axes, crossing, rays
from .turbulence.levels import FIDELITIES
from .turbulence.nodes import Layer, differential_rms, spread_evenly
from .turbulence.tiles import AROUND
from .weather.bands import BandAtmosphere, BandTransfer
from .weather.radiative_transfer import ELEVATION_MAX, ELEVATION_MIN

INSTANTS = 200
"""Samples of a scan at which the speed relative to a layer is determined."""

SAFETY = 1.25
"""Factor on the ensemble rms: the rms of one scan scatters about it, the more the slower the drift
over the telescope.
"""

PASSAGES = 3.0
"""Factor on the rms of a layer's transmission: a source is seen through what it is in a few
passages.
"""

POINT, TRANSFER, LATTICE = 1.2e-8, 1.2e-7, 2.7e-8
"""Seconds per point (node x time) of one layer and of the radiative transfer and splines; per
lattice point: a band alone takes a fifth more than this, one of two, whose tiles are made at once,
a tenth less."""

SHARED = 0.4
"""Share of it that bands executed together do once, where each detector is evaluated by itself:
two cost 1.5 to 1.6 times one.
"""

CHOICE = 0.02, 2e-5
"""Seconds that the choice of nodes and steps takes for each scan: a + b per detector."""

PAYS = 0.3
"""Seconds of evaluation from which coarser nodes are looked for."""


InProportion = Callable[[float], dict[str, float]]
"""The bound of an error that is a share of the fluctuation."""


class AtmospherePlanning(Planning[AtmosphereLayers]):
    """Layers, their resolution, spectral approximations, slopes with elevation."""

    of = AtmosphereLayers
    knobs = (
        Knob(
            "tolerance",
            ("30 %", "10 %", "3 %", "1 %", "0.3 %", "0.1 %"),
            "layers evaluated at nodes of field and time",
        ),
        Knob(
            "lattice", (0.6, 0.3, 0.15), "turbulence interpolated between the points of its lattice"
        ),
        Knob(
            "fidelity",
            ("default", "fine"),
            "covariance of the turbulence by compact kernels",
            redraws=True,
        ),
        Knob("layers", (5, 10, 20), "thin sheets for a continuous atmosphere", redraws=True),
    )

    def memory(self, observation: Observation) -> int:
        """Tables, tiles of the turbulence, weights of the nodes; where there are none, the series
        of detectors.
        """
        size = 100_000_000 + 700 * observation.n_detectors + 40 * observation.n_samples
        return size + bytes_of_units(self.operator.model(observation))

    def in_time_order(self, observation: Observation) -> bool:
        """Where detectors are evaluated one by one and the scan is long, all of them share the
        turbulence of the moment.
        """
        return in_time_order(self.operator.model(observation))

    def shares_blocks(self, observation: Observation) -> bool:
        """Lines of sight, and tiles of the turbulence, where each detector is evaluated by
        itself.
        """
        return bytes_of_units(self.operator.model(observation)) > 0

    def traits(self, observation: Observation) -> Traits:
        """rms of the fluctuation, and of what of it is faster than a frequency."""
        a = calibrated(self.operator.model(observation))

        def faster(frequency: float) -> float:
            return min(
                math.sqrt(sum(a.faster(k, frequency) ** 2 for k in range(len(a.layers)))), a.rms
            )

        return Traits(rms=a.rms, faster=faster)

    def estimate(self, context: Context) -> Estimate:
        """As for the observation at the lowest elevation."""
        a, first = (
            calibrated(self.operator.model(context.lowest)),
            self.operator.model(context.first),
        )
        p = a.model.parameters
        if (key := str(context.coverage)) not in a.averages:
            a.averages[key] = shares(context, a.layers, a.components, first.plane)
        points = _points(context, first, p.tolerance)
        left = [left_of_layer(context, a, k) for k in range(len(a.layers))]
        in_proportion = partial(_in_proportion, context, a, left)
        effects = _layer_effects(context, a, left, points)
        effects += [
            _nodes(context, a, first, self.coarser("tolerance")),
            _lattice_error(a, in_proportion),
        ]
        effects += [*_spectral(context, a, in_proportion), *_slopes(context, a)]
        points /= len(context.observations)
        fixed = 0.02 + (POINT * (len(a.layers) - len(set(p.omit))) + TRANSFER) * points
        once = 0.05 + (CHOICE[0] + CHOICE[1] * context.first.n_detectors) * len(
            context.observations
        )
        shared = 0.0 if first.resolution().nodes.shape else SHARED
        cost = Cost(fixed + LATTICE * _cells(first), per_sample=0.6e-9, once=once, shared=shared)
        return Estimate(tuple(effects), cost, _without(context, a, left))


@dataclass(eq=False)
class Calibrated:
    """The fluctuation of an observation's atmosphere in calibrated samples.

    ``kelvin``: K of equation (1), of the detector that sees most. ``uneven``: rms of K over the
    detectors, of the largest. ``variances`` s_l^2. ``velocities`` of the boresight's ray relative
    to the air of each layer. ``averages`` by coverage, see `averaging.shares`.
    """

    layers: list[Layer]
    variances: list[float]
    kelvin: float
    uneven: float
    velocities: list[Floats]
    model: AtmosphereModel
    elevations: tuple[float, float]
    averages: dict[str, list[float]] = field(default_factory=dict)

    @property
    def rms(self) -> float:
        """Rms of one calibrated sample, K."""
        return self.kelvin * math.sqrt(
            sum(m.amplitude**2 * v for m, v in zip(self.layers, self.variances, strict=True))
        )

    def of_layer(self, k: int) -> float:
        """rms of one layer, K."""
        return self.kelvin * self.layers[k].amplitude * math.sqrt(self.variances[k])

    def faster(self, layer: int, frequency: float) -> float:
        """rms of what of a layer is faster than a frequency [Hz], K.

        Along a ray at speed v the covariance exp(-(v t)^2 / 4 e) has the share erfc(2 pi f sqrt(e)
        / v) beyond f.
        """
        from scipy.special import erfc

        e, w = self.components[layer]
        argument = (
            2
            * math.pi
            * frequency
            * np.divide.outer(np.sqrt(e), np.maximum(np.hypot(*self.velocities[layer]), 1e-6))
        )
        return (
            self.kelvin
            * self.layers[layer].amplitude
            * math.sqrt(max(float(w @ erfc(argument).mean(1)), 0.0))
        )

    @cached_property
    def components(self) -> list[tuple[Floats, Floats]]:
        """Covariance of each layer as sum w exp(-r^2 / 4 e)."""
        return [layer.gaussian() for layer in self.layers]


@lru_cache(maxsize=2)
def calibrated(model: AtmosphereModel) -> Calibrated:
    """See `Calibrated`."""
    elevation = model.observation.elevation
    low, high = float(elevation.min()), float(elevation.max())
    gains = _gains(model.observation, model.band, model.pwv, low)
    largest, factors = float(gains.max()), model.strength(np.sin([low, high]))
    strongest = 1.0 if factors is None else max(1.0, float(factors.max()))
    return Calibrated(
        layers=model.emitting,
        variances=[field.variance for field in model.turbulence],
        kelvin=model.fluctuation.scale * strongest * largest,
        uneven=float(gains.std()) / max(largest, 1e-30),
        velocities=_velocities(model.observation, model.plane, model.layers),
        model=model,
        elevations=(low, high),
    )


def _gains(observation: Observation, band: BandAtmosphere, pwv: float, elevation: float) -> Floats:
    """(n_det,) what a relative change of the PWV makes in a calibrated sample, K: dT/dlnPWV epsilon
    / (zeta e^-tau), where the boresight has this elevation."""
    plane, step = observation.focalplane, 1e-3
    at = np.clip(elevation + plane.eta, ELEVATION_MIN, ELEVATION_MAX)
    passed = np.maximum(np.asarray(band.transmission(pwv, at), np.float64), 1e-6)
    slope = np.abs(np.asarray(band.emission_difference(pwv, pwv * step, at), np.float64)) / step
    return np.asarray(
        slope * plane.illumination_efficiency / (plane.main_beam_efficiency * passed), np.float64
    )


def _velocities(o: Observation, plane: ScanPlane, layers: list[Layer]) -> list[Floats]:
    """Velocities (2, n) [m/s] of the boresight's ray relative to each layer, at some instants of
    the scan.
    """
    if o.n_samples < 2:
        return [np.zeros((2, 1))] * len(layers)
    at = np.unique(np.linspace(0, o.n_samples - 2, INSTANTS).astype(int))
    both = np.stack([at, at + 1], axis=1).ravel()
    x = plane.unroll(
        crossing(rays(axes(o.boresight_azel[both]), np.zeros(1), np.zeros(1)))[:, 0]
    ).reshape(2, -1, 2)
    velocity = (x[:, :, 1] - x[:, :, 0]) * o.sample_rate
    return [layer.height * velocity - (plane.drift @ layer.wind)[:, None] for layer in layers]


def _without(context: Context, a: Calibrated, left: Sequence[float]) -> dict[str, float]:
    """All layers; the mean emission, where no filter takes it out."""
    found = add(*_layer_bounds(context, a, left))
    if not any(t.response for t in context.traits.values()):
        found = add(found, {"tod": context.mean_emission, "map_rms": context.mean_emission})
    return found


def left_of_layer(context: Context, a: Calibrated, k: int) -> float:
    """rms of layer k in one calibrated sample after the common mode is gone, K.

    That is what the detectors see differently, and what they see with unequal gains.
    """
    whole = a.of_layer(k)
    if not context.removes_common:
        return whole
    xi, eta = spread_evenly(context.first.focalplane.xi, context.first.focalplane.eta)
    return math.hypot(
        a.kelvin * differential_rms(xi, eta, [a.layers[k]], a.model.plane.stretch),
        _gain_scatter(context, a) * whole,
    )


def _gain_scatter(context: Context, a: Calibrated) -> float:
    """Relative rms of the detectors' gains: known ones, and the calibration's errors."""
    return math.hypot(a.uneven, *(t.gain_error for t in context.traits.values()))


def _correlated(context: Context, layer: Layer) -> float:
    """Integral of the correlation over time, s: the beam or what of the outer scale the filters
    pass, over the wind's speed.
    """
    speed = max(float(np.hypot(*layer.wind)), 0.1)
    slow = max(4 * layer.sigma, min(layer.outer_scale, 20 * layer.sigma)) / speed
    return min(slow, 1 / context.cut) if context.cut > 0 else slow


def _layer_effects(
    context: Context, a: Calibrated, left: Sequence[float], points: float
) -> list[Effect]:
    text = "1.25 p PWV dT/dPWV epsilon / (zeta e^-tau) kappa_l a_l x " + (
        "rms left of the layer after subtraction of the detectors' mean"
        if context.removes_common
        else "rms behind the beam"
    )
    bounds, p = _layer_bounds(context, a, left), a.model.parameters
    text += OTHER_MODES if context.turns else ""
    effects = []
    for k, layer in enumerate(a.layers):
        bound = context.behind_modes(bounds[k])
        choices = [full(f"at {layer.height:.0f} m")]
        if k in p.omit:
            choices = [full(f"at {layer.height:.0f} m: left out by the pipeline")]
        elif not p.outputs:
            choices.append(
                Choice(
                    "dropped",
                    "left out",
                    {"omit": [k]},
                    bound=bound,
                    formula=text,
                    seconds=POINT * points,
                )
            )
        effects.append(Effect(f"layer {k}", tuple(choices), bound, text))
    return effects


def _layer_bounds(context: Context, a: Calibrated, left: Sequence[float]) -> list[dict[str, float]]:
    """Bound on what each layer adds to the products."""
    averages, spectra = a.averages[str(context.coverage)], _spectral_shares(context, a)
    bounds = []
    for k, layer in enumerate(a.layers):
        rms = SAFETY * left[k]
        bound = context.bound(rms, _correlated(context, layer), common=True)
        bound["map_rms"] = min(bound["map_rms"], averages[k] * rms)
        if context.before_filters:
            bound["tod"] = SAFETY * a.of_layer(k)
        share = abs(a.model.layers[k].amplitude * float(a.model.kappa["opacity"][k]))
        opacity = _opacity_share(a) * a.model.fluctuation.scale * share * math.sqrt(a.variances[k])
        bound |= context.sky_error(PASSAGES * opacity)
        bound["psd"] = min(SAFETY**2 * spectra[k], 1.0)
        bounds.append(bound)
    return bounds


def _spectral_shares(context: Context, a: Calibrated) -> list[float]:
    """Largest share that each layer has of the stream's power in a range of frequency (20 from 1 /
    duration to Nyquist), white noise included."""
    o = context.first
    grid = (
        np.geomspace(1 / o.duration, o.sample_rate / 2, 21)
        if o.duration * o.sample_rate > 4
        else np.array([0.0, 1.0])
    )
    power = np.array([[a.faster(k, float(f)) ** 2 for f in grid] for k in range(len(a.layers))])
    each = np.maximum(power[:, :-1] - power[:, 1:], 0.0)
    total = each.sum(axis=0) + context.noise**2 * 2 * np.diff(grid) / o.sample_rate
    return [float(v) for v in (each / np.maximum(total, 1e-300)).max(axis=1)]


def _in_proportion(
    context: Context, a: Calibrated, left: Sequence[float], share: float
) -> dict[str, float]:
    """Bound of an error that is ``share`` of the fluctuation, of which ``left`` is what each layer
    leaves (`left_of_layer`).
    """
    mapped = ((x * y) ** 2 for x, y in zip(left, a.averages[str(context.coverage)], strict=True))
    sample, pixel = math.sqrt(sum(x * x for x in left)), math.sqrt(sum(mapped))
    bound = context.bound(SAFETY * share * sample, _longest(context, a), common=True)
    bound["map_rms"] = min(bound["map_rms"], SAFETY * share * pixel)
    return bound | {"psd": 2 * share + share**2}


def _longest(context: Context, a: Calibrated) -> float:
    """Longest correlation time of the layers, s."""
    return max(_correlated(context, layer) for layer in a.layers)


def _points(context: Context, first: AtmosphereModel, tolerance: float) -> float:
    """Points (nodes x times) at which the turbulence is evaluated, all observations; as for the
    first one.
    """
    chosen, n = first.resolution(tolerance), context.first.n_samples
    share = sum(chosen.step / s for s in chosen.steps) / len(chosen.steps)
    return len(chosen.nodes.xi) * n / chosen.step * share * context.times / n


def _cells(model: AtmosphereModel) -> float:
    """Lattice points that a scan sweeps over, about: its throw and the height of its field, and
    what drifts by.
    """
    o, omitted = model.observation, model.parameters.omit
    field, low, high = 2 * o.focalplane.reach, float(o.elevation.min()), float(o.elevation.max())
    angles = np.array(
        [float(np.ptp(np.unwrap(o.azimuth))) * math.cos(low) + field, high - low + field]
    )
    total = 0.0
    for k, (layer, turbulence) in enumerate(zip(model.layers, model.turbulence, strict=True)):
        sides = angles * layer.distance / turbulence.spacing + 2 * AROUND
        drift = float(np.hypot(*layer.wind)) * o.duration / turbulence.spacing
        total += float(sides.prod() + drift * sides.mean()) * (k not in omitted)
    return total


def _lattice(a: Calibrated) -> float:
    return a.model.parameters.lattice or FIDELITIES[a.model.parameters.fidelity].lattice


def _opacity_share(a: Calibrated) -> float:
    """d ln <e^-tau> / d ln PWV."""
    step = 1e-3
    return (
        abs(
            float(
                a.model.band.log_transmission_difference(
                    a.model.pwv, a.model.pwv * step, a.elevations[0]
                )
            )
        )
        / step
    )


def _nodes(
    context: Context, a: Calibrated, first: AtmosphereModel, coarser: Sequence[float]
) -> Effect:
    """Nodes and steps in time."""
    p = a.model.parameters
    xi, eta = spread_evenly(context.first.focalplane.xi, context.first.focalplane.eta)
    left = a.kelvin * differential_rms(xi, eta, a.layers, a.model.plane.stretch)
    left = math.hypot(left, _gain_scatter(context, a) * a.rms)
    left = max(left, 0.01 * a.rms if len(xi) == 1 else 0.0)
    correlated = _longest(context, a)
    choices = [full(f"within {p.tolerance:g} of what the detectors' mean leaves")]
    text = (
        "(sqrt 2 + 0.1) tolerance x rms left after subtraction of the detectors' mean: nodes, steps"
        " in time, mean emission"
    )
    now = _points(context, first, p.tolerance)
    for tolerance in coarser:
        rms = 1.52 * (tolerance + p.tolerance) * left
        bound = context.bound(rms, correlated, common=True) | {
            "psd": (rms / max(context.noise, a.rms, 1e-30)) ** 2
        }
        saved = 0.0
        if now * POINT * len(a.layers) > PAYS and context.affords(bound):
            saved = POINT * len(a.layers) * (now - _points(context, first, tolerance))
        settings = {"tolerance": tolerance}
        choices.append(
            Choice(
                "coarse",
                f"within {tolerance:g}",
                settings,
                bound=bound,
                formula=text,
                seconds=saved,
            )
        )
    return Effect(
        "detector nodes and time steps", tuple(choices), context.bound(left, correlated, True), text
    )


def _lattice_error(a: Calibrated, in_proportion: InProportion) -> Effect:
    fidelity = a.model.parameters.fidelity
    text = "half the covariance's relative error x rms: how much the ensemble's rms is off"
    wrong = in_proportion(0.5 * FIDELITIES[fidelity].structure_error)
    return Effect(
        "turbulence lattice", (full(f"{fidelity}, {_lattice(a):g} of the beam"),), wrong, text
    )


def _spectral(context: Context, a: Calibrated, in_proportion: InProportion) -> list[Effect]:
    """The band's spectrum and ozone: the fluctuation's error by radiative transfer at one
    frequency, and without O3.
    """
    band, pwv, elevation = context.first.instrument.band, a.model.pwv, a.elevations[0]
    layers = replace(a.model.profile.layers, spectra=absorption_of(a.model.parameters))
    middle = Band(
        name="middle", low=f"{band.centre - 0.25e9!r} Hz", high=f"{band.centre + 0.25e9!r} Hz"
    )
    right = _slope(BandTransfer(band, layers), pwv, elevation)
    effects = []
    for name, what, without, other in (
        (
            "spectral resolution",
            "the band, in cells of 0.5 GHz",
            "at the band's centre alone",
            BandTransfer(middle, layers),
        ),
        (
            "ozone",
            "the profile's",
            "without ozone",
            BandTransfer(band, replace(layers, o3=np.zeros_like(layers.o3))),
        ),
    ):
        text = (
            "|ratio of dT/dPWV / e^-tau - 1| x rms of the fluctuation, by radiative transfer"
            f" {without}"
        )
        bound = in_proportion(abs(_slope(other, pwv, elevation) / right - 1))
        effects.append(Effect(name, (full(what),), bound, text))
    return effects


def _slope(transfer: BandTransfer, pwv: float, elevation: float) -> float:
    """dT/dPWV over <e^-tau>."""
    (low, log_t, _), (high, _, _) = (
        transfer(pwv * 0.99, [elevation])[0],
        transfer(pwv * 1.01, [elevation])[0],
    )
    return (high - low) / (0.02 * pwv) / math.exp(log_t)


def _slopes(context: Context, a: Calibrated) -> list[Effect]:
    """Emission and opacity over the elevations of the scan. The high-pass filter takes the mean
    emission out.
    """
    low, high = max(a.elevations[0], math.radians(4.5)), a.elevations[1]
    for o in context.observations:
        low, high = min(low, float(o.elevation.min())), max(high, float(o.elevation.max()))
    band, pwv = a.model.band, a.model.pwv
    emission = abs(float(band.emission(pwv, low) - band.emission(pwv, high)))
    opacity = abs(float(band.log_transmission(pwv, low) - band.log_transmission(pwv, high)))
    plane = context.first.focalplane
    share = float((plane.illumination_efficiency / plane.main_beam_efficiency).max()) / float(
        band.transmission(pwv, low)
    )
    size = context.bound(emission * share, context.first.duration, True)
    gone = "removed by the high-pass filter" if context.cut > 0 else "in float64 beside the stream"
    noise = context.bound(
        opacity / 2 * math.sqrt(sum(t.loudest**2 for t in context.traits.values()))
    ) | {"psd": opacity}
    return [
        Effect(
            "mean emission with elevation",
            (full(gone),),
            size,
            "difference of the band's emission over the elevations seen",
        ),
        Effect(
            "opacity with elevation",
            (full("calibrated at the current elevation"),),
            noise | context.sky_error(opacity),
            "difference of the opacity over the elevations seen, x half the noise, x the sky",
        ),
    ]


class ScreensPlanning(Planning[Any]):
    """A cost for the whole run."""

    of = "zonda.operators.atmosphere.screens:AtmosphereScreens"
    cost = Cost(once=0.3, kernel="python")
    holds = 100_000_000
    """The fields and the tiles of the turbulence about them."""
