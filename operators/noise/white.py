"""White noise of the detectors."""

from __future__ import annotations

import warnings
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numba import uint64
from pydantic import BeforeValidator, Field, SerializeAsAny, WithJsonSchema, model_validator

from zonda.core.configuration.units import Fraction, KelvinRootSecond
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import placed
from zonda.core.focalplane import Focalplane
from zonda.core.kernels import kernel
from zonda.core.numerics.random import TILE, Key, normal_scratch, normal_tile
from zonda.core.numerics.smooth import series_into
from zonda.core.operator import Operator
from zonda.core.plausibility import NET, doubt

from .models import Amplitude, FixedNet, NoiseLevel, NoiseModel, noise_model, resolve

_SCHEMA = {
    "anyOf": [
        {"type": "string"},
        {"type": "object", "properties": {"name": {"type": "string"}}, "required": ["name"]},
    ],
    "examples": ["background_limited", {"name": "background_limited", "optical_efficiency": 0.3}],
}


class WhiteNoise(Operator):
    """Independent Gaussian noise in every sample of every detector.

    One sample has standard deviation NET sqrt(f_s); the one-sided power spectral density is 2
    NET^2. Quoted on the sky, NET enters the stream ``white`` as NET zeta <e^-tau>. The NET on the
    sky, whatever it follows from, is written to ``observation.focalplane.net`` in ``prepare``,
    before later steps are prepared; of several steps with white noise, all of it.
    """

    requires = frozenset({"boresight"})
    provides = frozenset({"white"})

    net: KelvinRootSecond | None = Field(None, ge=0)
    """Noise-equivalent temperature: the rms of one second of integration; None: the instrument's.
    """
    reference: Literal["sky", "detector"] = "sky"
    """Whether `net` is quoted on the sky, after division by zeta e^-tau, or at the detector."""
    scatter: Fraction = Field(0.0, ge=0, le=2, examples=["10 %"])
    """Relative scatter of NET from detector to detector (log-normal, mean 1, the same in every
    observation).
    """
    model: (
        Annotated[SerializeAsAny[NoiseModel], BeforeValidator(noise_model), WithJsonSchema(_SCHEMA)]
        | None
    ) = None
    """Noise model that gives NET instead: a registered name, or a mapping with name and parameters.
    """

    @model_validator(mode="after")
    def _one_source(self) -> WhiteNoise:
        if self.model is not None and self.model_fields_set & {"net", "reference"}:
            raise ValueError("give either net (with reference) or model: the model sets both")
        if self.reference == "detector" and self.net is None:
            raise ValueError(
                "reference: detector needs net; the instrument's NET is quoted on the sky"
            )
        return self

    def observe(self, data: Data) -> None:
        """Announce the level to `PinkNoise`, and to map makers, which lay out their sums for it."""
        for observation in data.observations:
            self._check(observation.focalplane)
            model = self.model or FixedNet.of(self.net, self.reference)
            observation.noise_levels[self.label] = NoiseLevel(model, self.scatter, self.label)

    def check(self, data: Data) -> list[str]:
        """Refuse a noise model that contradicts the detectors; warn of a NET that none has."""
        if self.net is not None and (
            text := doubt(f"{self.label}: net", self.net, NET, "K sqrt(s)")
        ):
            warnings.warn(text, stacklevel=2)
        for observation in data.observations:
            self._check(observation.focalplane)
        return []

    def _check(self, focalplane: Focalplane) -> None:
        if self.model is not None:
            with placed(self.label):
                self.model.check(focalplane)

    def prepare(self, observation: Observation) -> _State:
        """Resolve the level."""
        resolve(observation)
        amplitude = Amplitude(self.label, observation.noise_levels[self.label], observation)
        return _State(amplitude, observation.detector_key(self.label))

    def exec(self, block: Block, state: _State) -> None:
        """Add noise to ``white``."""
        add = "white" in block.detdata
        out = block.new("white", zero=False)
        level = state.amplitude.of(block.observation).series(
            block.detectors,
            block.samples,
            out.dtype,
        )
        _add_normals(state.key, block.detectors.start, block.samples.start, *level, add, out)

    def collect(self, data: Data, observation: Observation, state: _State) -> None:
        """State the level."""
        level = state.amplitude.level
        net = 1e3 * level.sky_net(observation)
        text = f"{np.median(net):.4g}" + (
            f" ({net.min():.4g} to {net.max():.4g})" if net.max() > net.min() else ""
        )
        whose = f"{observation.name}: " if level.follows_load else ""  # differs from scan to scan
        observation.log.state(self.label, f"{whose}NET on the sky, median (range), mK s^1/2", text)


class _State(NamedTuple):
    amplitude: Amplitude
    key: Key


@kernel
def _add_normals(key, first, start, lines, cell, inside, add, out):  # type: ignore[no-untyped-def]
    """out[d, t] = (or, to ``add``, +=) level n: level the `Series` (lines, cell, inside) of
    detector first + d at sample start + t, n normal deviate start + t of stream first + d."""
    words, bits, tile = normal_scratch()
    level = np.empty(TILE, out.dtype)
    stop = start + out.shape[1]
    for d in range(out.shape[0]):
        for number in range(start // TILE, -(-stop // TILE)):
            origin = number * TILE
            low, high = max(start, origin), min(stop, origin + TILE)
            normal_tile(key, first + d, number, words, bits, tile)
            deviates, row, size = (
                tile[low - origin : high - origin],
                out[d, low - start : high - start],
                level[: high - low],
            )
            series_into(lines[d], cell, inside, low, size)
            if add:
                for t in range(uint64(row.size)):  # unsigned: vectorized
                    row[t] += size[t] * deviates[t]
            else:
                for t in range(uint64(row.size)):
                    row[t] = size[t] * deviates[t]
