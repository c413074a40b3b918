"""Noise models, and the level that white and pink noise share: NET per detector and amplitude.

Noise models other than the fixed NET are plugins: the entry-point group ``zonda.noise_models``
names them. Levels are announced in ``observe`` and resolved in ``prepare``: by then the mean
emission and transmission of the atmosphere and the efficiencies are known, and no step that reads
``focalplane.net`` has been prepared.
"""

from __future__ import annotations

import copy
import threading
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from zonda.core.configuration.diagnostics import refusal
from zonda.core.configuration.parameters import Parameters
from zonda.core.configuration.units import KelvinRootSecond
from zonda.core.errors import PipelineError, ZondaError
from zonda.core.focalplane import Focalplane
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.radiation import LEAST_TRANSMISSION
from zonda.core.numerics.random import normals, stream_key
from zonda.core.numerics.smooth import SmoothField
from zonda.core.observation import Observation, WhiteLevel
from zonda.core.registry import noise_models
from zonda.core.types import Floats

INSTANTS = 64
"""Times of a scan at which its transmission is looked at, at most."""

AT_ONCE = 4096
"""Detectors that are looked at together."""


@dataclass
class NoiseLevel:
    """NET of one observation's detectors, resolved when first asked for: not before every operator
    is configured.
    """

    model: NoiseModel
    scatter: float = 0.0
    """Relative standard deviation from detector to detector."""
    label: str = ""
    """The step whose random numbers scatter it."""
    _net: Floats | None = None

    @property
    def follows_load(self) -> bool:
        """True if it depends on the mean emission or transmission of the atmosphere."""
        return self.model.reference != "sky" or not isinstance(self.model, FixedNet)

    def net(self, observation: Observation) -> Floats:
        """(n_det,) K_RJ sqrt(s) referred to ``model.reference``; the value of the first call
        holds.
        """
        if self._net is None:
            stated = np.asarray(self.model.net(observation), np.float64)
            if stated.shape not in ((), (observation.n_detectors,)):
                raise PipelineError(
                    f"the noise model gives NETs of shape {stated.shape}, for"
                    f" {observation.n_detectors} detectors",
                    place=f"{self.label or type(self.model).__name__}, {observation.name}",
                    cure=f"return an array (n_det,) from {type(self.model).__name__}.net",
                )
            self._net = stated * scatter_factors(self.scatter, observation, self.label)
        return self._net

    def sky_net(self, observation: Observation) -> Floats:
        """(n_det,) K_RJ sqrt(s) on the sky: a level at the detector divided by zeta <e^-tau>, rms
        over the scan.
        """
        if self.model.reference == "sky":
            return self.net(observation)
        calibration = rms_of_inverse(
            observation.smooth.get("transmission"),
            observation.n_detectors,
        )
        return self.net(observation) * calibration / observation.focalplane.main_beam_efficiency

    def expected_sky_net(self, observation: Observation) -> Floats:
        """About what `sky_net` will be, from ``observation.expected_load``, before operators are
        configured.
        """
        rough = copy.copy(observation)
        rough.smooth = {}
        if observation.expected_load is not None and self.follows_load:
            for name, value in zip(
                ("atmosphere", "transmission"),
                observation.expected_load(),
                strict=True,
            ):
                rough.smooth[name] = SmoothField.constant(
                    np.full(observation.n_detectors, value),
                    observation.n_samples,
                )
        return NoiseLevel(self.model, self.scatter, self.label).sky_net(rough)

    def amplitude(self, observation: Observation) -> SmoothField:
        """rms of one sample at the detector, NET sqrt(f_s), times zeta <e^-tau> where NET is quoted
        on the sky; K_RJ.
        """
        sigma = self.net(observation) * np.sqrt(observation.sample_rate)
        if self.model.reference == "sky":
            sigma = sigma * observation.focalplane.main_beam_efficiency
            if transmission := observation.smooth.get("transmission"):
                return transmission.scaled(sigma)
        return SmoothField.constant(sigma, observation.n_samples)


class Amplitude:
    """The amplitude of noise at the detector, made when the first block asks for it: every step is
    prepared by then. Thread-safe.

    Parameters
    ----------
    label
        The step that makes the noise.
    observation
        With the smooth means that ``level`` was resolved with.
    factor
        By which the noise exceeds the level; of all detectors, or (n_det,).
    """

    def __init__(
        self,
        label: str,
        level: WhiteLevel,
        observation: Observation,
        factor: float | Floats = 1.0,
    ) -> None:
        self.label = label
        self.level = level
        self.factor = factor
        self._means = dict(observation.smooth)
        self._lock = threading.Lock()
        self._field: SmoothField | None = None

    def of(self, observation: Observation) -> SmoothField:
        """rms of one sample, K_RJ."""
        with self._lock:
            if self._field is None:
                changed = [
                    name
                    for name, field in observation.smooth.items()
                    if self._means.get(name) is not field
                ]
                if changed and self.level.follows_load:
                    raise PipelineError(
                        f"a step has set the mean {changed[0]} after the noise level that follows"
                        " from it was resolved",
                        place=self.label,
                        cure=(
                            "set observation.smooth in configure(), or put that step before the"
                            " noise"
                        ),
                    )
                self._field = self.level.amplitude(observation)
                if np.any(self.factor != 1):
                    self._field = self._field.scaled(
                        np.broadcast_to(self.factor, observation.n_detectors)
                    )
            return self._field


