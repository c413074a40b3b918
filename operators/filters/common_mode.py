"""Removes what all detectors see alike: the first singular modes of the signal.

With A the stream (detectors x samples) and u_i the leading eigenvectors of G = A A^T, eigenvalues
sigma_i^2,

    A <- A - sum_i u_i v_i^T,
    v_i = A^T u_i.                                                            (1)

G is never formed (`gram`); the modes are iterated (`gram.lanczos`) until

    |G u_i - sigma_i^2 u_i| <= residual * sigma_i^2   for every mode that is removed.            (2)

The detectors' mean (`method: mean`) is found in one reading or two (`read_mean`), so that the
stream may be larger than memory and disk; the iteration needs it whole.

The u_i depend on A. With `modes: full` those of the complete data A act on another signal B (the
sky alone):

    B <- B - sum_i u_i (B^T u_i)^T.                                                              (3)

That is what (1) does to the part B of A = B + C: (3) of B plus (3) of C is (1) of A. (1) also
changes with B because B turns the modes: to first order the filtered A changes by (1 - u u^T) B (1
- v v^T / |v|^2), which is (3) but for one degree of freedom in N_samples for each mode, and for
terms of order sigma_2 / sigma_1.
"""

from __future__ import annotations

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from zonda.core.data import Block, Observation, Stream
from zonda.core.errors import PipelineError
from zonda.core.flags import DEAD
from zonda.core.kernels import contracted
from zonda.core.numerics.chunks import TILE_DETECTORS, TILE_SAMPLES, chunks
from zonda.core.signal import MAIN
from zonda.core.types import AnyFloats, Bools, Floats

from .gram import NOTHING, Gram, Ritz, Usable, lanczos
from .rows import LinearFilter
from .source_mask import MASKED, Inside, SourceMask, counts

Mask = Bools


@dataclass
class Reading:
    """Sums of one reading of a stream.

    Attributes
    ----------
    total
        (n_samp,): sum over the detectors in use; 0 at flagged samples.
    low, high
        (n_samp,): the least and the largest value among them.
    sums, squares
        (n_det,): of each detector's good samples.
    """

    total: Floats
    low: Floats
    high: Floats
    sums: Floats
    squares: Floats

    @property
    def least_left(self) -> float:
        """Lower bound of the energy that is left without the mean: sum_t (high - low)^2 / 2, no
        cancellation in it.
        """
        seen = self.high > self.low
        return float(0.5 * ((self.high[seen] - self.low[seen]) ** 2).sum())


