"""White noise of the detectors."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numba as nb
import numpy as np
from numba import uint64
from pydantic import BeforeValidator, Field, SerializeAsAny, WithJsonSchema, model_validator

from zonda.core.configuration.units import Fraction, KelvinRootSecond
from zonda.core.numerics.random import TILE, normal_scratch, normal_tile
from zonda.core.numerics.smooth import SmoothField, series_into
from zonda.core.operator import Operator

from .level import NoiseLevel, announce, scatter_factors
from .models import INSTRUMENTS, FixedNet, NoiseModel, noise_model

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from zonda.core.data import Block, Data, Observation
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate, Traits

_SCHEMA = {
    "anyOf": [{"type": "string"}, {"type": "object", "properties": {"name": {"type": "string"}}, "required": ["name"]}],
    "examples": ["background_limited", {"name": "background_limited", "optical_efficiency": 0.3}],
}


class WhiteNoise(Operator):
    """Independent Gaussian noise in every sample of every detector.

    One sample has standard deviation NET sqrt(f_s); the one-sided power spectral density is 2 NET^2. Quoted on the sky, NET
    enters the stream ``white`` as NET zeta <e^-tau>. The resolved sky NET is written to ``observation.focalplane.net``: at once
    where it is given, with the first block where it depends on the load.
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
        """Tell map makers a stated level, for which they lay out their sums; what it becomes for each detector follows."""
        if self.net is not None and self.model is None and self.reference == "sky":
            for observation in data.observations:
                observation.resolved.setdefault(INSTRUMENTS, observation.focalplane.net)
                observation.focalplane.net = np.full(observation.n_detectors, self.net)
        return None

    def configure(self, observation: Observation) -> None:
        """Announce the level to `PinkNoise`; set ``focalplane.net`` where it is already known."""
        model = self.model or FixedNet.of(self.net, self.reference)
        held: dict[str, NoiseLevel] = observation.resolved.setdefault("noise levels", {})
        if self.label not in held:  # a companion run keeps the main run's level
            factors = scatter_factors(self.scatter, observation, self.label)
            held[self.label] = NoiseLevel(model, factors)
        announce(observation, held[self.label])
        if isinstance(model, FixedNet) and model.reference == "sky":
            observation.focalplane.net = held[self.label].net(observation).copy()

    def prepare(self, observation: Observation) -> _State:
        """Stream key; the amplitude follows with the first block."""
        level: NoiseLevel = observation.resolved["noise levels"][self.label]
        return _State(level, observation.detector_key(self.label))

    def memory(self, observation: Observation) -> int:
        """Amplitudes at the nodes of the mean emission."""
        return 200 * observation.n_detectors

    def traits(self, observation: Observation) -> Traits:
        """White noise of one sample."""
        from .estimate import white_traits

        return white_traits(observation.resolved["noise levels"][self.label], observation)

    def estimate(self, context: Context) -> Estimate:
        """Its cost: there is no coarser form of it."""
        from zonda.core.plan.estimate import Estimate

        from .estimate import WHITE

        return Estimate((), WHITE)

    def exec(self, block: Block, state: Any) -> None:
        """Add noise to ``white``."""
        add = "white" in block.detdata
        out = block.new("white", zero=False)
        level = state.amplitude(block.observation).series(block.detectors, block.samples, out.dtype)
        _add_normals(state.key, block.detectors.start, block.samples.start, *level, add, out)

    def collect(self, data: Data, observation: Observation, state: Any) -> None:
        """State the level."""
        state.amplitude(observation)
        net = 1e3 * observation.focalplane.net
        text = f"{np.median(net):.4g}" + (f" ({net.min():.4g} to {net.max():.4g})" if net.max() > net.min() else "")
        observation.tally.state(self.label, "NET on the sky, median (range), mK s^1/2", text)


class _State:
    """Level, key, and the amplitude once all operators are prepared."""

    def __init__(self, level: NoiseLevel, key: NDArray[np.uint32]) -> None:
        self.level, self.key = level, key
        self._lock = threading.Lock()
        self._amplitude: SmoothField | None = None

    def amplitude(self, observation: Observation) -> SmoothField:
        with self._lock:
            if self._amplitude is None:
                observation.focalplane.net = self.level.sky_net(observation).copy()
                self._amplitude = self.level.amplitude(observation)
            return self._amplitude


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
