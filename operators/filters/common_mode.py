"""Removes what all detectors see alike: the first singular modes of the signal.

With A the stream (detectors x samples) and u_i the leading eigenvectors of G = A A^T, eigenvalues sigma_i^2,

    A <- A - sum_i u_i v_i^T,   v_i = A^T u_i.                                                            (1)

G is never formed: one step of the Lanczos iteration (full reorthogonalization, float64) reads the stream once and gives
A^T q and A A^T q together. It starts from the detector mean and stops when

    |G u_i - sigma_i^2 u_i| <= residual * sigma_i^2   for every mode that is removed.                        (2)

The detectors' mean (`method: mean`) is found in one reading (`focal_plane_mean`), so that the stream may be larger than memory
and disk; the iteration needs it whole.

The u_i depend on A. Frozen, those of the complete data A act on another stream B (the sky alone):

    B <- B - sum_i u_i (B^T u_i)^T.                                                                          (3)

That is what (1) does to the part B of A = B + C: (3) of B plus (3) of C is (1) of A. (1) also changes with B because B turns
the modes: to first order the filtered A changes by (1 - u u^T) B (1 - v v^T / |v|^2), which is (3) but for one degree of
freedom in N_samples for each mode, and for terms of order sigma_2 / sigma_1.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numba as nb
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from zonda.core.data import Block, Observation, Stream
from zonda.core.errors import PipelineError
from zonda.core.knobs import Knob
from zonda.core.operator import Operator
from zonda.core.random import normals, stream_key
from zonda.core.records import dataclass
from zonda.core.streams import columns, forget_pages
from zonda.core.tiles import TILE_SAMPLES

from . import focal_plane_mean

if TYPE_CHECKING:
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate, Traits

Floats = NDArray[np.float64]

FLAG_DEAD = 8
"""Bit set in ``detector_flags`` of detectors whose signal is constant or not finite."""

ROUNDING = 2.0**-24 / np.sqrt(3.0)
"""rms of float32's relative rounding error."""

EMPTY = 1e-13
"""Share of the stream's energy, per detector, that G cannot tell from rounding."""

NOTHING = 1e-26
"""Share of the stream's energy below which what is left after subtraction is float64 rounding: there is no further mode."""


