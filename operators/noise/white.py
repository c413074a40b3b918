"""White noise of the detectors."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numba as nb
import numpy as np
from numba import uint64
from pydantic import BeforeValidator, Field, SerializeAsAny, WithJsonSchema, model_validator

from zonda.core.configuration.units import Fraction, KelvinRootSecond
from zonda.core.errors import PipelineError
from zonda.core.numerics.random import TILE, normal_scratch, normal_tile
from zonda.core.numerics.smooth import SmoothField, series_into
from zonda.core.operator import Operator

from .level import LEVELS, NoiseLevel, announce, resolve, scatter_factors
from .models import INSTRUMENTS, FixedNet, NoiseModel, noise_model

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from zonda.core.data import Block, Data, Observation
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate, Traits
    from zonda.core.types import Floats

_SCHEMA = {
    "anyOf": [{"type": "string"}, {"type": "object", "properties": {"name": {"type": "string"}}, "required": ["name"]}],
    "examples": ["background_limited", {"name": "background_limited", "optical_efficiency": 0.3}],
}


class WhiteNoise(Operator):
    """Independent Gaussian noise in every sample of every detector.

    One sample has standard deviation NET sqrt(f_s); the one-sided power spectral density is 2 NET^2. Quoted on the sky, NET
    enters the stream ``white`` as NET zeta <e^-tau>. The NET on the sky, whatever it follows from, is written to
    ``observation.focalplane.net`` in ``prepare``, before later steps are prepared; of several steps with white noise, all of it.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset({"white"})
    prepares_ahead: ClassVar[bool] = True
    only_tells: ClassVar[bool] = True

    net: KelvinRootSecond | None = Field(None, ge=0)
    """Noise-equivalent temperature: the rms of one second of integration; None: the instrument's."""
    reference: Literal["sky", "detector"] = "sky"
    """Whether `net` is quoted on the sky, after division by zeta e^-tau, or at the detector."""
    scatter: Fraction = Field(0.0, ge=0, le=2)
    """Relative scatter of NET from detector to detector (log-normal, mean 1, the same in every observation)."""
    model: Annotated[SerializeAsAny[NoiseModel], BeforeValidator(noise_model), WithJsonSchema(_SCHEMA)] | None = None
    """Noise model that gives NET instead: a registered name, or a mapping with name and parameters."""

    @model_validator(mode="after")
    def _one_source(self) -> WhiteNoise:
        if self.model is not None and self.model_fields_set & {"net", "reference"}:
            raise ValueError("give either net (with reference) or model: the model sets both")
        if self.reference == "detector" and self.net is None:
            raise ValueError("reference: detector needs net; the instrument's NET is quoted on the sky")
        return self

    def observe(self, data: Data) -> None:
        """See `agree`."""
        self.agree(data)

    def agree(self, data: Data, before: Mapping[str, Any] | None = None) -> Mapping[str, Any] | None:
        """Say what the level will be about: map makers lay out their sums for it."""
        model = self.model or FixedNet.of(self.net, self.reference)
        for observation in data.observations:
            level = NoiseLevel(model, scatter_factors(self.scatter, observation, self.label))
            observation.expected_net = partial(_expected, level, observation, observation.expected_net)
        return None

    def configure(self, observation: Observation) -> None:
        """Announce the level to `PinkNoise` and to other white noise."""
        observation.resolved.setdefault(INSTRUMENTS, observation.focalplane.net.copy())
        model = self.model or FixedNet.of(self.net, self.reference)
        announce(observation, self.label, NoiseLevel(model, scatter_factors(self.scatter, observation, self.label)))

    def prepare(self, observation: Observation) -> _State:
        """Stream key; resolves the level."""
        resolve(observation)
        return _State(observation.resolved[LEVELS][self.label], observation.detector_key(self.label), dict(observation.smooth))

    def memory(self, observation: Observation) -> int:
        """Amplitudes at the nodes of the mean emission."""
        return 200 * observation.n_detectors

    def traits(self, observation: Observation) -> Traits:
        """White noise of one sample."""
        from .estimate import white_traits

        return white_traits(observation.resolved[LEVELS][self.label], observation)

    def estimate(self, context: Context) -> Estimate:
        """Its cost: there is no coarser form of it."""
        from zonda.core.plan.estimate import Estimate

        from .estimate import WHITE

        return Estimate((), WHITE)

    def exec(self, block: Block, state: Any) -> None:
        """Add noise to ``white``."""
        add = "white" in block.detdata
        out = block.new("white", zero=False)
        level = self._amplitude(block.observation, state).series(block.detectors, block.samples, out.dtype)
        _add_normals(state.key, block.detectors.start, block.samples.start, *level, add, out)

    def collect(self, data: Data, observation: Observation, state: Any) -> None:
        """State the level."""
        net = 1e3 * state.level.sky_net(observation)
        text = f"{np.median(net):.4g}" + (f" ({net.min():.4g} to {net.max():.4g})" if net.max() > net.min() else "")
        varies = self.model is not None or self.reference == "detector"  # with the load, from scan to scan
        whose = f"{observation.name}: " if varies else ""
        observation.tally.state(self.label, f"{whose}NET on the sky, median (range), mK s^1/2", text)

    def _amplitude(self, observation: Observation, state: _State) -> SmoothField:
        with state.lock:
            if state.amplitude is None:
                changed = [name for name, field in observation.smooth.items() if state.smooth.get(name) is not field]
                if changed and (self.model is not None or self.reference == "detector"):
                    raise PipelineError(
                        f"a step has set the mean {changed[0]} after the noise level that follows from it was resolved",
                        place=self.label,
                        cure="set observation.smooth in configure(), or put that step before the noise",
                    )
                state.amplitude = state.level.amplitude(observation)
            return state.amplitude


@dataclass
class _State:
    """Level, key, the smooth means that the level was resolved with; its amplitude, made with the first block."""

    level: NoiseLevel
    key: NDArray[np.uint32]
    smooth: dict[str, SmoothField]
    amplitude: SmoothField | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)


def _expected(level: NoiseLevel, observation: Observation, others: Callable[[], NDArray[np.floating[Any]]] | None) -> Floats:
    """`NoiseLevel.expected_sky_net` and that of ``others``, in quadrature."""
    net = level.expected_sky_net(observation)
    return net if others is None else np.asarray(np.hypot(net, others()), np.float64)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _add_normals(key, first, start, lines, cell, inside, add, out):  # type: ignore[no-untyped-def]
    """out[d, t] = (or, to ``add``, +=) level n: level the `Series` (lines, cell, inside) of detector first + d at sample
    start + t, n normal deviate start + t of stream first + d."""
    words, bits, tile = normal_scratch()
    level = np.empty(TILE, out.dtype)
    stop = start + out.shape[1]
    for d in range(out.shape[0]):
        for number in range(start // TILE, -(-stop // TILE)):
            origin = number * TILE
            low, high = max(start, origin), min(stop, origin + TILE)
            normal_tile(key, first + d, number, words, bits, tile)
            deviates, row, size = tile[low - origin : high - origin], out[d, low - start : high - start], level[: high - low]
            series_into(lines[d], cell, inside, low, size)
            if add:
                for t in range(uint64(row.size)):  # unsigned: vectorized
                    row[t] += size[t] * deviates[t]
            else:
                for t in range(uint64(row.size)):
                    row[t] = size[t] * deviates[t]
