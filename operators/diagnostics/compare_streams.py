"""`CompareStreams`: a stream of a run beside another one."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Seconds
from zonda.core.data import Block, Data, Observation
from zonda.core.operator import Operator
from zonda.core.storage.ecsv import write_ecsv
from zonda.core.storage.files import product_path
from zonda.core.stream_names import AnyStream, check_signals, streams_asked, streams_needed

from .power_spectrum import Welch, calibration, on_sky, quick_length
from .series import about, check_streams, count_flagged, key_of, no_stream, spread_evenly
from .stream_statistics import Pair, StreamComparison, pair

LEAST_SEGMENTS = 8
"""A segment is at most this part of the scan: with a single one the coherence is 1 whatever the
streams.
"""


@dataclass
class Pairs:
    """Spectra of one scan by detector, and the segment's length in samples (0: the scan is too
    short).
    """

    detectors: NDArray[np.int64]
    length: int
    found: dict[int, Pair] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)


class CompareStreams(Operator):
    """Comparison of a stream with another at this step: rms, correlation, gain, ratio of spectra
    and coherence.

    Both are referred to the calibrated sky as in `PowerSpectrum`, and freed of a straight line in
    each segment: what is slower than a segment is not compared. `signal` holds the mean emission of
    the atmosphere, `atmosphere` is the fluctuation about it. Makes the product
    ``stream_comparison`` (a `StreamComparison`), or one under this step's own name where it has
    one; where there is an output folder, it is written there as tables (ECSV), by frequency and by
    detector. `Plots` and `Report` show it.

    Raises `PipelineError` where a stream is absent at this step.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"stream_comparison"})
    knows_means: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"

    stream: AnyStream = "signal"
    """Which stream: `signal`, that of a signal of `runs` (`signal/noiseless`), a component, or
    another that a step above makes (`pwv`)."""
    reference: AnyStream = "atmosphere"
    """What it is compared with."""
    detectors: int = Field(16, ge=1)
    """Number of detectors, chosen evenly among those not flagged."""
    segment: Seconds = quantity("16 s", gt=0)
    """Length of Welch's segments, at most an eighth of the scan. Shortened to a number of samples
    that transforms quickly.
    """

    @property
    def requires(self) -> frozenset[str]:
        """`signal`, and streams of other steps."""
        return streams_needed(self.streams)

    @property
    def optional(self) -> frozenset[str]:
        """Components among the streams."""
        return streams_asked(self.streams)

    @model_validator(mode="after")
    def _two(self) -> Self:
        if self.stream == self.reference:
            raise ValueError("stream and reference are the same")
        return self

    def check(self, data: Data) -> list[str]:
        """Refuse streams that no step makes."""
        check_streams(data, self.streams, self.label)
        return []

    @property
    def streams(self) -> tuple[str, str]:
        """The stream and its reference."""
        return self.stream, self.reference

    def prepare(self, observation: Observation) -> Pairs:
        check_signals(self.streams, observation, self.label)
        length = min(
            observation.n_samples // LEAST_SEGMENTS, round(self.segment * observation.sample_rate)
        )
        count_flagged(observation, self.label, "the comparison includes")
        chosen = spread_evenly(observation, self.detectors)
        return Pairs(chosen, quick_length(length) if length >= 4 else 0)

    def exec(self, block: Block, state: Pairs) -> None:
        here = (state.detectors >= block.detectors.start) & (state.detectors < block.detectors.stop)
        for detector in state.detectors[here] if state.length else ():
            self._add(block, state, int(detector))

    def collect(self, data: Data, observation: Observation, state: Pairs) -> None:
        if (found := self._finished(observation, state)) is not None:
            data.add(self.label, found)

    def finalize(self, data: Data) -> None:
        found: StreamComparison | None = data.take(self.label)
        if found is None:
            return
        other = "scans left out: other detectors or length"
        data.tally.count(self.label, other, found.of_another_length)
        for figure, text in found.lines():
            data.tally.state(self.label, figure, text)
        data.products[found.product] = found
        if data.output is not None:
            meta = about(
                data,
                STREAM=found.stream,
                REFERENCE=found.reference,
                SCANS=found.observations,
                SEGMENTS=found.segments,
            )
            tables = {"": found.columns(), "_detectors": found.detector_columns()}
            for behind, columns in tables.items():
                name = data.named(f"{found.product}{behind}")
                write_ecsv(product_path(data.output, name, ".ecsv"), columns, meta)

    def _add(self, block: Block, state: Pairs, detector: int) -> None:
        """The spectra of one detector, whose whole scan is in the block."""
        for name in self.streams:
            if name not in block.detdata:
                raise no_stream(name, block.detdata, self.label)
        factor = calibration(block, detector)
        with np.errstate(invalid="ignore", over="ignore"):
            x, y = (on_sky(block, detector, name, factor) for name in self.streams)
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            block.observation.tally.count(
                self.label, "detectors left out for samples that are not finite", 1
            )
            return
        found = pair(x, y, block.observation.sample_rate, state.length)
        with state.lock:
            state.found[detector] = found

    def _finished(self, observation: Observation, state: Pairs) -> StreamComparison | None:
        """Comparison of one scan, in the order of the detectors; None where there is none, which is
        counted.
        """
        if not state.found:
            why = (
                "without a detector to compare" if state.length else "too short to compare streams"
            )
            observation.tally.count(self.label, f"scans {why}", 1)
            return None
        every = sorted(state.found)
        welch = Welch(observation.n_samples, observation.sample_rate, state.length)
        names = [observation.focalplane.names[d] for d in every]
        what = (*self.streams, self.label, key_of(self, "stream_comparison"))
        return StreamComparison.of_pairs(
            [state.found[d] for d in every], welch.frequency, welch.independent, names, what
        )