class CommonModeFilter(Operator):
    """Remove the first singular modes of each scan: equation (1). Flagged samples and detectors take no part."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    prepares_ahead: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "all"
    knobs: ClassVar[tuple[Knob, ...]] = (Knob("residual", (1e-2, 1e-4, 1e-6, 1e-8), "singular modes iterated to a residual"),)

    modes: int = Field(1, ge=1, le=100)
    """How many modes to remove."""
    method: Literal["svd", "mean"] = "svd"
    """Singular modes, or the plain mean of all detectors at each instant (one mode), which streams of any size allow."""
    residual: float = Field(1e-6, gt=1e-12, lt=1e-1)
    """Largest residual of a removed mode, equation (2)."""
    gap: float = Field(0.9, gt=0, lt=1)
    """A mode is determined by the data while the next singular value is at most this times its own."""
    on_undetermined: Literal["mean", "skip", "remove"] = "mean"
    """What to do with a mode that is not determined: remove the detectors' mean (in place of the first), skip or remove it."""

    @model_validator(mode="after")
    def _one_mean(self) -> CommonModeFilter:
        if self.method == "mean" and self.modes != 1:
            raise ValueError("method: mean removes one mode; leave modes at 1 or choose method: svd")
        of_svd = {"residual", "gap", "on_undetermined"} & self.model_fields_set
        if self.method == "mean" and of_svd:
            raise ValueError(f"{sorted(of_svd)[0]} belongs to method: svd; the detectors' mean is exact and always determined")
        return self

    def prepare(self, observation: Observation) -> Modes:
        """Empty modes, filled by `measure`."""
        return Modes(np.zeros((0, observation.n_detectors)), np.zeros((0, observation.n_samples)))

    def memory(self, observation: Observation) -> int:
        """Series over the scan: one for each step of the iteration, or what `focal_plane_mean` adds up."""
        series = 8 if self.method == "mean" else 20 + 8 * self.modes
        return 8 * series * observation.n_samples + 100 * observation.n_detectors

    def sweeps(self, observation: Observation) -> int:
        """One reading for the mean; the singular modes want the stream whole."""
        return 1 if self.method == "mean" else 0

    def measure(self, stream: Stream, state: Modes) -> None:
        """Find the modes. Raises PipelineError where float32 cannot carry the remainder."""
        observation, tally, who = stream.observation, stream.observation.tally, self.label
        place = f"{who}, {observation.name}"
        if stream.means.get("signal") is not None and stream.dtype != np.float64:
            raise PipelineError(
                "the mean emission, tens of kelvin, is still part of the signal and float32 cannot carry it",
                place=place,
                cure="put a HighpassFilter before, or set precision: float64",
            )
        gram: Gram | Usable
        if self.method == "mean":
            gram, found = self._mean(stream)
        else:
            with ThreadPoolExecutor(max(1, stream.threads)) as pool:
                gram = Gram(stream, pool)
                self._flag(gram, observation)
                found = lanczos(gram, self)
                found.count = self._choose(found, gram, observation)
        count = found.count
        state.detectors, state.times = found.detectors[:count], found.times[:count]
        sizes = np.sqrt(np.maximum(found.values[: self.modes + 1], 0.0) / max(1, gram.n_good * gram.n_used))
        values = ", ".join(f"{s:.4g}" for s in sizes)
        worst = found.residuals[:count].max(initial=0.0)
        tally.state(who, f"{observation.name}: singular values / sqrt(detectors x samples)", f"{values or 'none'} K")
        tally.state(who, f"{observation.name}: residual of the modes", f"{worst:.1e} after {found.steps} steps")
        tally.state(who, f"{observation.name}: modes removed", f"{count} ({found.what})")
        self._check_precision(found, count, gram, stream, place)

    def _flag(self, found: Gram | Usable, observation: Observation) -> None:
        for name, dead in (("not finite", found.not_finite), ("constant", found.constant)):
            observation.tally.count(self.label, f"detectors flagged: signal {name}", int(dead.sum()))
            observation.detector_flags[dead] |= FLAG_DEAD

    def _mean(self, stream: Stream) -> tuple[Usable, Ritz]:
        """The detectors' mean as the only mode: u = 1 / sqrt(n) over the good detectors."""
        observation = stream.observation
        good = observation.flags == 0
        usable = Usable(observation.detector_flags == 0, int(good.sum()))
        reading = focal_plane_mean.read(stream, usable.use, good)
        if usable.judge(reading.sums, reading.squares):
            reading = focal_plane_mean.read(stream, usable.use, good)
        self._flag(usable, observation)
        if usable.n_good == 0:
            found = Ritz.nothing(usable.use.size, stream.shape[1])
        else:
            root = np.sqrt(usable.n_good)
            v = reading.total / root
            rank = 1 + (reading.least_left > NOTHING * usable.energy)
            found = Ritz(np.array([v @ v]), (usable.use / root)[None], v[None], np.zeros(1), rank, 1, "detector mean")
        found.count = min(1, max(0, found.rank - 1))
        kept = "modes kept because the data do not determine them (rank)"
        observation.tally.count(self.label, kept, 1 - found.count)
        return usable, found

    def freeze(self, state: Modes) -> Floats:
        """The modes over detectors, (k, n_det)."""
        return state.detectors

    def measure_frozen(self, stream: Stream, state: Modes, frozen: Floats) -> None:
        """Equation (3): v_i = B^T u_i."""
        use, good = np.asarray(frozen.any(axis=0)), stream.observation.flags == 0
        if self.method == "mean":
            total = focal_plane_mean.read(stream, use, good).total
            times = [total * u.max(initial=0.0) for u in frozen]
        else:
            with ThreadPoolExecutor(max(1, stream.threads)) as pool:
                gram = Gram(stream, pool, use)
                times = [gram.apply(u)[1] for u in frozen]
        state.detectors, state.times = frozen, np.array(times).reshape(len(frozen), stream.shape[1])
        what = f"{stream.observation.name}: modes removed"
        stream.observation.tally.state(self.label, what, f"{len(frozen)} (those of the complete data)")

    def _choose(self, found: Ritz, gram: Gram, observation: Observation) -> int:
        """Number of modes to remove; may replace the modes by the detectors' mean."""
        tally = observation.tally
        wanted = min(self.modes, max(0, found.rank - 1))
        tally.count(self.label, "modes kept because the data do not determine them (rank)", self.modes - wanted)
        size = np.sqrt(np.maximum(found.values, 0.0))
        following = np.append(size, 0.0)[1:]
        open_gaps = [i + 1 for i in range(wanted) if following[i] <= self.gap * size[i]]
        determined = max(open_gaps, default=0)
        tally.count(self.label, "modes not determined (gap closed)", wanted - determined)
        if determined == wanted or self.on_undetermined == "remove":
            return wanted
        if self.on_undetermined == "mean" and determined == 0:
            mean = Ritz.of_mean(gram)
            found.detectors, found.times, found.residuals = mean.detectors, mean.times, mean.residuals
            found.what = "detector mean, because the gap is closed"
            return 1
        return determined

    def _check_precision(self, found: Ritz, count: int, gram: Gram | Usable, stream: Stream, place: str) -> None:
        if stream.dtype != np.float32 or not count or gram.energy <= 0:
            return
        left = max(gram.energy - float(found.energies[:count].sum()), 0.0) / gram.energy
        if 0.01 * np.sqrt(left) < ROUNDING:
            rms, ratio = np.sqrt(gram.energy / (gram.n_good * gram.n_used)), 1 / max(np.sqrt(left), 1e-30)
            raise PipelineError(
                f"the common mode, {rms:.3g} K rms, is {ratio:.1e} times what is left, more than float32 can carry",
                place=place,
                cure="set precision: float64",
            )

    def traits(self, observation: Observation) -> Traits:
        """It removes what is common."""
        from zonda.core.plan.estimate import Traits

        return Traits(removes_common=observation.n_detectors > 1)

    def estimate(self, context: Context) -> Estimate:
        """Residual of the modes."""
        from .estimate import common_mode_estimate

        return common_mode_estimate(self, context)

    def exec(self, block: Block, state: Modes) -> None:
        """Equation (1) on one block."""
        signal = block.detdata["signal"]
        mean = block.means.get("signal")
        if mean is not None and len(state.detectors):
            signal += mean.evaluate(block.detectors, block.samples)
            del block.means["signal"]
        for u, v in zip(state.detectors, state.times, strict=True):
            _remove(signal, u[block.detectors], v[block.samples])


