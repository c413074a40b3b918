"""Singular values and time streams of what detectors have in common: their principal components,
instantaneous and time-lagged.

With x_d(t) the stream of detector d at the good samples t, and K delays of L samples, the rows of A
are

    A_(d,k)(t) = x_d(t + k L) - <x_d(t + k L)>,
    k = 0 ... K                                               (1)

(multichannel singular spectrum analysis, Broomhead & King 1986; K = 0: the instantaneous
components). With C = A A^T, its eigenvectors u_i and eigenvalues sigma_i^2,

    share_i = sigma_i^2 / tr C,
    v_i(t) = sum_(d,k) u_i(d,k) A_(d,k)(t).                                     (2)

C is added up in float64 over tiles of fixed length, in order, of streams from which their first
good sample is subtracted: the bits do not depend on blocks or memory, and microkelvins survive
beside tens of kelvin.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Seconds
from zonda.core.data import Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.stream import Stream, forget_pages
from zonda.core.types import Bools, Floats, Integers

from .series import Modes, StreamDiagnostic, spread_evenly


@dataclass
class Components:
    """Principal components of one scan.

    Attributes
    ----------
    values
        (n,) singular values sigma_i, largest first, divided by the root of the number of rows and
        samples of A.
    energy
        Their sum of squares over all i.
    vectors
        (m, n_row) the leading u_i, the component of largest magnitude positive; rows d + n_det k.
    times
        (m, n_samp) the leading v_i; NaN where a sample that it needs is flagged.
    used
        (n_det,) False for detectors that were left out because they are not finite.
    """

    values: Floats
    energy: float
    vectors: Floats
    times: Floats
    used: Bools


class Lagged:
    """The rows of A, equation (1), tile by tile: ``detectors`` of a stream, ``delays`` of ``lag``
    samples.
    """

    def __init__(self, stream: Stream, detectors: Integers, delays: int, lag: int) -> None:
        self.stream = stream
        self.detectors = detectors
        self.delays = delays
        self.lag = lag
        self.n_rows = detectors.size * (delays + 1)
        self.n_samples = max(0, stream.shape[1] - delays * lag)
        good = stream.observation.good_samples
        self.good = np.ones(self.n_samples, bool)
        for k in range(delays + 1):
            self.good &= good[k * lag : k * lag + self.n_samples]
        first = int(np.argmax(self.good)) if self.good.any() else 0
        self.used = np.ones(detectors.size, bool)
        self._start = np.zeros((detectors.size, 1))
        self._start = np.nan_to_num(self._columns(slice(first, first + 1)), posinf=0.0, neginf=0.0)

    def tiles(self) -> Iterator[tuple[slice, Floats]]:
        """(samples, rows (n_row, n)) with zeros at flagged samples; detectors that are not finite
        are found in `used`.
        """
        for start in range(0, self.n_samples, TILE_SAMPLES):
            at = slice(start, min(start + TILE_SAMPLES, self.n_samples))
            x = self._columns(slice(at.start, at.stop + self.delays * self.lag))
            x[
                :,
                ~self.stream.observation.good_samples[at.start : at.stop + self.delays * self.lag],
            ] = 0.0
            self.used &= np.isfinite(x).all(axis=1)
            x[~self.used] = 0.0
            width = at.stop - at.start
            rows = np.concatenate(
                [x[:, k * self.lag : k * self.lag + width] for k in range(self.delays + 1)]
            )
            rows[:, ~self.good[at]] = 0.0
            yield at, rows

    def _columns(self, samples: slice) -> Floats:
        """(n_det, n) of the stream, its mean included, without its first good sample; float64."""
        array = self.stream.array
        mean = self.stream.means.get(self.stream.name)
        x = np.asarray(array[:, samples][self.detectors], np.float64)
        forget_pages(array)
        if mean is not None:
            for row, d in zip(x, self.detectors, strict=True):
                row += mean.evaluate(slice(int(d), int(d) + 1), samples)[0]
        return x - self._start


def components(
    lagged: Lagged,
    modes: int,
    *,
    center: bool = True,
    normalize: bool = False,
) -> Components:
    """Equation (2). ``center``: subtract the rows' means; ``normalize``: divide rows by their rms,
    so that each counts alike.
    """
    c = np.zeros((lagged.n_rows, lagged.n_rows))
    total = np.zeros(lagged.n_rows)
    for _, rows in lagged.tiles():
        c += rows @ rows.T
        total += rows.sum(axis=1)
    count = int(np.count_nonzero(lagged.good))
    used = np.tile(lagged.used, lagged.delays + 1)
    mean = np.where(used, total / max(count, 1), 0.0)
    if center:
        c -= count * np.outer(mean, mean)
    else:
        mean = np.zeros(lagged.n_rows)
        start = np.where(used, np.tile(lagged._start[:, 0], lagged.delays + 1), 0.0)
        c += np.outer(total, start) + np.outer(start, total) + count * np.outer(start, start)
        mean -= start
    c[~used], c[:, ~used] = 0.0, 0.0
    scale = np.ones(lagged.n_rows)
    if normalize:
        rms = np.sqrt(np.maximum(np.diag(c), 0.0) / max(count, 1))
        scale = np.where(rms > 0, 1 / np.where(rms > 0, rms, 1.0), 0.0)
        c *= np.outer(scale, scale)
    squares, vectors = np.linalg.eigh((c + c.T) / 2)
    squares = np.maximum(squares[::-1], 0.0)
    u = vectors.T[::-1][:modes]
    u *= np.sign(u[np.arange(len(u)), np.argmax(abs(u), axis=1)])[:, None]
    times = np.full((len(u), lagged.stream.shape[1]), np.nan)
    weights = u * scale * used
    for at, rows in lagged.tiles():
        found = weights @ (rows - mean[:, None])
        times[:, at] = np.where(lagged.good[at], found, np.nan)
    unit = max(1, int(used.sum()) * count)
    return Components(np.sqrt(squares / unit), float(np.trace(c)) / unit, u, times, lagged.used)


MOST_ROWS = 4096
"""Detectors times delays: the covariance of more takes minutes and gigabytes."""
KEPT = 64
"""Singular values that are kept of each scan."""


class ModeSpectrum(StreamDiagnostic):
    """Singular values of the matrix detectors x time of `signal` at this step, their shares, and
    the leading modes.

    They are the principal components of the detectors' streams: of the values at one instant, or,
    with ``delays``, of the values at several delays (time-lagged components), which see what moves
    across the field. Flagged samples and detectors are left out. Makes the product ``modes`` (a
    `Modes`), or one under this step's own name where it has one: shares are means over the scans,
    streams those of the first. Where there is an output folder, both are written there as tables
    (ECSV). `Plots` and `Report` show them.
    """

    provides = frozenset({"modes"})
    knows_means = True
    couples = "all"

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
        observation = stream.observation
        log = stream.observation.log
        chosen = spread_evenly(observation, self.detectors)
        lag = max(1, round(self.delay * observation.sample_rate))
        lagged = Lagged(stream, chosen, self.delays, lag)
        if chosen.size < 2 or np.count_nonzero(lagged.good) < 2:
            log.count(self.label, "scans without two detectors and two samples: no modes", 1)
            return stream.state
        found = components(lagged, self.modes, center=self.center, normalize=self.normalize)
        left = int(np.count_nonzero(~found.used))
        log.count(self.label, "detectors left out: signal not finite", left)
        if not found.energy > 0:
            log.count(self.label, "scans whose signal is constant: no modes", 1)
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
        )
        stream.state.append(modes)
        return stream.state

    def collect(self, data: Data, observation: Observation, state: list[Modes]) -> None:
        for modes in state:
            data.add(self.label, modes)
