"""`AtmosphereLayers`: turbulent layers of water vapour that drift over the telescope, their
emission and their opacity.

The PWV along a line of sight is

    PWV_los = airmass PWV (1 + y),   y = p sum_l a_l g_l,
    sum_l a_l^2 = 1                                    (1)

with g_l the unit-variance von Karman field of layer l (`turbulence`), seen through the near-field
beam at the layer's distance, and p the ensemble rms. Emission and transmission of the band follow
from radiative transfer at PWV (1 + y) and the elevation of the ray (`response`). All of it is
smooth, so it is computed at nodes (`turbulence.nodes`) and interpolated.

Its power spectrum has a closed form (`closed_form`). A layer of covariance C(r) = sum_i w_i
exp(-r^2 / 4 e_i) behind a Gaussian beam (`turbulence.covariance`, equation 4) that passes a line of
sight at the speed V has the one-sided spectrum

    S(f) = 2 int C(V t) cos(2 pi f t) dt
         = (2 / V) sum_i w_i (4 pi e_i)^(1/2) exp(-e_i (2 pi f / V)^2)  (2)

and behind an aperture with a rim, of transform B (`turbulence.beams`), with the two-dimensional
spectrum P,

    S(f) = (2 / V) (1 / pi) int_0^inf P(k) B(k)^2 dq,
    k^2 = (2 pi f / V)^2 + q^2.                                   (3)

The relative fluctuation of the PWV has p^2 sum_l a_l^2 <S_l>, the mean over the speeds of the scan:
this holds above the frequencies of the scan itself. The emission on the calibrated sky has p^2
sum_l kappa_l^2 a_l^2 <S_l> (`response`) times (epsilon dT / dy / (zeta e^-tau))^2, y small.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from pydantic import PrivateAttr

from zonda.core.data import Block, Data
from zonda.core.errors import PointingError
from zonda.core.numerics.chunks import chunks
from zonda.core.observation import ClosedForm, Observation
from zonda.core.operator import Operator
from zonda.core.plausibility import PWV, doubt
from zonda.core.scene import Scene
from zonda.core.types import Floats

from .fluctuations import AtNodes, OfDetectors
from .model import AtmosphereModel, ExpectedLoad, LayerParameters, Models
from .realization import draw, state_drawn
from .resolution import layer_speeds
from .turbulence.covariance import NU, mixture
from .turbulence.nodes import Layer
from .weather.radiative_transfer import ELEVATION_MIN

SLOWEST = 1e-4
"""Lowest speed of a layer whose spectrum is computed, m/s."""
NODES = 1500
"""Nodes of the integral over q in equation (3)."""
KNOTS = 160
"""Frequencies at which a longer spectrum is evaluated; between them it is linear in log-log. Behind
a Gaussian beam of 100 m that errs by 0.2 % where the power is 1e-4 of the largest, by 0.4 % at
1e-6."""
ACROSS = 300
"""Nodes of the integral over q if it is split by wave number: an error of 2 %."""
WAVE_NUMBERS = 640
"""As `KNOTS`, of one layer's spectrum along a line, which many speeds share. The error is that of
`KNOTS` times (160 / 640)^2.
"""


def layer_spectrum(layer: Layer, frequency: Floats, speeds: Floats) -> Floats:
    """Mean of equation (2) or (3) over ``speeds`` [m/s], of a layer of unit variance before the
    beam: (n,) 1/Hz.
    """
    v = np.maximum(speeds, SLOWEST)[:, None]
    along = between_knots(_along(layer), (2 * np.pi * frequency / v).ravel(), WAVE_NUMBERS)
    return np.asarray((2 / v * along.reshape(len(v), -1)).mean(axis=0), np.float64)


def _along(layer: Layer) -> Callable[[Floats], Floats]:
    """The layer's spectrum along a line, int C(r) cos(k r) dr: (n,) m of k (n,) in rad/m."""
    if layer.aperture is None:
        e, w = mixture(layer.outer_scale, layer.sigma, 0.5, 1e-6)
        weights = w * np.sqrt(4 * np.pi * e)
        return lambda k: np.asarray(np.exp(-np.multiply.outer(k * k, e)) @ weights, np.float64)
    known = np.geomspace(1e-3 / layer.outer_scale, 400 / layer.aperture.diameter, 200)
    q = np.concatenate(
        [[0.0], np.geomspace(1e-4 / layer.outer_scale, 400 / layer.aperture.diameter, NODES)]
    )
    table = np.empty(known.size)
    for n, own in enumerate(known):
        table[n] = np.trapezoid(_power(layer, own**2 + q * q), q) / np.pi

    def along(k: Floats) -> Floats:
        found = np.exp(np.interp(np.log(np.maximum(k, known[0])), np.log(known), np.log(table)))
        return np.where(k <= known[-1], found, 0.0)

    return along


def _power(layer: Layer, square: Floats) -> Floats:
    """P B^2 of equation (3), m2, at squared wave numbers [rad^2/m^2]."""
    if layer.aperture is None:
        e, w = mixture(layer.outer_scale, layer.sigma, 0.5, 1e-6)
        waves = np.exp(-np.multiply.outer(square, e))
        return np.asarray(np.einsum("ke,e->k", waves, 4 * np.pi * e * w))
    power = (
        4
        * np.pi
        * NU
        * layer.outer_scale ** (-2 * NU)
        * (square + layer.outer_scale**-2) ** (-NU - 1)
    )
    return np.asarray(power * layer.aperture.transform(np.sqrt(square)) ** 2)