@dataclass
class Modes:
    """Modes to remove: u (k, n_det), unit vectors, and v (k, n_samp), K_RJ."""

    detectors: Floats
    times: Floats


class Usable:
    """Which detectors can take part: ``use`` (n_det,) those not flagged, ``n_used`` the number of good samples.

    Attributes
    ----------
    not_finite, constant
        (n_det,): detectors left out by `judge`.
    energy
        Sum of squares of the good detectors.
    """

    def __init__(self, use: NDArray[np.bool_], n_used: int) -> None:
        self.use, self.n_used, self.energy = use, n_used, 0.0
        self.not_finite = self.constant = np.zeros(use.size, bool)

    @property
    def n_good(self) -> int:
        """Number of good detectors."""
        return int(self.use.sum())

    def judge(self, total: Floats, square: Floats) -> bool:
        """Leave out detectors that are constant or not finite, from their sums (n_det,); whether there are any."""
        finite = np.isfinite(square)
        with np.errstate(invalid="ignore"):
            spread = square - total**2 / max(1, self.n_used)
        steady = ~(spread > 1e-12 * square)
        self.not_finite, self.constant = self.use & ~finite, self.use & finite & steady
        self.use = self.use & finite & ~steady
        self.energy = float(np.where(self.use, square, 0.0).sum())
        return bool(self.not_finite.any() or self.constant.any())


