"""Pink (1/f) noise of the detectors."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numba as nb
import numpy as np
from numba import uint64
from numpy.typing import NDArray
from pydantic import Field, model_validator

from zonda.core.configuration.units import Fraction, Hertz, KelvinRootSecond
from zonda.core.errors import InputError
from zonda.core.knobs import Knob
from zonda.core.numerics.random import TILE, fill_normals, normal_scratch, normal_tile, normals
from zonda.core.numerics.smooth import Series, SmoothField, series_into
from zonda.core.numerics.tiles import TILE_DETECTORS
from zonda.core.operator import Operator
from zonda.core.types import AnyFloats

from .level import NoiseLevel, announced, resolve
from .models import FixedNet, time_mean
from .one_over_f import PowerLawFilter, power_law_filter

if TYPE_CHECKING:
    from zonda.core.data import Block, Data, Observation
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate, Traits

NOTHING = np.zeros(0, np.float32)

CHECKPOINT = 1 << 16
"""Samples between the filter states that are kept, so that blocks may be asked for in any order."""

_CHUNK = 256
"""Samples filtered together; their 16 x 256 deviates stay in the first-level cache."""


class PinkNoise(Operator):
    """Gaussian noise with a power-law spectrum, its own stream in every detector and observation.

    One-sided power spectral density 2 NET^2 (f_knee / f)^slope from `minimum_frequency` to the Nyquist frequency, at the
    detector as for `WhiteNoise`; flat below. Made by a recursive filter (`power_law_filter`) of white noise, stationary from
    the first sample and of any length. The error of the fitted spectrum is stated in the tally.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset({"pink"})
    prepares_ahead: ClassVar[bool] = True
    only_tells: ClassVar[bool] = True
    knobs: ClassVar[tuple[Knob, ...]] = (
        Knob("poles", (4, 6, 8, 12, 16), "power law by a filter of few poles (their first states are drawn anew)", redraws=True),
    )

    net: KelvinRootSecond | None = Field(None, ge=0)
    """White level that the knee refers to; None: that of `WhiteNoise`, or the instrument's where there is none."""
    reference: Literal["sky", "detector"] = "sky"
    """Whether `net` is quoted on the sky, after division by zeta e^-tau, or at the detector."""
    knee: Hertz | None = Field(None, ge=0)
    """Frequency at which pink noise equals white noise; None: the instrument's; 0: no pink noise."""
    slope: float | None = Field(None, gt=0, le=3)
    """The power spectrum falls as f^-slope; None: the instrument's."""
    minimum_frequency: Hertz | None = Field(None, gt=0)
    """The spectrum is flat below; None: the instrument's."""
    poles: int = Field(8, ge=2, le=16)
    """Accuracy of the spectrum: its error falls about threefold for every two more poles (1.8 % with 8, 0.06 % with 16 for 1/f
    noise over 4.7 decades; with 16 at most 0.45 % for slopes to 2, 1 % to 3, over 7.7 decades)."""
    shared: Fraction = Field(0.0, ge=0, le=1)
    """Share of the variance that all detectors have in common."""

    @model_validator(mode="after")
    def _reference_of_net(self) -> PinkNoise:
        if self.net is None and "reference" in self.model_fields_set:
            raise ValueError("reference says what net refers to: give net too, or neither")
        return self

    def prepare(self, observation: Observation) -> _State | None:
        """Fit the filter; draw the common part.

        Raises
        ------
        InputError
            Where the number of poles cannot fit the spectrum (see `power_law_filter`).
        """
        instrument, rate = observation.instrument, observation.sample_rate
        knee = instrument.knee if self.knee is None else self.knee
        slope = self.slope or instrument.slope
        f_min = self.minimum_frequency or instrument.pink_minimum_frequency
        if knee == 0:
            observation.tally.state(self.label, "pink noise", "none: the knee is at 0 Hz")
            observation.focalplane.knee = np.zeros(observation.n_detectors)
            return None
        try:
            law = power_law_filter(f_min / rate, slope, self.poles)
        except InputError as err:
            raise InputError(err.message, place=self.label, cure=err.cure) from None
        text = f"(f / {knee:g} Hz)^-{slope:g} from {f_min:g} Hz to {rate / 2:g} Hz within {100 * law.error:.2g} %, "
        text += f"levelling off below to {law.plateau:.2g} times its value at {f_min:g} Hz"
        observation.tally.state(self.label, "power over that of white noise", text)
        factor = (knee / f_min) ** (slope / 2) * np.sqrt(law.gain)
        level = None
        if self.net is not None:
            level = NoiseLevel(FixedNet.of(self.net, self.reference), np.ones(observation.n_detectors))
        resolve(observation)
        _state_law(observation, (level or announced(observation)).sky_net(observation), knee, slope, f_min)
        streams = Streams(law, observation.detector_key(self.label), observation.detector_key(self.label, "start"))
        state = _State(factor, level, streams, self.shared)
        if self.shared > 0:
            keys = (observation.detector_key(self.label, "shared", *more) for more in ((), ("start",)))
            common = Streams(law, *keys)
            state.common = np.zeros((1, observation.n_samples), np.float32)
            common.add(0, 0, state.common)
        return state

    def memory(self, observation: Observation) -> int:
        """Filter states that are kept, and the common part."""
        kept = -(-observation.n_detectors // TILE_DETECTORS) * (observation.n_samples // CHECKPOINT + 3)
        common = 12 * observation.n_samples if self.shared > 0 else 0
        return kept * (4 * TILE_DETECTORS * (self.poles + 3) + 300) + common + 80 * observation.n_detectors

    def traits(self, observation: Observation) -> Traits:
        """rms of one sample."""
        from .estimate import pink_traits

        return pink_traits(self, observation)

    def estimate(self, context: Context) -> Estimate:
        """Poles of the filter."""
        from .estimate import pink_estimate

        return pink_estimate(self, context)

    def exec(self, block: Block, state: Any) -> None:
        """Add noise to ``pink``."""
        if state is None:
            block.new("pink")
            return
        add = "pink" in block.detdata
        out = block.new("pink", zero=False)
        level = state.amplitude(block.observation).series(block.detectors, block.samples, out.dtype)
        shared = state.common[0, block.samples]
        state.streams.add(block.detectors.start, block.samples.start, out, level, shared, state.shared, over=not add)

    def collect(self, data: Data, observation: Observation, state: Any) -> None:
        """State the rms."""
        if state is None:
            return
        amplitude = time_mean(state.amplitude(observation), observation.n_detectors, 0.0)
        middle = np.median(amplitude) * np.sqrt(state.streams.law.variance)
        observation.tally.state(self.label, "rms at the detector, median (mK)", f"{1e3 * middle:.4g}")


def _state_law(observation: Observation, net: NDArray[np.float64], knee: float, slope: float, f_min: float) -> None:
    """Write where pink noise equals the white noise of the focal plane: the ``knee`` refers to ``net`` (n_det,)."""
    plane = observation.focalplane
    white = np.where(plane.net > 0, plane.net, net)
    ratio = np.divide(net, white, out=np.ones(len(plane)), where=white > 0)
    plane.knee = knee * ratio ** (2 / slope)
    plane.slope, plane.minimum_frequency = np.full(len(plane), slope), np.full(len(plane), f_min)


class _State:
    """Filtered streams and, once all operators are prepared, their amplitude."""

    def __init__(self, factor: float, level: NoiseLevel | None, streams: Streams, shared: float) -> None:
        self.factor, self.level, self.streams, self.shared = factor, level, streams, shared
        self.common: NDArray[np.float32] = np.zeros((1, 0), np.float32)
        """(1, n_samp), or (1, 0) where nothing is shared."""
        self._lock = threading.Lock()
        self._amplitude: SmoothField | None = None

    def amplitude(self, observation: Observation) -> SmoothField:
        with self._lock:
            if self._amplitude is None:
                level = self.level or announced(observation)
                white = level.amplitude(observation)
                self._amplitude = white.scaled(np.full(observation.n_detectors, self.factor))
            return self._amplitude


@dataclass
class _Tile:
    """Filter states of 16 detectors, (K, 16) float32, by the sample before which they stand."""

    kept: dict[int, NDArray[np.float32]]
    last: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


class Streams:
    """Filtered white noise of every detector at every sample, of unit innovations.

    Detectors are made in absolute tiles of 16, side by side in vector registers. A state is kept every `CHECKPOINT` samples
    and where the latest request ended: visits in order cost nothing extra, any other order gives the same bits.

    Parameters
    ----------
    law
        The filter.
    key, start_key
        Random-stream keys of the white noise and of the stationary first states.
    """

    def __init__(self, law: PowerLawFilter, key: NDArray[np.uint32], start_key: NDArray[np.uint32]) -> None:
        self.law, self.key, self.start_key = law, key, start_key
        padding = -law.poles.size % 4  # the kernel takes sections four at a time; a section with z = q passes its input on
        self._rate = np.append(law.poles, np.ones(padding)).astype(np.float32)
        self._tap = np.append(law.zeros - law.poles, np.zeros(padding)).astype(np.float32)
        self._tiles: dict[int, _Tile] = {}
        self._lock = threading.Lock()

    def add(
        self,
        detector: int,
        sample: int,
        out: AnyFloats,
        level: Series | None = None,
        common: NDArray[np.float32] = NOTHING,
        shared: float = 0.0,
        over: bool = False,
    ) -> None:
        """Add level * noise to ``out`` (n_det, n_samp), whose first element is (detector, sample). Thread-safe.

        ``level``: of the same detectors and samples; absent: 1. ``common`` (n_samp,): a stream that makes up the share
        ``shared`` of the variance. ``over``: put it into ``out``, whatever is there.
        """
        end = detector + out.shape[0]
        if level is None:
            n_samples = sample + out.shape[1]
            ones = SmoothField.constant(np.ones(out.shape[0]), n_samples)
            level = ones.series(slice(0, out.shape[0]), slice(sample, n_samples), out.dtype)
        shares = np.sqrt(np.array([1 - shared, shared])).astype(out.dtype)
        for number in range(detector // TILE_DETECTORS, -(-end // TILE_DETECTORS)):
            origin = number * TILE_DETECTORS
            low, high = max(detector, origin), min(end, origin + TILE_DETECTORS)
            rows = slice(low - detector, high - detector)
            part = Series(level.lines[rows], level.first, level.inside)
            self._add_tile(number, low - origin, sample, part, common, shares, over, out[rows])

    def _add_tile(
        self,
        number: int,
        lane: int,
        sample: int,
        level: Series,
        common: NDArray[np.float32],
        shares: AnyFloats,
        over: bool,
        out: AnyFloats,
    ) -> None:
        with self._lock:
            tile = self._tiles.get(number)
            if tile is None:
                tile = self._tiles[number] = _Tile({0: self._first_state(number)})
        with tile.lock:
            nearest = max(k for k in tile.kept if k <= sample)
            state = tile.kept[nearest].copy()
            law = self._rate, self._tap
            for start, stop in _pieces(nearest, sample):
                _filter(self.key, number, start, stop - start, state, *law, 0, *level, common[:0], shares, over, out[:0])
                self._keep(tile, stop, state)
            for start, stop in _pieces(sample, sample + out.shape[1]):
                part = slice(start - sample, stop - sample)
                these = common[part], shares, over, out[:, part]
                _filter(self.key, number, start, stop - start, state, *law, lane, *level, *these)
                self._keep(tile, stop, state)

    def _keep(self, tile: _Tile, sample: int, state: NDArray[np.float32]) -> None:
        if tile.last % CHECKPOINT and tile.last != sample:
            del tile.kept[tile.last]
        tile.kept[sample], tile.last = state.copy(), sample

    def _first_state(self, number: int) -> NDArray[np.float32]:
        n = self.law.poles.size
        deviates = normals(self.start_key, 0, n * TILE_DETECTORS, stream=number).reshape(n, TILE_DETECTORS)
        state = np.zeros((self._rate.size, TILE_DETECTORS), np.float32)
        state[:n] = self.law.start @ deviates
        return state


def _pieces(start: int, stop: int) -> list[tuple[int, int]]:
    """Cut a range at the multiples of `CHECKPOINT`."""
    cuts = [start, *range((start // CHECKPOINT + 1) * CHECKPOINT, stop, CHECKPOINT), stop]
    return list(pairwise(cuts)) if stop > start else []


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _filter(key, tile, start, n, state, rate, tap, lane, lines, cell, inside, common, shares, over, out):  # type: ignore[no-untyped-def]
    """Equation (2) of `one_over_f` for 16 detectors x n samples; adds level * y of those from ``lane`` on to ``out`` (``over``:
    puts it there).

    ``state`` (K, 16), K a multiple of 4, is moved on by n samples. Deviate 16 t + lane of stream ``tile`` drives sample t.
    ``lines, cell, inside``: the `Series` of the level. shares[0] y + shares[1] common takes the place of y; an empty ``common``
    stream is 0.
    """
    x = np.empty(16 * _CHUNK, np.float32)
    words, bits, _ = normal_scratch()
    level, mixed, nothing = np.empty(_CHUNK, out.dtype), np.empty(_CHUNK, out.dtype), np.zeros(_CHUNK, np.float32)
    for done in range(0, n, _CHUNK):
        m = min(_CHUNK, n - done)
        origin = nb.int64(16) * (nb.int64(start) + done)
        if origin % TILE == 0 and 16 * m % TILE == 0:
            for k in range(16 * m // TILE):
                normal_tile(key, tile, origin // TILE + k, words, bits, x[k * TILE : (k + 1) * TILE])
        else:
            fill_normals(key, tile, origin, x[: 16 * m])
        for k in range(0, rate.size, 4):
            _four_sections(x[: 16 * m], state[k : k + 4].ravel(), rate[k : k + 4], tap[k : k + 4])
        for d in range(uint64(out.shape[0])):
            row, size = out[d, done : done + m], level[:m]
            series_into(lines[d], cell, inside, start + done, size)
            if over:
                row[:] = 0
            shared = common[done : done + m] if common.size else nothing[:m]
            for t in range(uint64(m)):
                mixed[t] = shares[0] * x[uint64(16) * t + uint64(lane) + d] + shares[1] * shared[t]
            for t in range(uint64(m)):
                row[t] += size[t] * mixed[t]


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _four_sections(x, s, rate, tap):  # type: ignore[no-untyped-def]
    """Four sections in place on x (m, 16) and their states s (4, 16), both flat. The inner loop fills vector registers."""
    q0, q1, q2, q3 = rate[0], rate[1], rate[2], rate[3]
    c0, c1, c2, c3 = tap[0], tap[1], tap[2], tap[3]
    for t in range(uint64(x.size // 16)):
        now = uint64(16) * t
        for d in range(uint64(16)):
            y, a = x[now + d], s[d]
            s[d] = a + (y - q0 * a)
            y, a = y + c0 * a, s[d + uint64(16)]
            s[d + uint64(16)] = a + (y - q1 * a)
            y, a = y + c1 * a, s[d + uint64(32)]
            s[d + uint64(32)] = a + (y - q2 * a)
            y, a = y + c2 * a, s[d + uint64(48)]
            s[d + uint64(48)] = a + (y - q3 * a)
            x[now + d] = y + c3 * a