def scatter_factors(scatter: float, observation: Observation, label: str) -> Floats:
    """Log-normal factors (n_det,) of mean 1 and relative standard deviation ``scatter``; the same
    in every observation with this seed, instrument and band."""
    if scatter == 0:
        return np.ones(observation.n_detectors)
    width = np.sqrt(np.log1p(scatter**2))
    key = stream_key(observation.seed, "noise scatter", *observation.instrument.identity, label)
    deviates = normals(key, 0, observation.n_detectors).astype(np.float64)
    return np.asarray(np.exp(width * deviates - width**2 / 2))


def rms_of_inverse(transmission: SmoothField | None, n_detectors: int) -> Floats:
    """rms over the scan of 1 / <e^-tau> per detector, where it is not opaque (n_det,): what
    calibration makes of noise.
    """
    found = np.ones(n_detectors)
    if transmission is None:
        return found
    cells = transmission.coefficients.shape[1] - 3
    at = 1 + np.unique(np.linspace(0, cells - 1, min(INSTANTS, cells)).round().astype(int))
    middle = (
        transmission.coefficients[:, at] + transmission.coefficients[:, at + 1]
    ) / 2  # of those cells
    for rows in chunks(n_detectors, AT_ONCE):
        passed = transmission.weights[rows].astype(np.float64) @ middle
        clear = passed >= LEAST_TRANSMISSION
        squares = np.where(clear, 1 / np.maximum(passed, LEAST_TRANSMISSION) ** 2, 0.0).sum(axis=1)
        number = clear.sum(axis=1)
        found[rows] = np.where(
            number > 0,
            np.sqrt(squares / np.maximum(number, 1)),
            1 / LEAST_TRANSMISSION,
        )
    return found


def resolve(observation: Observation) -> None:
    """Set ``focalplane.net`` to what all white noise comes to on the sky: levels of several steps
    add in quadrature.
    """
    levels = [level.sky_net(observation) for level in observation.noise_levels.values()]
    if levels:
        if observation.quoted_net is None:
            observation.quoted_net = observation.focalplane.net
        observation.focalplane.net = (
            levels[0].copy() if len(levels) == 1 else np.sqrt(sum(net**2 for net in levels))
        )


def announced(observation: Observation) -> WhiteLevel:
    """The level of the white noise; the instrument's NET where the pipeline makes none."""
    return next(reversed(observation.noise_levels.values()), NoiseLevel(FixedNet()))


class NoiseModel(Parameters):
    """Base class of noise models."""

    name: str = ""
    """Name under which the model is registered (filled in by the pipeline)."""
    reference: Literal["sky", "detector"] = "sky"
    """Where the temperature applies: on the sky, after division by zeta e^-tau, or at the detector.
    """

    def check(self, focalplane: Focalplane) -> None:
        """Refuse parameters that contradict the detectors (`InputError`)."""

    def net(self, observation: Observation) -> Floats:
        """Noise-equivalent temperature (n_det,) K_RJ sqrt(s), referred to `reference`.

        Called when every operator is prepared: ``observation.smooth`` is complete.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define net(observation)")


class FixedNet(NoiseModel):
    """The same NET for any load."""

    level: KelvinRootSecond | None = Field(None, ge=0)
    """Noise-equivalent temperature; None: each detector's own, from the instrument (quoted on the
    sky).
    """

    @model_validator(mode="after")
    def _reference_of_level(self) -> FixedNet:
        if self.level is None and self.reference == "detector":
            raise ValueError(
                "reference: detector needs level; the instrument's NET is quoted on the sky"
            )
        return self

    @classmethod
    def of(cls, level: float | None, reference: Literal["sky", "detector"]) -> FixedNet:
        """The noise model of a checked level in K_RJ sqrt(s)."""
        return cls.model_construct(level=level, reference=reference)

    def net(self, observation: Observation) -> Floats:
        """See `NoiseModel.net`."""
        if self.level is None:
            quoted = observation.quoted_net
            return np.array(observation.focalplane.net if quoted is None else quoted, np.float64)
        return np.full(observation.n_detectors, self.level)


def noise_model(value: Any) -> Any:
    """A `NoiseModel` from its registered name, from a mapping with ``name`` and its parameters, or
    as it is.

    Raises ValueError (shown at the place in the file) for what is not a noise model.
    """
    if isinstance(value, NoiseModel):
        return value
    name = value.get("name") if isinstance(value, dict) else value
    if not isinstance(name, str) or not name:
        raise ValueError(
            "name a noise model, e.g. background_limited, or give a mapping with name and"
            " parameters"
        )
    try:
        found = noise_models.get(name)
        if isinstance(value, dict) or isinstance(found, type):
            found = found(**(value if isinstance(value, dict) else {"name": name}))
        elif callable(found):
            found = noise_models.create(name)
    except ZondaError as err:
        raise refusal(err) from None
    if not isinstance(found, NoiseModel):
        raise ValueError(f"noise model {name!r} is no NoiseModel: {found!r:.60}")
    return found
