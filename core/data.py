"""What flows: the scene, its observations, the blocks that operators work on, and the products."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .flags import EXCLUDE_DETECTOR, EXCLUDE_SAMPLE, good
from .focalplane import Focalplane
from .intervals import Intervals, runs
from .notebook import html_table
from .numerics.random import stream_key
from .numerics.smooth import SmoothField
from .numerics.tiles import TILE_DETECTORS, TILE_SAMPLES
from .types import AnyFloats

if TYPE_CHECKING:
    from .configuration.time import Instant
    from .instrument import Instrument
    from .scene import Scene
    from .site import Site
    from .weather import GroundWeather

STREAMS = ("sky", "atmosphere", "transmission", "white", "pink", "signal")
"""Streams that zonda's own operators make in every block: the components, and their calibrated sum. Their only use is to be read
by a later operator of the same run."""


class Tally:
    """Counts and figures that the user must know of: what was clipped, dropped, approximated. Thread-safe.

    Keys are (who, what): the operator's label and a short phrase with its unit, e.g.
    ``("SkyMap", "samples outside the input map")``.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: dict[tuple[str, str], int] = {}
        self._figures: dict[tuple[str, str], str] = {}
        self._totals: dict[tuple[str, str], int] = {}

    def count(self, who: str, what: str, number: int, of: int = 0) -> None:
        """Add ``number`` to a count (a count of zero is kept: it says that nothing happened); ``of``: among how many, where its
        share is worth telling."""
        with self._lock:
            self._counts[who, what] = self._counts.get((who, what), 0) + int(number)
            if of:
                self._totals[who, what] = self._totals.get((who, what), 0) + int(of)

    def state(self, who: str, what: str, text: str) -> None:
        """Record a figure or a choice as text; the last statement wins."""
        with self._lock:
            self._figures[who, what] = text

    def update(self, other: Tally, prefix: str = "") -> None:
        """Add another tally's counts and statements, ``prefix`` before their operators' labels."""
        for (who, what), number in other._counts.items():
            self.count(prefix + who, what, number, other._totals.get((who, what), 0))
        for (who, what), text in other._figures.items():
            self.state(prefix + who, what, text)

    def __iter__(self) -> Iterator[tuple[str, str, str]]:
        """Rows (who, what, value) in a fixed order."""
        with self._lock:
            rows = [(*k, f"{v}") for k, v in self._counts.items()] + [(*k, v) for k, v in self._figures.items()]
        return iter(sorted(rows))

    def counts(self) -> list[tuple[str, str, int]]:
        """The counts alone, in a fixed order."""
        with self._lock:
            return sorted((*k, v) for k, v in self._counts.items())

    def figures(self) -> list[tuple[str, str, str]]:
        """The statements alone, in a fixed order."""
        with self._lock:
            return sorted((*k, v) for k, v in self._figures.items())

    def totals(self) -> list[tuple[str, str, int]]:
        """Among how many the counts were made that have a share, in a fixed order."""
        with self._lock:
            return sorted((*k, v) for k, v in self._totals.items())

    def told(self) -> Iterator[tuple[str, str, str]]:
        """Rows as `__iter__`, with the share of counts that have one: ``2623184 (20.3 %)``."""
        for who, what, value in self:
            whole = self._totals.get((who, what), 0)
            yield who, what, f"{value} ({percent(self.get(who, what) / whole)})" if whole and self.get(who, what) else value

    def get(self, who: str, what: str) -> int:
        """A count, 0 where there is none."""
        return self._counts.get((who, what), 0)


def percent(share: float, digits: int = 3) -> str:
    """``20.3 %``; never 100 for what is less."""
    return "more than 99.9 %" if 0.9995 < share < 1 else f"{100 * share:.{digits}g} %"


