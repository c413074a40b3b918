"""Bounds of the atmosphere's effects, see `core.plan`.

Of a layer l with share a_l, variance s_l^2 behind the beam, the band's emission T(PWV), and its
kappa_l for water at that height (`response`; 1 where layers respond as the column does), one
calibrated sample has the rms

    K kappa_l a_l s_l,
    K = p PWV dT/dPWV epsilon / (zeta <e^-tau>)                                             (1)

and, where what all detectors have in common is removed, at most K times what their differences from
the mean leave of it (`nodes.differential_rms`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from zonda.core.instrument import Band
from zonda.core.observation import Observation
from zonda.core.plan.bounds import (
    OTHER_MODES,
    Choice,
    Context,
    Effect,
    Estimate,
    Traits,
    add,
    evenly,
    exact,
    full,
)
from zonda.core.plan.planning import Knob, Planning
from zonda.core.types import Floats

from .layers import AtmosphereLayers
from .model import AtmosphereModel, absorption_of
from .realization import bytes_of_units, in_time_order
from .turbulence.geometry import axes, crossing, rays
from .turbulence.levels import FIDELITIES
from .turbulence.nodes import Layer, differential_rms, spread_evenly
from .weather.bands import BandTransfer
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
            "lattice",
            (0.6, 0.3, 0.15),
            "turbulence interpolated between the points of its lattice",
        ),
        Knob(
            "fidelity",
            ("default", "fine"),
            "covariance of the turbulence by compact kernels",
            redraws=True,
        ),
        Knob("layers", (5, 10, 20), "thin sheets for a continuous atmosphere", redraws=True),
    )
    holds = 10_000_000
    per_detector = 700
    per_sample = 40

    def memory(self, observation: Observation) -> int:
        """Tables, tiles of the turbulence, weights of the nodes; where there are none, the series
        of detectors.
        """
        return super().memory(observation) + bytes_of_units(self.operator.model(observation))

    def in_time_order(self, observation: Observation) -> bool:
        """True if detectors are evaluated one by one in a long scan: all of them share the
        turbulence of the moment.
        """
        return in_time_order(self.operator.model(observation))

    def traits(self, observation: Observation) -> Traits:
        """rms of the fluctuation, and of what of it is faster than a frequency."""
        a = calibrated(self.operator.model(observation))

        def faster(frequency: float) -> float:
            return min(math.hypot(*(a.faster(k, frequency) for k in range(len(a.layers)))), a.rms)

        return Traits(rms=a.rms, faster=faster)

    def estimate(self, context: Context) -> Estimate:
        """Bounds for the observation at the lowest elevation."""
        bounds = AtmosphereBounds(context, calibrated(self.operator.model(context.lowest)))
        effects = (
            *bounds.layers(),
            bounds.nodes(),
            bounds.lattice(),
            *bounds.spectral(),
            *bounds.slopes(),
        )
        return Estimate(effects, without=bounds.without())


@dataclass(eq=False)
class Calibrated:
    """The fluctuation of an observation's atmosphere in calibrated samples.

    ``kelvin``: K of equation (1), of the detector that sees most. ``uneven``: rms of K over the
    detectors, of the largest. ``variances`` s_l^2. ``velocities`` (2, n) [m/s] of the boresight's
    ray relative to the air of each layer, at some instants of the scan.
    """

    layers: list[Layer]
    variances: list[float]
    kelvin: float
    uneven: float
    velocities: list[Floats]
    model: AtmosphereModel
    elevations: tuple[float, float]

    @property
    def rms(self) -> float:
        """Rms of one calibrated sample, K."""
        return math.hypot(*map(self.of_layer, range(len(self.layers))))

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
        speed = np.maximum(np.hypot(*self.velocities[layer]), 1e-6)
        argument = 2 * math.pi * frequency * np.divide.outer(np.sqrt(e), speed)
        share = max(float(w @ erfc(argument).mean(1)), 0.0)
        return self.kelvin * self.layers[layer].amplitude * math.sqrt(share)

    @cached_property
    def components(self) -> list[tuple[Floats, Floats]]:
        """Covariance of each layer as sum w exp(-r^2 / 4 e)."""
        return [layer.gaussian() for layer in self.layers]


@lru_cache(maxsize=2)
def calibrated(model: AtmosphereModel) -> Calibrated:
    """See `Calibrated`."""
    o = model.observation
    plane = model.observation.focalplane
    step = 1e-3
    low = float(o.elevation.min())
    high = float(o.elevation.max())
    # K of each detector: effect of a relative change of the PWV at the lowest elevation
    at = np.clip(low + plane.eta, ELEVATION_MIN, ELEVATION_MAX)
    passed = np.maximum(model.band.transmission(model.pwv, at), 1e-6)
    slope = abs(model.band.emission_difference(model.pwv, model.pwv * step, at)) / step
    gains = slope * plane.illumination_efficiency / (plane.main_beam_efficiency * passed)
    largest = float(gains.max())
    factors = model.strength(np.sin([low, high]))
    strongest = 1.0 if factors is None else max(1.0, float(factors.max()))
    speed = np.zeros((2, 1))  # of the boresight's crossing, per metre of height
    if o.n_samples > 1:
        instants = evenly(o.n_samples - 1, INSTANTS)
        both = np.stack([instants, instants + 1], axis=1).ravel()
        ray = crossing(rays(axes(o.boresight_azel[both]), np.zeros(1), np.zeros(1)))[:, 0]
        x = model.plane.unroll(ray).reshape(2, -1, 2)
        speed = (x[:, :, 1] - x[:, :, 0]) * o.sample_rate
    moving = o.n_samples > 1
    return Calibrated(
        layers=model.emitting,
        variances=[field.variance for field in model.turbulence],
        kelvin=model.fluctuation.scale * strongest * largest,
        uneven=float(gains.std()) / max(largest, 1e-30),
        velocities=[
            m.height * speed - moving * (model.plane.drift @ m.wind)[:, None] for m in model.layers
        ],
        model=model,
        elevations=(low, high),
    )


def _slope(transfer: BandTransfer, pwv: float, elevation: float) -> float:
    """dT/dPWV over <e^-tau>."""
    (low, log_t), (high, _) = (transfer(pwv * x, [elevation])[0] for x in (0.99, 1.01))
    return (high - low) / (0.02 * pwv) / math.exp(log_t)


@dataclass(frozen=True)
class AtmosphereBounds:
    """Bounds of the effects on the products.

    ``calibrated``: of the observation at the lowest elevation.
    """

    context: Context
    calibrated: Calibrated

    @cached_property
    def left(self) -> list[float]:
        """Rms of each layer in one calibrated sample after the common mode is gone, K: what the
        detectors see differently, and what they see with unequal gains.
        """
        a = self.calibrated
        each = [(a.of_layer(k), layer) for k, layer in enumerate(a.layers)]
        if not self.context.removes_common:
            return [whole for whole, _ in each]
        return [self._differences([layer], whole) for whole, layer in each]

    def _differences(self, layers: list[Layer], whole: float) -> float:
        """Rms that is left of some layers, whose rms is ``whole``, without the common mode."""
        a = self.calibrated
        plane = self.context.first.focalplane
        gains = math.hypot(a.uneven, *(t.gain_error for t in self.context.traits.values()))
        left = differential_rms(*spread_evenly(plane.xi, plane.eta), layers, a.model.plane.stretch)
        return math.hypot(a.kelvin * left, gains * whole)

    def _correlated(self, layer: Layer) -> float:
        """Integral of the correlation over time, s: the beam or what of the outer scale the filters
        pass, over the wind's speed.
        """
        speed = max(float(np.hypot(*layer.wind)), 0.1)
        cut = self.context.cut
        slow = max(4 * layer.sigma, min(layer.outer_scale, 20 * layer.sigma)) / speed
        return min(slow, 1 / cut) if cut > 0 else slow

    def _bound(self, rms: float) -> dict[str, float]:
        """Bound of an error in the fluctuation, correlated as the slowest layer is."""
        longest = max(map(self._correlated, self.calibrated.layers))
        return self.context.bound(rms, longest, common=True)

    def layers(self) -> list[Effect]:
        """Layers that may be omitted one by one."""
        context = self.context
        a = self.calibrated
        p = a.model.parameters
        what = "rms behind the beam"
        if context.removes_common:
            what = "rms left of the layer after subtraction of the detectors' mean"
        text = f"1.25 p PWV dT/dPWV epsilon / (zeta e^-tau) kappa_l a_l x {what}"
        text += OTHER_MODES if context.turns else ""
        effects = []
        for k, layer in enumerate(a.layers):
            bound = context.behind_modes(self.of_layers[k])
            what = f"at {layer.height:.0f} m"
            choices = [full(what + (": left out by the pipeline" if k in p.omit else ""))]
            if k not in p.omit and not p.outputs:
                choices.append(Choice("dropped", "left out", {"omit": [k]}, False, bound, text))
            effects.append(Effect(f"layer {k}", tuple(choices), bound, text))
        return effects

    @cached_property
    def of_layers(self) -> list[dict[str, float]]:
        """Bound on each layer's part of the products."""
        context = self.context
        a = self.calibrated
        bounds = []
        model = a.model
        low = a.elevations[0]
        step = 1e-3
        change = model.band.log_transmission_difference(model.pwv, model.pwv * step, low)
        slope = abs(float(change)) / step  # d ln <e^-tau> / d ln PWV
        for k, layer in enumerate(a.layers):
            bound = context.bound(SAFETY * self.left[k], self._correlated(layer), common=True)
            if context.before_filters:
                bound["tod"] = SAFETY * a.of_layer(k)
            share = abs(model.layers[k].amplitude * float(model.kappa["opacity"][k]))
            share *= model.fluctuation.scale * math.sqrt(a.variances[k])
            bound |= context.sky_error(PASSAGES * share * slope)
            bound["psd"] = min(SAFETY**2 * self._spectral_shares[k], 1.0)
            bounds.append(bound)
        return bounds

    @cached_property
    def _spectral_shares(self) -> Floats:
        """(n_layer,) largest share that each layer has of the stream's power in a range of
        frequency (20 from 1 / duration to Nyquist), white noise included.
        """
        o = self.context.first
        a = self.calibrated
        grid = np.array([0.0, 1.0])
        if o.duration * o.sample_rate > 4:
            grid = np.geomspace(1 / o.duration, o.sample_rate / 2, 21)
        power = np.array([[a.faster(k, float(f)) ** 2 for f in grid] for k in range(len(a.layers))])
        each = np.maximum(-np.diff(power), 0.0)
        total = each.sum(axis=0) + self.context.noise**2 * 2 * np.diff(grid) / o.sample_rate
        return np.asarray((each / np.maximum(total, 1e-300)).max(axis=1))

    def without(self) -> dict[str, float]:
        """Effect of dropping all layers; and the mean emission, if no filter takes it out."""
        found = add(*self.of_layers)
        mean = self.context.mean_emission
        if not any(t.response for t in self.context.traits.values()):
            found = add(found, {"tod": mean, "map_rms": mean})
        return found

    def _in_proportion(self, share: float) -> dict[str, float]:
        """Bound of an error that is ``share`` of the fluctuation."""
        bound = self._bound(SAFETY * share * math.hypot(*self.left))
        return bound | {"psd": 2 * share + share**2}

    def nodes(self) -> Effect:
        """Nodes of the field and steps in time."""
        a = self.calibrated
        left = self._differences(a.layers, a.rms)
        if self.context.first.n_detectors == 1:
            left = max(left, 0.01 * a.rms)
        return exact(
            "detector nodes and time steps",
            self._bound(left),
            "rms left after subtraction of the detectors' mean",
            f"tolerance {a.model.parameters.tolerance:g}",
        )

    def lattice(self) -> Effect:
        """Lattice of the turbulence."""
        p = self.calibrated.model.parameters
        level = FIDELITIES[p.fidelity]
        return exact(
            "turbulence lattice",
            self._in_proportion(0.5 * level.structure_error),
            "half the covariance's relative error x rms: how much the ensemble's rms is off",
            f"{p.fidelity}, {p.lattice or level.lattice:g} of the beam",
        )

    def spectral(self) -> list[Effect]:
        """The band's spectrum and ozone: the fluctuation's error by radiative transfer at one
        frequency, and without O3.
        """
        model = self.calibrated.model
        elevation = self.calibrated.elevations[0]
        band = self.context.first.instrument.band
        layers = replace(model.profile.layers, spectra=absorption_of(model.parameters))
        low, high = (f"{band.centre + side!r} Hz" for side in (-0.25e9, 0.25e9))
        middle = BandTransfer(Band(name="middle", low=low, high=high), layers)
        bare = BandTransfer(band, replace(layers, o3=np.zeros_like(layers.o3)))
        right = _slope(BandTransfer(band, layers), model.pwv, elevation)
        cells = "the band, in cells of 0.5 GHz"
        centre = "at the band's centre alone"
        return [
            exact(
                name,
                self._in_proportion(abs(_slope(other, model.pwv, elevation) / right - 1)),
                "|ratio of dT/dPWV / e^-tau - 1| x rms of the fluctuation, by radiative transfer"
                f" {without}",
                what,
            )
            for name, what, without, other in (
                ("spectral resolution", cells, centre, middle),
                ("ozone", "the profile's", "without ozone", bare),
            )
        ]

    def slopes(self) -> list[Effect]:
        """Emission and opacity over the elevations of the scan. The high-pass filter takes the mean
        emission out.
        """
        context = self.context
        model = self.calibrated.model
        band = model.band
        plane = context.first.focalplane
        every = [o.elevation for o in context.observations]
        low = max(self.calibrated.elevations[0], math.radians(4.5))
        low = min(low, *(float(e.min()) for e in every))
        high = max(self.calibrated.elevations[1], *(float(e.max()) for e in every))
        emission, opacity = (
            abs(float(f(model.pwv, low) - f(model.pwv, high)))
            for f in (band.emission, band.log_transmission)
        )
        share = float((plane.illumination_efficiency / plane.main_beam_efficiency).max())
        share /= float(band.transmission(model.pwv, low))
        filtered = context.cut > 0
        loudest = math.hypot(*(t.loudest for t in context.traits.values()))
        noise = context.bound(opacity / 2 * loudest) | {"psd": opacity}
        return [
            exact(
                "mean emission with elevation",
                context.bound(emission * share, context.first.duration, True),
                "difference of the band's emission over the elevations seen",
                "removed by the high-pass filter" if filtered else "in float64 beside the stream",
            ),
            exact(
                "opacity with elevation",
                noise | context.sky_error(opacity),
                "difference of the opacity over the elevations seen, x half the noise, x the sky",
                "calibrated sample by sample",
            ),
        ]


class ScreensPlanning(Planning[Any]):
    """The fields and the tiles of the turbulence about them."""

    of = "zonda.operators.atmosphere.screens:AtmosphereScreens"
    holds = 100_000_000