class Gram:
    """G = A A^T as an operator on vectors over detectors, without flagged samples, flagged and dead detectors.

    Work is cut into absolute tiles of `TILE_SAMPLES` samples, whose parts are added in order: the bits do not depend on the
    number of threads. The detectors' moments, which tell the dead ones, are taken on the way of the product that the
    iteration begins with; where no detector turns out dead, `apply` has it at hand.
    """

    def __init__(self, stream: Stream, pool: ThreadPoolExecutor, use: NDArray[np.bool_] | None = None) -> None:
        """``use``: the detectors to use, where they are known; they are found otherwise."""
        self.stream, self.pool = stream, pool
        self.n_samples = stream.shape[1]
        self.good_samples = stream.observation.flags == 0
        self.n_used = int(self.good_samples.sum())
        tile = stream.shape[0] * TILE_SAMPLES * stream.dtype.itemsize
        self.copied = isinstance(stream.array, np.memmap) and tile <= MOST_COPIED
        self.whole = stream.means.get("signal") is None and bool(self.good_samples.all()) and not self.copied
        self._known: tuple[Floats, Floats, Floats] | None = None
        if use is not None:
            self.usable = Usable(use, self.n_used)
            return
        use = stream.observation.detector_flags == 0
        vector = _near_the_mean(use)
        total, square, image, times = self._pass(vector, np.flatnonzero(use), moments=True)
        self.usable = Usable(use, self.n_used)
        self.usable.judge(total, square)
        self._known = (vector, image, times) if np.array_equal(self.use, use) else None

    @property
    def use(self) -> NDArray[np.bool_]:
        """Good detectors."""
        return self.usable.use

    @property
    def not_finite(self) -> NDArray[np.bool_]:
        """See `Usable`."""
        return self.usable.not_finite

    @property
    def constant(self) -> NDArray[np.bool_]:
        """See `Usable`."""
        return self.usable.constant

    @property
    def n_good(self) -> int:
        """See `Usable`."""
        return self.usable.n_good

    @property
    def energy(self) -> float:
        """See `Usable`."""
        return self.usable.energy

    def _tiles(self) -> list[slice]:
        return [slice(a, min(a + TILE_SAMPLES, self.n_samples)) for a in range(0, self.n_samples, TILE_SAMPLES)]

    def _tile(self, samples: slice) -> tuple[NDArray[Any], int, int]:
        """An array that holds these samples (mean emission included, zero where flagged), and where in it they are."""
        array, mean, good = np.asarray(self.stream.array), self.stream.means.get("signal"), self.good_samples[samples]
        if mean is None and good.all() and not self.copied:
            return array, samples.start, samples.stop
        copy = columns(self.stream.array if self.copied else array, samples)
        if mean is not None:
            copy += mean.evaluate(slice(0, copy.shape[0]), samples)
        copy[:, ~good] = 0
        return copy, 0, copy.shape[1]

    def _pass(self, q: Floats, rows: NDArray[np.intp], moments: bool = False) -> tuple[Floats, Floats, Floats, Floats]:
        """(A 1, squares, G q, A^T q), the first two (n_det,) only where wanted: one reading of the stream."""
        times, tiles = np.zeros(self.n_samples), self._tiles()
        parts = np.zeros((len(tiles), 3, q.size))

        def work(some: range) -> None:
            if self.whole:  # no tile needs a copy: all in one call
                samples = slice(tiles[some[0]].start, tiles[some[-1]].stop)
                _products(
                    np.asarray(self.stream.array), samples.start, samples.stop, q, rows, times[samples], moments, parts[some[0] :]
                )
            else:
                for k in some:
                    _products(*self._tile(tiles[k]), q, rows, times[tiles[k]], moments, parts[k:])
            forget_pages(self.stream.array)

        some = max(1, len(tiles) // (4 * self.stream.threads))
        self._each(work, [range(k, min(k + some, len(tiles))) for k in range(0, len(tiles), some)])
        total, square, image = parts.sum(axis=0)
        return total, square, image, times

    def apply(self, q: Floats) -> tuple[Floats, Floats]:
        """(G q, A^T q): shapes (n_det,) and (n_samp,); A^T q is 0 at flagged samples."""
        if self._known is not None and np.array_equal(q, self._known[0]):
            return self._known[1], self._known[2]
        return self._pass(q, np.flatnonzero(self.use))[2:]

    def left(self, detectors: Floats, times: Floats) -> float:
        """Energy of A - sum u v^T, formed without cancellation."""

        def work(samples: slice) -> float:
            array, start, stop = self._tile(samples)
            rest = array[self.use, start:stop].astype(np.float64)
            for u, v in zip(detectors, times, strict=True):
                rest -= np.outer(u[self.use], v[samples])
            return float(np.einsum("dt,dt->", rest, rest))

        return float(sum(self._each(work, self._tiles())))

    def _each(self, work: Callable[[Any], Any], items: list[Any]) -> list[Any]:
        """Results of ``work``, in order."""
        return list(map(work, items) if self.stream.threads == 1 else self.pool.map(work, items))


@dataclass
class Ritz:
    """Approximate leading eigenpairs of G, largest first.

    Attributes
    ----------
    values
        sigma_i^2; may be longer than ``detectors``. `energies`: |v_i|^2 of the modes at hand.
    detectors, times
        u_i (k, n_det) and v_i = A^T u_i (k, n_samp).
    residuals
        Left side of (2) over sigma_i^2.
    rank
        Rank of A as far as it matters here (a lower bound).
    """

    values: Floats
    detectors: Floats
    times: Floats
    residuals: Floats
    rank: int
    steps: int
    what: str = "singular modes"
    count: int = 0
    """How many of them are removed."""
    energies: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.energies = np.einsum("kt,kt->k", self.times, self.times)

    @classmethod
    def of_mean(cls, gram: Gram) -> Ritz:
        """The detectors' mean as the only mode: u = 1 / sqrt(n) over the good detectors."""
        if gram.n_good == 0:
            return cls.nothing(gram.use.size, gram.n_samples)
        u = gram.use / np.sqrt(gram.n_good)
        _, v = gram.apply(u)
        rank = 1 + (gram.left(u[None], v[None]) > NOTHING * gram.energy)
        return cls(np.array([v @ v]), u[None], v[None], np.zeros(1), rank, 1, "detector mean")

    @classmethod
    def nothing(cls, n_det: int, n_samples: int) -> Ritz:
        """No mode at all: no detector is left."""
        return cls(np.zeros(0), np.zeros((0, n_det)), np.zeros((0, n_samples)), np.zeros(0), 0, 0, "no good detector")


def lanczos(gram: Gram, how: CommonModeFilter) -> Ritz:
    """Leading modes of ``gram`` to ``how.residual``, or to a tenth where the gap is closed and the modes are not removed."""
    n, wanted = gram.n_good, how.modes
    if n == 0:
        return Ritz.nothing(gram.use.size, gram.n_samples)
    basis: list[Floats] = [_near_the_mean(gram.use)]
    times: list[Floats] = []
    projected = np.zeros((n, n)) if n <= 4096 else np.zeros((512, 512))
    while True:
        m = len(basis)
        image, time = gram.apply(basis[-1])
        times.append(time)
        space = np.array(basis)
        column = space @ image
        projected[:m, m - 1] = projected[m - 1, :m] = column
        rest = image - column @ space
        again = space @ rest
        rest -= again @ space
        rest[~gram.use] = 0.0
        beta = float(np.linalg.norm(rest))
        values, vectors = np.linalg.eigh(projected[:m, :m])
        values, vectors = values[::-1], vectors[:, ::-1]
        floor = EMPTY * n * gram.energy
        residuals = beta * np.abs(vectors[-1]) / np.maximum(values, floor)
        exhausted = m == min(n, len(projected)) or gram.energy - float(values.sum()) <= floor
        enough = m > wanted
        converged = bool((residuals[:wanted] <= how.residual).all())
        closed = False
        if enough and how.on_undetermined != "remove" and m >= wanted + 3:
            size = np.sqrt(np.maximum(values, 0.0))
            rough = bool((residuals[: wanted + 1] <= 0.1).all())
            closed = rough and all(size[i + 1] > how.gap * size[i] for i in range(wanted))
        if exhausted or closed or (enough and converged):
            k = min(wanted, m)
            detectors = np.array(vectors[:, :k].T @ space)
            series = np.array(vectors[:, :k].T @ np.array(times))
            rank = int(np.count_nonzero(values > floor))
            if not exhausted:
                rank += 1
            elif rank < n:  # G squares what is small: look at the remainder itself
                seen = vectors[:, :rank].T
                rank += gram.left(seen @ space, seen @ np.array(times)) > NOTHING * gram.energy
            return Ritz(values, detectors, series, residuals[:k], rank, m)
        if beta <= 1e-14 * gram.energy:  # an invariant subspace: go on in a new direction
            rest = gram.use * _directions(m, gram.use.size)
            for _ in range(2):
                rest = rest - (space @ rest) @ space
            beta = float(np.linalg.norm(rest))
        basis.append(rest / beta)


def _near_the_mean(use: NDArray[np.bool_]) -> Floats:
    """A unit vector (n_det,) close to the mean that no mode is orthogonal to."""
    start = use * (1.0 + 0.01 * _directions(0, use.size))
    return np.asarray(start / max(float(np.sqrt(start @ start)), 1e-300), np.float64)


def _directions(step: int, n_detectors: int) -> Floats:
    """Fixed pseudo-random numbers over detectors (n_det,)."""
    return normals(stream_key(0, "CommonModeFilter", step), 0, n_detectors).astype(np.float64)


MOST_COPIED = 64 << 20
"""Bytes of a tile of a spilled stream up to which it is read into an array of its own."""

LANES = 16
"""Partial sums: fixed, so that bits do not depend on the machine's vectors. Each takes two samples at a time."""


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _products(array, start, stop, q, rows, v, moments, out):  # type: ignore[no-untyped-def]
    """v = A^T q of the samples start .. stop - 1, tile by tile: out (n_tile, 3, n_det) takes each tile's sums and squares,
    where wanted, and A v, of the detectors ``rows``."""
    for k in range(-(-(stop - start) // TILE_SAMPLES)):
        low = start + k * TILE_SAMPLES
        high = min(low + TILE_SAMPLES, stop)
        series = v[low - start : high - start]
        _project(array, low, high, q, rows, series)
        if moments:
            _image_and_moments(array, low, high, rows, series, out[k])
        else:
            _image(array, low, high, rows, series, out[k, 2])


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _project(array, start, stop, q, rows, v):  # type: ignore[no-untyped-def]
    """v = A^T q at samples start .. stop - 1, eight detectors at a time."""
    n = stop - start
    v[:] = 0.0
    eights = rows.size // 8 * 8
    for k in range(0, eights, 8):
        q0, q1, q2, q3 = q[rows[k]], q[rows[k + 1]], q[rows[k + 2]], q[rows[k + 3]]
        q4, q5, q6, q7 = q[rows[k + 4]], q[rows[k + 5]], q[rows[k + 6]], q[rows[k + 7]]
        a, b = array[rows[k], start:stop], array[rows[k + 1], start:stop]
        c, d = array[rows[k + 2], start:stop], array[rows[k + 3], start:stop]
        e, f = array[rows[k + 4], start:stop], array[rows[k + 5], start:stop]
        g, h = array[rows[k + 6], start:stop], array[rows[k + 7], start:stop]
        for t in range(n):
            x = (q0 * np.float64(a[t]) + q1 * np.float64(b[t])) + (q2 * np.float64(c[t]) + q3 * np.float64(d[t]))
            y = (q4 * np.float64(e[t]) + q5 * np.float64(f[t])) + (q6 * np.float64(g[t]) + q7 * np.float64(h[t]))
            v[t] += x + y
    for k in range(eights, rows.size):
        q0, a = q[rows[k]], array[rows[k], start:stop]
        for t in range(n):
            v[t] += q0 * np.float64(a[t])


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _image(array, start, stop, rows, v, out):  # type: ignore[no-untyped-def]
    """out = A v over samples start .. stop - 1, four detectors at a time."""
    n, half = np.uintp(stop - start), np.uintp(LANES)
    whole, last = n // (half + half) * (half + half), rows.size - 1
    lanes = np.empty((4, LANES))
    for k in range(0, rows.size, 4):
        a, b = array[rows[k], start:stop], array[rows[min(k + 1, last)], start:stop]
        c, d = array[rows[min(k + 2, last)], start:stop], array[rows[min(k + 3, last)], start:stop]
        lanes[:] = 0.0
        for t in range(np.uintp(0), whole, half + half):
            for i in range(half):
                x, y = v[t + i], v[t + half + i]
                lanes[0, i] += np.float64(a[t + i]) * x + np.float64(a[t + half + i]) * y
                lanes[1, i] += np.float64(b[t + i]) * x + np.float64(b[t + half + i]) * y
                lanes[2, i] += np.float64(c[t + i]) * x + np.float64(c[t + half + i]) * y
                lanes[3, i] += np.float64(d[t + i]) * x + np.float64(d[t + half + i]) * y
        for j in range(min(4, rows.size - k)):
            row, total = array[rows[k + j], start:stop], 0.0
            for i in range(LANES):
                total += lanes[j, i]
            for t in range(whole, n):
                total += np.float64(row[t]) * v[t]
            out[rows[k + j]] = total


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _image_and_moments(array, start, stop, rows, v, out):  # type: ignore[no-untyped-def]
    """out = A 1, squares, A v (3, n_det): `_image` with the moments in the same reading."""
    n, half = np.uintp(stop - start), np.uintp(LANES)
    whole, last = n // (half + half) * (half + half), rows.size - 1
    lanes = np.empty((4, 3, LANES))
    for k in range(0, rows.size, 4):
        a, b = array[rows[k], start:stop], array[rows[min(k + 1, last)], start:stop]
        c, d = array[rows[min(k + 2, last)], start:stop], array[rows[min(k + 3, last)], start:stop]
        lanes[:] = 0.0
        for t in range(np.uintp(0), whole, half + half):
            for i in range(half):
                x, y = v[t + i], v[t + half + i]
                p, r = np.float64(a[t + i]), np.float64(a[t + half + i])
                lanes[0, 0, i] += p + r
                lanes[0, 1, i] += p * p + r * r
                lanes[0, 2, i] += p * x + r * y
                p, r = np.float64(b[t + i]), np.float64(b[t + half + i])
                lanes[1, 0, i] += p + r
                lanes[1, 1, i] += p * p + r * r
                lanes[1, 2, i] += p * x + r * y
                p, r = np.float64(c[t + i]), np.float64(c[t + half + i])
                lanes[2, 0, i] += p + r
                lanes[2, 1, i] += p * p + r * r
                lanes[2, 2, i] += p * x + r * y
                p, r = np.float64(d[t + i]), np.float64(d[t + half + i])
                lanes[3, 0, i] += p + r
                lanes[3, 1, i] += p * p + r * r
                lanes[3, 2, i] += p * x + r * y
        for j in range(min(4, rows.size - k)):
            row, first, second, third = array[rows[k + j], start:stop], 0.0, 0.0, 0.0
            for i in range(LANES):
                first += lanes[j, 0, i]
                second += lanes[j, 1, i]
                third += lanes[j, 2, i]
            for t in range(whole, n):
                p = np.float64(row[t])
                first += p
                second += p * p
                third += p * v[t]
            out[0, rows[k + j]] = first
            out[1, rows[k + j]] = second
            out[2, rows[k + j]] = third


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _remove(signal, u, v):  # type: ignore[no-untyped-def]
    """signal -= u v^T in float64, rounded once."""
    n_det, n = signal.shape
    for d in range(n_det):
        row, factor = signal[d], u[d]
        for t in range(n):
            row[t] = np.float64(row[t]) - factor * v[t]