def layer_waves(layer: Layer, frequency: Floats, edges: Floats, speeds: Floats) -> Floats:
    """Equation (3), of waves between ``edges`` (m + 1,) of k times the layer's distance [1/rad]:
    (n, m) 1/Hz, the mean over 16 of the ``speeds``.
    """
    speeds = np.maximum(speeds[2::4], SLOWEST)
    width = 4 * layer.sigma if layer.aperture is None else layer.aperture.diameter
    q = np.geomspace(1e-4 / layer.outer_scale, 400 / width, ACROSS)
    known = np.geomspace(q[0], 2 * q[-1], 4 * ACROSS)
    power = np.log(np.maximum(_power(layer, known**2), np.finfo(np.float64).tiny))
    found = np.zeros((len(frequency), len(edges) - 1))
    for v in speeds.tolist():
        k = np.hypot(2 * np.pi * frequency[:, None] / v, q)
        part = np.exp(np.interp(np.log(k), np.log(known), power)) * np.gradient(q) * 2 / v / np.pi
        bins = np.digitize(k * layer.distance, edges) - 1
        for number in range(found.shape[1]):
            found[:, number] += np.where(bins == number, part, 0.0).sum(axis=1) / len(speeds)
    return found


def closed_form(model: AtmosphereModel, observation: Observation) -> ClosedForm | None:
    """The spectrum of ``atmosphere`` on the calibrated sky, K_RJ^2/Hz, as a function of the
    frequency [Hz].

    None where the PWV is log-normal, for which there is no closed form.
    """
    if model.fluctuation.log_normal:
        return None

    def added(of_layer: Callable[[Layer, Floats], Floats]) -> Floats:
        speeds = layer_speeds(observation, model.plane, model.layers)
        parts = (
            model.emitting[k].amplitude ** 2 * of_layer(model.layers[k], speeds[k])
            for k in model.simulated
        )
        return np.asarray(
            _emission_per_fluctuation(model, observation) ** 2
            * model.fluctuation.scale**2
            * sum(parts)
        )

    def spectrum(frequency: Floats) -> Floats:
        return added(lambda layer, speeds: layer_spectrum(layer, frequency, speeds))

    def across(frequency: Floats, edges: Floats) -> Floats:
        return added(lambda layer, speeds: layer_waves(layer, frequency, edges, speeds))

    return ClosedForm(lambda frequency: between_knots(spectrum, frequency), across=across)


def between_knots(
    law: Callable[[Floats], Floats],
    frequency: Floats,
    number: int = KNOTS,
) -> Floats:
    """A spectrum that is smooth in log-log at frequencies (n,) >= 0 [Hz], evaluated at ``number``
    of them if there are more.
    """
    positive = frequency[frequency > 0]
    if positive.size <= number:
        return law(frequency)
    knots = np.geomspace(positive.min(), positive.max(), number)
    values = np.log(np.maximum(law(knots), np.finfo(np.float64).tiny))
    found = np.exp(np.interp(np.log(np.maximum(frequency, knots[0])), np.log(knots), values))
    return (
        np.where(frequency > 0, found, law(np.zeros(1)))
        if positive.size < frequency.size
        else np.asarray(found)
    )


def _emission_per_fluctuation(model: AtmosphereModel, observation: Observation) -> float:
    """epsilon dT/dy / (zeta e^-tau) at the scan's mean elevation, rms over detectors that are not
    flagged, K_RJ.
    """
    elevation = np.array([float(np.mean(observation.elevation))])
    y = 1e-3
    rise = (
        float(model.band.emission_difference(model.pwv, np.array([model.pwv * y]), elevation)[0])
        / y
    )
    transmission = float(model.band.transmission(model.pwv, elevation[0]))
    plane = observation.focalplane
    good = observation.good_detectors
    ratio = plane.illumination_efficiency[good] / plane.main_beam_efficiency[good]
    return rise / transmission * math.sqrt(float(np.mean(ratio**2)))


class AtmosphereLayers(LayerParameters):
    """Turbulent layers of water vapour seen through near-field beams: their emission and
    transmission in the band.

    Sets ``observation.smooth["atmosphere"]`` (mean emission, K_RJ) and ``["transmission"]``
    (band-mean e^-tau), and adds the fluctuation of the emission to the stream ``atmosphere`` and
    that of the transmission, relative, to ``transmission``. With `outputs` it also makes streams of
    the fluctuation along each line of sight: ``pwv`` (m), ``opacity`` (of the band) and
    ``path_delay`` (m of excess path, non-dispersive).
    """

    requires = frozenset({"boresight"})
    on_request = frozenset({"pwv", "opacity", "path_delay"})
    knows_means = True

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
        models = Models(data.scene.time, data.scene.weather, {}, self._models._bands)
        lines = list[str]()
        for observation in data.observations:
            _check_pointing(observation)
        for alone in data.observations[0].of_each_band() if data.observations else ():
            model = models.of(self, alone)
            band = alone.instrument.band.name
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

    def plot(self, scene: Scene, pointing: Operator, layer: int = 0, ax: Any = None) -> Any:
        """Draw the water vapour of a layer (0: the lowest) as the first scan of a pointing step
        sees it (`AtmosphereScreens`), and return the matplotlib Axes. Raises InputError for a layer
        that there is not.
        """
        from .screens import screens

        data = Data(scene)
        pointing.observe(data)
        scan = data.observations[0].of_each_band()[0]
        own = self.model_copy()
        own.observe(Data(scene, [scan]))
        return screens(own.model(scan), None, 1, 4).plot(layer, ax)

    def collect(self, data: Data, observation: Observation, state: AtNodes | OfDetectors) -> None:
        """Report the mean and rms of the PWV that was drawn while the blocks were worked on."""
        state_drawn(self.model(observation), self.label, state)


def _check_pointing(observation: Observation) -> None:
    quaternions = observation.boresight_azel
    lowest = 1.0
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