@dataclass
class Observation:
    """One continuous scan.

    Attributes
    ----------
    name, index
        Unique name and position in `Data.observations`.
    start
        Exact start instant.
    seconds
        (n_samp,) float64, increasing, seconds since ``start``: when each sample is taken. They need not be a perfect comb:
        pointing and atmosphere follow them, noise and filters count samples (see `jitter`).
    sample_rate
        Hz; of the comb that comes nearest to ``seconds``.
    boresight_azel, boresight_radec
        (n_samp, 4) float64 quaternions (x, y, z, w), exactly TOAST's: Rz(lon) Ry(pi/2 - lat) Rz(psi), lon = -az for azel.
    centre
        ICRS (ra, dec) [rad] of the scan's target without its per-scan offset: the default map centre.
    flags, detector_flags
        (n_samp,) and (n_det,) uint8, bits of `core.flags`; most of them mean: do not use (`good_samples`, `good_detectors`).
    intervals
        By TOAST's names: (start, stop) of parts of the scan, s since ``start`` (`core.intervals`). Default: all is *scanning*.
    weather
        At the telescope; None: the air of this scan is not known.
    smooth
        Slowly varying float64 fields: ``atmosphere`` (mean emission at the detector before efficiency, K_RJ) and
        ``transmission`` (band-mean e^-tau at the mean PWV), each a `SmoothField`. Set by operators in ``configure``, so that the
        levels which follow from them are known before any step is prepared.
    detdata
        (n_det, n_samp) arrays that an output asked to keep.
    expected_load
        Tells the atmosphere's mean emission [K_RJ] and transmission in the middle of the scan, before ``smooth`` is known; None:
        there is no atmosphere.
    expected_net
        Tells what (n_det,) ``focalplane.net`` will be about, before it is resolved; None: what it is now.
    resolved
        What operators resolved for one another (noise levels). It outlives the main run: companion runs use the same.
    components
        Names of the streams that the steps of the run in progress make before there is a signal: ``sky``, ``white`` ...
    tally
        What was counted or approximated.
    output
        Folder (Path) for files that are written while the scan runs (see `Data.output`).
    """

    name: str
    index: int
    site: Site
    instrument: Instrument
    focalplane: Focalplane
    start: Instant
    seconds: NDArray[np.float64]
    sample_rate: float
    boresight_azel: NDArray[np.float64]
    boresight_radec: NDArray[np.float64]
    centre: tuple[float, float]
    seed: int
    flags: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    detector_flags: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    intervals: Intervals = field(default_factory=dict)
    weather: GroundWeather | None = None
    smooth: dict[str, SmoothField] = field(default_factory=dict)
    detdata: dict[str, AnyFloats] = field(default_factory=dict)
    resolved: dict[str, Any] = field(default_factory=dict)
    tally: Tally = field(default_factory=Tally)
    output: Any = None
    expected_load: Callable[[], tuple[float, float]] | None = None
    expected_net: Callable[[], AnyFloats] | None = None
    components: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if not self.flags.size:
            self.flags = np.zeros(self.n_samples, np.uint8)
        if not self.detector_flags.size:
            self.detector_flags = np.zeros(self.n_detectors, np.uint8)
        if not self.intervals:
            self.intervals = {"scanning": runs(np.ones(self.n_samples, bool), self.seconds)}

    @property
    def n_samples(self) -> int:
        return len(self.seconds)

    @property
    def n_detectors(self) -> int:
        return len(self.focalplane)

    @property
    def good_samples(self) -> NDArray[np.bool_]:
        """(n_samp,) True where no flag excludes the sample."""
        return good(self.flags, EXCLUDE_SAMPLE)

    @property
    def good_detectors(self) -> NDArray[np.bool_]:
        """(n_det,) True where no flag excludes the detector."""
        return good(self.detector_flags, EXCLUDE_DETECTOR)

    @property
    def duration(self) -> float:
        """n_samples / sample_rate, s."""
        return self.n_samples / self.sample_rate

    @property
    def departures(self) -> NDArray[np.float64]:
        """(n_samp,) s by which samples are later than a comb of `sample_rate` with the same mean; zeros for a perfect one."""
        late = self.seconds - (self.seconds[0] + np.arange(self.n_samples) / self.sample_rate)
        return np.asarray(late - late.mean(), np.float64) if late.any() else late

    @cached_property
    def jitter(self) -> float:
        """rms of `departures`, s."""
        late = self.departures
        return float(np.sqrt(np.mean(late * late)))

    def seconds_at(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """`seconds` at sample numbers, which go on at `sample_rate` beyond the ends of the scan."""
        inside = np.clip(index, 0, self.n_samples - 1)
        return np.asarray(self.seconds[inside] + (index - inside) / self.sample_rate, np.float64)

    def key(self, *names: str | int) -> NDArray[np.uint32]:
        """Random-stream key (2,) uint32 that belongs to this seed, this observation and ``names``."""
        return stream_key(self.seed, "observation", self.index, *names)

    def detector_key(self, *names: str | int) -> NDArray[np.uint32]:
        """As `key`, for what belongs to the detectors: noise, gains. Another instrument or another band has numbers of its own.

        The atmosphere is keyed without them: all bands of one seed look through the same.
        """
        return self.key(*self.instrument.identity, *names)

    def derotate(self, which: str) -> tuple[AnyFloats, AnyFloats, AnyFloats]:
        """(lon, lat, psi) of ``boresight_azel`` or ``boresight_radec`` [rad]; for azel lon = -azimuth."""
        x, y, z, w = getattr(self, which).T
        lat = np.arctan2(1 - 2 * (x * x + y * y), 2 * np.hypot(x * z + w * y, y * z - w * x))
        lon = np.arctan2(2 * (y * z - w * x), 2 * (x * z + w * y))
        psi = np.arctan2(2 * (y * z + w * x), -2 * (x * z - w * y))
        return lon % (2 * np.pi), lat, psi

    @property
    def azimuth(self) -> AnyFloats:
        """(n_samp,) rad, north through east, 0 to 2 pi."""
        return (-self.derotate("boresight_azel")[0]) % (2 * np.pi)

    @property
    def elevation(self) -> AnyFloats:
        """(n_samp,) rad."""
        x, y, z, w = self.boresight_azel.T
        return np.asarray(np.arctan2(1 - 2 * (x * x + y * y), 2 * np.hypot(x * z + w * y, y * z - w * x)), np.float64)

    @property
    def ra(self) -> AnyFloats:
        """(n_samp,) rad, ICRS."""
        return self.derotate("boresight_radec")[0]

    @property
    def dec(self) -> AnyFloats:
        """(n_samp,) rad, ICRS."""
        return self.derotate("boresight_radec")[1]

    def __repr__(self) -> str:
        return f"<Observation {self.name}: {self.n_detectors} detectors x {self.n_samples} samples at {self.sample_rate:g} Hz>"

    def _repr_html_(self) -> str:
        rows = [
            ("instrument", self.instrument.name),
            ("site", self.site.name),
            ("start", str(self.start)),
            ("duration", f"{self.duration:.1f} s at {self.sample_rate:g} Hz"),
            ("detectors", self.n_detectors),
            ("elevation", f"{np.degrees(self.elevation.min()):.2f} to {np.degrees(self.elevation.max()):.2f} deg"),
        ]
        return html_table(f"Observation {self.name}", rows)


@dataclass
class Block:
    """A rectangle of detectors x samples of one observation, on which `Operator.exec` works.

    Attributes
    ----------
    observation
        The scan it belongs to. Read only inside ``exec``.
    detectors, samples
        Absolute ranges (slices with start and stop, step None).
    detdata
        Named streams, each (n_det_block, n_samp_block) of `dtype`, C-contiguous. The signal components are `sky`
        (main-beam sky signal above the atmosphere), `atmosphere` (fluctuation of the emission about its mean, before
        efficiency), `transmission` (relative fluctuation of e^-tau about its mean), `white` and `pink` (at the detector),
        all K_RJ but `transmission`; `signal` is the calibrated sum.
    means
        What must be added to a stream in float64 to have all of it, by stream name: the smooth mean emission. A step that does
        not say that it knows of means (`Operator.knows_means`) finds none here: its streams are whole.
    dtype
        float32 or float64: the type of every stream. Where a mean was added for a step that does not know of means, float64.
    """

    observation: Observation
    detectors: slice
    samples: slice
    detdata: dict[str, AnyFloats] = field(default_factory=dict)
    means: dict[str, SmoothField] = field(default_factory=dict)
    dtype: type[np.floating[Any]] = np.float32
    buffers: dict[str, AnyFloats] = field(default_factory=dict, repr=False)
    """Memory reused from block to block; `exec` must not keep a stream beyond the call."""
    places: dict[str, AnyFloats] = field(default_factory=dict, repr=False)
    """Where the executor wants a stream to be made, so that it need not be copied there."""
    again: bool = False
    """These samples were worked on before, and are made again because the streams do not fit in memory: an operator makes the
    same bits and counts nothing (what it tells ``observation.tally`` is thrown away)."""

    @property
    def shape(self) -> tuple[int, int]:
        return self.detectors.stop - self.detectors.start, self.samples.stop - self.samples.start

    def new(self, name: str, *, zero: bool = True) -> AnyFloats:
        """Stream ``name``, made of zeros when it is not there yet; or of anything (not ``zero``), to be overwritten."""
        if name not in self.detdata:
            self.detdata[name] = self.places[name] if name in self.places else self.buffer(name, self.shape)
            if zero:
                self.detdata[name].fill(0)
        return self.detdata[name]

    def buffer(self, name: str, shape: tuple[int, int]) -> AnyFloats:
        """An uninitialized array of `dtype`, reused between blocks under this name."""
        size = shape[0] * shape[1]
        held = self.buffers.get(name)
        if held is None or held.size < size or held.dtype != self.dtype:
            held = self.buffers[name] = np.empty(size, self.dtype)
        return held[:size].reshape(shape)

    def total(self, name: str) -> NDArray[np.float64]:
        """Stream plus its mean, float64: (n_det_block, n_samp_block). A copy."""
        whole = self.detdata[name].astype(np.float64)
        if name in self.means:
            whole += self.means[name].evaluate(self.detectors, self.samples)
        return whole


@dataclass
class Stream:
    """A named stream of one whole observation, between two segments.

    Attributes
    ----------
    array
        (n_det, n_samp) float32 or float64, C order; in memory, or a memory map of a temporary file. A stream that is made again
        when it is read (`core.run.streams`) has none: it is read by `sweep`.
    means
        What must be added in float64 to have all of it, see `Block.means`.
    threads
        Threads an operator's ``measure`` may use.
    room
        Bytes that it may take for a while, beyond what `Operator.memory` said.
    """

    name: str
    observation: Observation
    array: AnyFloats
    means: dict[str, SmoothField]
    threads: int
    room: int = 0

    @property
    def shape(self) -> tuple[int, int]:
        n_det, n_samp = self.array.shape
        return n_det, n_samp

    @property
    def dtype(self) -> np.dtype[Any]:
        """float32 or float64."""
        return self.array.dtype

    def sweep(self, work: Callable[[slice, slice, AnyFloats], Any]) -> Iterator[tuple[slice, slice, Any]]:
        """(detectors, samples, result) of ``work(detectors, samples, part)`` over blocks that cover the stream once.

        ``work`` is called from several threads and must not change or keep the part. Results come in an order in which no
        detector's samples and no sample's detectors are ever out of order, whatever the blocks and threads: what is added up
        tile by tile (`core.numerics.tiles`) has the same bits.
        """
        from .run.streams import forget_pages

        n_det, n_samp = self.shape
        blocks = [
            (slice(d, min(d + SWEEP_DETECTORS, n_det)), slice(t, min(t + SWEEP_SAMPLES, n_samp)))
            for d in range(0, n_det, SWEEP_DETECTORS)
            for t in range(0, n_samp, SWEEP_SAMPLES)
        ]

        def one(detectors: slice, samples: slice) -> tuple[slice, slice, Any]:
            result = work(detectors, samples, self.array[detectors, samples])
            forget_pages(self.array)
            return detectors, samples, result

        return in_order(one, blocks, self.threads)


SWEEP_DETECTORS, SWEEP_SAMPLES = 4 * TILE_DETECTORS, 32 * TILE_SAMPLES
"""What is read at a time of a stream that is kept."""


def in_order(work: Callable[..., Any], items: Iterable[tuple[Any, ...]], threads: int) -> Iterator[Any]:
    """Results of ``work(*item)``, in order, made on several threads that run ahead by at most two items each."""
    if threads == 1:
        yield from (work(*item) for item in items)
        return
    with ThreadPoolExecutor(threads) as pool:
        pending: deque[Future[Any]] = deque()
        try:
            for item in items:
                pending.append(pool.submit(work, *item))
                if len(pending) > 2 * threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


@dataclass
class Data:
    """The scene, its observations, and what came out of them.

    ``products`` maps names to whatever operators made (maps, spectra, file paths); products of a companion run (see
    `Pipeline.runs`) carry its name and a slash: ``noiseless/map``.
    """

    scene: Scene
    observations: list[Observation] = field(default_factory=list)
    products: dict[str, Any] = field(default_factory=dict)
    tally: Tally = field(default_factory=Tally)
    provenance: dict[str, Any] = field(default_factory=dict)
    output: Any = None
    """Folder (Path) that products are written to; None: nothing is written."""
    run: str = ""
    """Name of the companion run in progress; empty in the main run."""
    threads: int = 1
    """Threads that the run may use."""

    def product(self, name: str) -> str:
        """The key of a product of the run in progress."""
        return f"{self.run}/{name}" if self.run else name

    def __repr__(self) -> str:
        return f"<Data: {len(self.observations)} observations, products {sorted(self.products)}>"

    def _repr_html_(self) -> str:
        return html_table(
            "Data",
            [(o.name, f"{o.n_detectors} x {o.n_samples}") for o in self.observations]
            + [("products", ", ".join(sorted(self.products)))],
        )
