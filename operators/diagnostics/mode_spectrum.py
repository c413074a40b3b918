"""Singular values and time streams of what detectors have in common."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Seconds
from zonda.core.data import Data, Observation, Stream
from zonda.core.errors import PipelineError
from zonda.core.operator import Operator

from .components import Lagged, components
from .series import Modes, key_of, publish, spread_evenly

MOST_ROWS = 4096
"""Detectors times delays: the covariance of more takes minutes and gigabytes."""
KEPT = 64
"""Singular values that are kept of each scan."""


class ModeSpectrum(Operator):
    """Singular values of the matrix detectors x time of `signal` at this step, their shares, and
    the leading modes.

    They are the principal components of the detectors' streams: of the values at one instant, or,
    with ``delays``, of the values at several delays (time-lagged components), which see what moves
    across the field. Flagged samples and detectors are left out. Makes the product ``modes`` (a
    `Modes`), or one under this step's own name where it has one: shares are means over the scans,
    streams those of the first. Where there is an output folder, both are written there as tables
    (ECSV). `Plots` and `Report` show them.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"modes"})
    knows_means: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "all"

    modes: int = Field(4, ge=1, le=KEPT)
    """How many leading modes to keep the streams of."""
    delays: int = Field(0, ge=0, le=1000)
    """Number of delays; 0: instantaneous components."""
    delay: Seconds = quantity("0.1 s", gt=0)
    """Length of each delay, rounded to samples."""
    detectors: int = Field(512, ge=2)
    """Number of detectors at most, chosen evenly among those not flagged."""
    center: bool = True
    """Subtract each detector's mean over the scan first."""
    normalize: bool = False
    """Divide each detector's stream by its rms first, so that all count alike."""

    def check(self, data: Data) -> list[str]:
        """Refuse more than `MOST_ROWS` rows."""
        for observation in data.observations[:1]:
            for alone in observation.of_each_band():
                self.prepare(alone)
        return []

    def prepare(self, observation: Observation) -> list[Modes]:
        """The place of what `measure` will find."""
        count = min(self.detectors, observation.n_detectors)
        if count * (self.delays + 1) > MOST_ROWS:
            raise PipelineError(
                f"{count} detectors with {self.delays} delays are more than {MOST_ROWS} rows",
                place=self.label,
                cure=f"set detectors to {max(2, MOST_ROWS // (self.delays + 1))}, or fewer delays",
            )
        return []

    def measure(self, stream: Stream, model: Any = None) -> Any:
        """Read the stream twice: for the covariance, and for the streams of the modes."""
        observation, tally = stream.observation, stream.observation.tally
        chosen = spread_evenly(observation, self.detectors)
        lag = max(1, round(self.delay * observation.sample_rate))
        lagged = Lagged(stream, chosen, self.delays, lag)
        if chosen.size < 2 or np.count_nonzero(lagged.good) < 2:
            tally.count(self.label, "scans without two detectors and two samples: no modes", 1)
            return stream.state
        found = components(lagged, self.modes, center=self.center, normalize=self.normalize)
        left = int(np.count_nonzero(~found.used))
        tally.count(self.label, "detectors left out: signal not finite", left)
        if not found.energy > 0:
            tally.count(self.label, "scans whose signal is constant: no modes", 1)
            return stream.state
        values = found.values[:KEPT]
        modes = Modes(
            np.pad(values, (0, KEPT - values.size))[None],
            np.array([found.energy]),
            observation.seconds,
            found.times,
            found.vectors,
            [observation.focalplane.names[d] for d in chosen],
            self.delays,
            lag / observation.sample_rate if self.delays else 0.0,
            "" if self.normalize else "K_RJ",
            observation.name,
            self.label,
            key_of(self, "modes"),
        )
        stream.state.append(modes)
        return stream.state

    def collect(self, data: Data, observation: Observation, state: list[Modes]) -> None:
        for modes in state:
            data.add(self.label, modes)

    def finalize(self, data: Data) -> None:
        found: Modes | None = data.take(self.label)
        if found is not None:
            tables = {"": found.columns(), "_streams": found.stream_columns()}
            scans = {"SCAN": found.observation, "SCANS": len(found.values)}
            publish(data, found.product, found, tables, **scans)