def read_mean(stream: Stream, use: Mask, good: Mask, inside: Inside | None = None) -> Reading:
    """One sweep over a stream of any size: the detectors' mean at each instant is `Reading.total`
    over the number of detectors in ``use``.

    The sum runs over the `TILE_DETECTORS` detectors of a tile, then over the tiles in order, in
    float64: it has the same bits however the stream is cut.

    ``use`` (n_det,), ``good`` (n_samp,): which detectors and samples take part; ``inside``: a
    source mask, outside of which the mean is taken at each instant, 0 where no detector is.
    """
    n_det, n_samp = stream.shape
    reading = Reading(
        np.zeros(n_samp),
        np.full(n_samp, np.inf),
        np.full(n_samp, -np.inf),
        np.zeros(n_det),
        np.zeros(n_det),
    )
    field = stream.means.get(stream.name)

    taking = np.zeros(n_samp)  # detectors outside of the mask

    def look(detectors: slice, samples: slice, part: AnyFloats) -> tuple[Floats, ...]:
        rows, n = part.shape
        sums = np.zeros((-(-rows // TILE_DETECTORS), n))
        range_of = np.empty((2, n))
        range_of[0], range_of[1] = np.inf, -np.inf
        count = np.zeros(n)
        moments = np.zeros((-(-n // TILE_SAMPLES), 2, rows))
        for here, added in zip(chunks(n, TILE_SAMPLES), moments, strict=True):
            at = slice(samples.start + here.start, samples.start + here.stop)
            tile = part
            begin = here.start
            end = here.stop
            if field is not None or inside is not None or not good[at].all():
                tile = part[:, here].astype(np.float64)
                begin = 0
                end = here.stop - here.start
                if field is not None:
                    tile += field.evaluate(detectors, at)
                tile[:, ~good[at]] = 0
            if inside is None:
                _look(tile, begin, end, use[detectors], sums[:, here], range_of[:, here], added)
                continue
            _look(
                tile,
                begin,
                end,
                np.zeros(rows, np.bool_),
                sums[:, here],
                range_of[:, here],
                added,
            )
            seen = use[detectors, None] & ~inside.at(detectors, at)
            for k in range(0, rows, TILE_DETECTORS):
                few = slice(k, k + TILE_DETECTORS)
                sums[k // TILE_DETECTORS, here] = np.where(seen[few], tile[few], 0.0).sum(axis=0)
            range_of[0, here] = np.where(seen, tile, np.inf).min(axis=0)
            range_of[1, here] = np.where(seen, tile, -np.inf).max(axis=0)
            count[here] = seen.sum(axis=0)
        return sums, range_of, moments, count

    for detectors, samples, (sums, range_of, moments, count) in stream.sweep(look):
        taking[samples] += count
        for tile in sums:
            reading.total[samples] += tile
        np.minimum(reading.low[samples], range_of[0], out=reading.low[samples])
        np.maximum(reading.high[samples], range_of[1], out=reading.high[samples])
        for first, second in moments:
            reading.sums[detectors] += first
            reading.squares[detectors] += second
    if inside is not None:
        reading.total *= int(use.sum()) / np.maximum(taking, 1)
    return reading


LANES = 32
"""Partial sums of a detector's moments: fixed, so that bits do not depend on the machine's vectors.
"""


@contracted
def add_moments(row, lanes, out):  # type: ignore[no-untyped-def]
    """Add the sum and the sum of squares of ``row`` (n,) to ``out`` (2,). ``lanes`` (2, LANES):
    scratch.
    """
    n = row.size
    whole = n // LANES * LANES
    first, second = lanes[0], lanes[1]
    first[:] = 0.0
    second[:] = 0.0
    for base in range(0, whole, LANES):
        x = row[base : base + LANES]
        for i in range(LANES):
            y = np.float64(x[i])
            first[i] += y
            second[i] += y * y
    for t in range(whole, n):
        first[0] += row[t]
        second[0] += np.float64(row[t]) ** 2
    for i in range(LANES):
        out[0] += first[i]
        out[1] += second[i]


@contracted
def _look(part, start, stop, use, sums, range_of, moments):  # type: ignore[no-untyped-def]
    """Add samples start .. stop - 1 of ``part`` to ``sums`` (tiles, n), ``range_of`` (2, n) and
    ``moments`` (2, n_det).
    """
    n = stop - start
    lanes = np.empty((2, LANES))
    low, high = range_of[0], range_of[1]
    for d in range(part.shape[0]):
        row = part[d, start:stop]
        if use[d]:
            total = sums[d // TILE_DETECTORS]
            for t in range(n):
                x = np.float64(row[t])
                total[t] += x
                low[t] = min(low[t], x)
                high[t] = max(high[t], x)
        add_moments(row, lanes, moments[:, d])


ROUNDING = 2.0**-24 / np.sqrt(3.0)
"""rms of float32's relative rounding error."""

KEPT = "modes kept because the data do not determine them (rank)"
UNDETERMINED = "degenerate modes (the next singular value is nearly as large)"
"""Counts of the log. Degenerate: the next singular value is more than `gap` times the mode's own.
"""


class CommonModeFilter(LinearFilter):
    """Filter that removes the leading singular modes of each scan, equation (1). Flagged samples
    and detectors are excluded.

    Detectors whose complete signal is not finite are flagged, and those whose complete signal is
    constant: they are dead. In a scene of the sky alone a constant signal is a valid zero, which
    takes part.
    """

    knows_means = True
    couples = "all"

    modes: int = Field(1, ge=1, le=100)
    """How many modes to remove."""
    group: Literal["band", "wafer", "all"] = "band"
    """Whose modes are found together: those of all detectors of a band, of each wafer of it, or of
    all bands of the camera.
    """
    method: Literal["svd", "mean"] = "svd"
    """Singular modes, or the mean of all detectors at each instant (one mode), which needs little
    memory.
    """
    residual: float = Field(1e-6, gt=1e-12, lt=1e-1)
    """Largest residual of a removed mode, equation (2)."""
    gap: float = Field(0.9, gt=0, lt=1)
    """A mode is determined by the data while the next singular value is at most this times its own.
    """
    scale: Literal["none", "rms"] = "none"
    """`rms`: the modes are those of streams of unit rms, equation (4), as in the mapper of maria
    1.0.0.
    """
    mask: SourceMask | None = None
    """Source whose samples are not used to find the modes, which are subtracted there too. Where it
    covers all detectors at an instant, nothing is subtracted: choose it smaller than the field of
    view."""
    on_undetermined: Literal["mean", "skip", "remove"] = "mean"
    """What to do with a mode that is not determined: remove the detectors' mean (in place of the
    first), skip or remove it.
    """

    @model_validator(mode="after")
    def _one_mean(self) -> CommonModeFilter:
        if self.method == "mean" and self.modes != 1:
            raise ValueError(
                "method: mean removes one mode; leave modes at 1 or choose method: svd"
            )
        of_svd = {"residual", "gap", "on_undetermined"} & self.model_fields_set
        if self.method == "mean" and of_svd:
            raise ValueError(
                f"{sorted(of_svd)[0]} belongs to method: svd; the detectors' mean is exact and"
                " always determined"
            )
        if self.method == "mean" and self.scale == "rms":
            raise ValueError("scale: rms belongs to method: svd; the detectors' mean has no scale")
        return self

    @property
    def all_bands(self) -> bool:
        """True where the modes are those of all bands' detectors."""
        return self.group == "all"

    def of_rows(self, measured: Modes, rows: slice) -> Modes:
        """The modes, for some of the detectors."""
        scale = None if measured.scale is None else measured.scale[rows]
        return Modes(measured.detectors[:, rows], measured.times, scale)

    def _inside(self, observation: Observation) -> Inside | None:
        return self.mask.of_modes(observation, self.label) if self.mask else None

    def measure(self, stream: Stream, model: Modes | None = None) -> Modes:
        """Find the modes; given those of the complete signal (``model``), their times in this
        one.
        """
        if self.group == "wafer":
            return self._wafer_by_wafer(stream, model)
        return self._modes(stream, model)

    def exec(self, block: Block, state: Modes) -> None:
        """Equation (1) on one block."""
        signal = block.detdata["signal"]
        mean = block.means.get("signal")
        if mean is not None and len(state.detectors):
            signal += mean.evaluate(block.detectors, block.samples)
            del block.means["signal"]
        for u, v in zip(state.detectors, state.times, strict=True):
            if not state.parts or u[block.detectors].any():
                _remove(signal, u[block.detectors], v[block.samples])

    def adjoint(self, block: Block, state: Modes) -> None:
        """The transpose of equation (3) on a block of all detectors, in float64 without means:
        B <- B - sum_i R^-1 u_i (B^T R u_i)^T at good samples. In a source mask, what a sample is
        filled with is given back to those that it is the mean of.
        """
        signal = block.detdata["signal"]
        good = block.observation.good_samples
        inside = self._inside(block.observation)
        every = block.detectors
        for modes in state.parts or (state,):
            unit = np.ones(len(signal)) if modes.scale is None else modes.scale
            use = np.asarray(modes.detectors.any(axis=0))[:, None]
            for at in chunks(signal.shape[1], TILE_SAMPLES):
                rows = np.where(use, signal[:, at], 0.0)
                times = np.einsum("kd,dt->kt", modes.detectors, rows) * good[at]
                taken = np.einsum("kd,kt->dt", modes.detectors / unit**2, times)
                if inside is not None:
                    masked = inside.at(every, at)
                    filled = (unit[:, None] * taken * masked).sum(axis=0)
                    filled /= np.maximum((use & ~masked).sum(axis=0), 1)
                    taken = np.where(masked, 0.0, taken + use * filled / unit[:, None])
                signal[:, at] -= taken

    def _modes(self, stream: Stream, model: Modes | None) -> Modes:
        """The modes of all detectors that are not flagged; see `measure`."""
        search = ModeSearch(self, stream, self._inside(stream.observation))
        return search.found() if model is None else search.of(model)

    def _wafer_by_wafer(self, stream: Stream, model: Modes | None) -> Modes:
        """The modes of each wafer's detectors: all others count as flagged."""
        whole = stream.observation
        parts = []
        for k, wafer in enumerate(np.unique(whole.focalplane.wafer).tolist()):
            part = copy.copy(stream)
            others = whole.focalplane.wafer != wafer
            part.observation = copy.copy(whole)
            part.observation.name = f"{whole.name}, wafer {wafer}"
            part.observation.detector_flags = whole.detector_flags | np.where(
                others,
                DEAD,
                0,
            ).astype(np.uint8)
            parts.append(self._modes(part, model.parts[k] if model else None))
            whole.detector_flags[~others] |= part.observation.detector_flags[~others]
        detectors, times = (
            np.concatenate(found)
            for found in zip(*((p.detectors, p.times) for p in parts), strict=True)
        )
        return Modes(detectors, times, None, tuple(parts))


@dataclass
class Modes:
    """Modes to remove: u (k, n_det), unit vectors, and v (k, n_samp), K_RJ; with a ``scale``
    (n_det,), K_RJ, R u and v / K_RJ.
    """

    detectors: Floats
    times: Floats
    scale: Floats | None = None
    parts: tuple[Modes, ...] = ()
    """Those of each wafer, where modes are found wafer by wafer."""


@dataclass(frozen=True)
class ModeSearch:
    """The modes of one stream.

    Attributes
    ----------
    step
        Parameters of the filter.
    inside
        Samples in the source mask, which are not used; None: no mask.
    """

    step: CommonModeFilter
    stream: Stream
    inside: Inside | None

    def found(self) -> Modes:
        """The modes of all detectors that are not flagged; the log says what they are.

        Raises PipelineError if float32 cannot carry the mean emission, or the modes.
        """
        step = self.step
        stream = self.stream
        place = f"{step.label}, {stream.observation.name}"
        if stream.means.get("signal") is not None and stream.dtype != np.float64:
            raise PipelineError(
                "the mean emission, tens of kelvin, is still part of the signal and float32 cannot"
                " carry it",
                place=place,
                cure="put a HighpassFilter before, or set precision: float64",
            )
        detectors, found = self._mean_mode() if step.method == "mean" else self._singular_modes()
        self._tell(detectors, found)
        _check_precision(found, detectors, stream, place)
        scale = np.ones(detectors.use.size) if detectors.scale is None else detectors.scale
        modes = found.detectors[: found.count] * scale
        return Modes(modes, found.times[: found.count], detectors.scale)

    def of(self, model: Modes) -> Modes:
        """Equation (3) of `common_mode`: v_i = B^T u_i, or B^T R^-1 u_i, of given modes."""
        stream = self.stream
        inside = self.inside
        modes = model.detectors if model.scale is None else model.detectors / model.scale
        use = np.asarray(modes.any(axis=0))
        good = stream.observation.good_samples
        if self.step.method == "mean":
            total = read_mean(stream, use, good, inside).total
            times = [total * u.max(initial=0.0) for u in modes]
        else:
            with ThreadPoolExecutor(max(1, stream.threads)) as pool:
                gram = Gram(stream, pool, use, inside=inside)
                gram.scale = model.scale
                times = [gram.apply(u)[1] for u in modes]
        array = np.array(times).reshape(len(modes), stream.shape[1])
        return Modes(model.detectors, array, model.scale)

    def _singular_modes(self) -> tuple[Usable, Ritz]:
        """The leading singular modes, with the number of those to remove."""
        step = self.step
        stream = self.stream
        inside = self.inside
        with ThreadPoolExecutor(max(1, stream.threads)) as pool:
            gram = Gram(stream, pool, None, _sees_nothing(stream), inside, step.scale == "rms")
            gap = None if step.on_undetermined == "remove" else step.gap
            found = lanczos(gram, step.modes, step.residual, gap)
            found.count = self._choose(found, gram)
        return gram, found

    def _mean_mode(self) -> tuple[Usable, Ritz]:
        """The detectors' mean as the only mode: u = 1 / sqrt(n) over the good detectors."""
        stream = self.stream
        inside = self.inside
        observation = self.stream.observation
        good = observation.good_samples
        detectors = Usable(observation.good_detectors, int(good.sum()))
        reading = read_mean(stream, detectors.use, good, inside)
        if detectors.judge(reading.sums, reading.squares, _sees_nothing(stream)):
            reading = read_mean(stream, detectors.use, good, inside)
        if detectors.n_good == 0:
            found = Ritz.nothing(detectors.use.size, stream.shape[1])
        else:
            root = np.sqrt(detectors.n_good)
            v = reading.total / root
            rank = 1 + (reading.least_left > NOTHING * detectors.energy)
            u = detectors.use / root
            values = np.array([v @ v])
            found = Ritz(values, u[None], v[None], np.zeros(1), rank, 1, "detector mean")
        found.count = min(1, max(0, found.rank - 1))
        observation.log.count(self.step.label, KEPT, 1 - found.count)
        return detectors, found

    def _choose(self, found: Ritz, gram: Gram) -> int:
        """Number of modes to remove; may replace the modes by the detectors' mean."""
        step = self.step
        log = self.stream.observation.log
        wanted = min(step.modes, max(0, found.rank - 1))
        size = np.append(np.sqrt(np.maximum(found.values, 0.0)), 0.0)
        determined = max(
            (i + 1 for i in range(wanted) if size[i + 1] <= step.gap * size[i]),
            default=0,
        )
        log.count(step.label, KEPT, step.modes - wanted)
        log.count(step.label, UNDETERMINED, wanted - determined)
        if determined == wanted or step.on_undetermined == "remove":
            return wanted
        if step.on_undetermined == "mean" and determined == 0:
            u = gram.use / np.sqrt(gram.n_good)
            found.detectors, found.times = u[None], gram.apply(u)[1][None]
            found.residuals = np.zeros(1)
            found.what = "detector mean, because the first mode is degenerate"
            return 1
        return determined

    def _tell(self, detectors: Usable, found: Ritz) -> None:
        """State what was found; flag the dead detectors, which the complete signal shows."""
        stream = self.stream
        inside = self.inside
        observation = stream.observation
        log = stream.observation.log
        who = self.step.label
        if inside is not None:
            masked, covered = counts(inside, observation.n_detectors, observation.n_samples)
            log.count(who, MASKED, masked, observation.n_detectors * observation.n_samples)
            what = "instants with all detectors in the source mask: no mode removed"
            log.count(who, what, covered, observation.n_samples)
        if stream.signal == MAIN:
            useless = {"not finite": detectors.not_finite, "constant": detectors.constant}
            for name, dead in useless.items():
                log.count(who, f"detectors flagged: signal {name}", int(dead.sum()))
                observation.detector_flags[dead] |= DEAD
        sizes = np.sqrt(
            np.maximum(found.values[: self.step.modes + 1], 0.0)
            / max(1, detectors.n_good * detectors.n_used)
        )
        values = ", ".join(f"{s:.4g}" for s in sizes)
        worst = found.residuals[: found.count].max(initial=0.0)
        unit = "K" if detectors.scale is None else "of the detectors' rms"
        log.state(
            who,
            f"{observation.name}: singular values / sqrt(detectors x samples)",
            f"{values or 'none'} {unit}",
        )
        log.state(
            who,
            f"{observation.name}: residual of the modes",
            f"{worst:.1e} after {found.steps} steps",
        )
        log.state(who, f"{observation.name}: modes removed", f"{found.count} ({found.what})")


def _check_precision(found: Ritz, detectors: Usable, stream: Stream, place: str) -> None:
    if stream.dtype != np.float32 or not found.count or detectors.energy <= 0:
        return
    left = (
        max(detectors.energy - float(found.energies[: found.count].sum()), 0.0) / detectors.energy
    )
    if 0.01 * np.sqrt(left) < ROUNDING:
        unit = 1.0 if detectors.scale is None else float(np.median(detectors.scale[detectors.use]))
        rms = unit * np.sqrt(detectors.energy / (detectors.n_good * detectors.n_used))
        ratio = 1 / max(np.sqrt(left), 1e-30)
        raise PipelineError(
            f"the common mode, {rms:.3g} K rms, is {ratio:.1e} times what is left, more than"
            " float32 can carry",
            place=place,
            cure="set precision: float64",
        )


def _sees_nothing(stream: Stream) -> bool:
    """True if a detector in order may have a constant signal: that of the sky alone, or one that is
    not the complete signal, which shows dead detectors."""
    of_the_sky = bool(stream.components) and all(
        c.enters == "above the atmosphere" for c in stream.components
    )
    return stream.signal != MAIN or of_the_sky


@contracted
def _remove(signal, u, v):  # type: ignore[no-untyped-def]
    """signal -= u v^T in float64, rounded once."""
    n_det, n = signal.shape
    for d in range(n_det):
        row, factor = signal[d], u[d]
        for t in range(n):
            row[t] = np.float64(row[t]) - factor * v[t]
