"""Planning of spectra, pictures and reports: what they read and what they cost."""

from __future__ import annotations

from typing import Any

from zonda.core.data import Observation
from zonda.core.numerics.tiles import TILE_SAMPLES
from zonda.core.plan.context import Context
from zonda.core.plan.estimate import Cost, Estimate
from zonda.core.plan.planning import Planning

from .map_spectra import MapSpectrum
from .plot_operators import Plots
from .power_spectrum import CHUNK, PowerSpectrum
from .report import Report
from .time_streams import TimeStreams
from .transfer_function import TransferFunction


class PlotsPlanning(Planning[Plots]):
    """A cost for the whole run."""

    of = Plots
    cost = Cost(once=1.2, kernel="python")
    holds = 150_000_000
    """matplotlib and the pictures."""


class ReportPlanning(Planning[Report]):
    """A cost for the whole run, without that of the pictures."""

    of = Report
    cost = Cost(once=0.1, kernel="python")
    holds = 10_000_000
    """The page."""


class TransferFunctionPlanning(Planning[TransferFunction]):
    """A cost for the whole run, without that of the two signals that it compares."""

    of = TransferFunction
    cost = Cost(once=0.15, kernel="python")
    holds = 20_000_000
    """Fourier transforms of the maps."""


class MeasureFiguresPlanning(Planning[Any]):
    """A cost for the whole run, without that of the signals that the metrics need."""

    of = "zonda.operators.diagnostics.measure_figures:MeasureFigures"
    cost = Cost(once=0.1, kernel="python")
    holds = 20_000_000
    """Smoothed maps, and Fourier transforms of maps."""


class ModeSpectrumPlanning(Planning[Any]):
    """It reads the streams twice; its cost is that of the covariance."""

    of = "zonda.operators.diagnostics.mode_spectrum:ModeSpectrum"
    reads_streams = True

    def _rows(self, observation: Observation) -> int:
        detectors: int = min(observation.n_detectors, self.operator.detectors)
        return detectors * int(self.operator.delays + 1)

    def memory(self, observation: Observation) -> int:
        """Covariance, eigenvectors and their work; a tile; the modes in time."""
        rows, modes = self._rows(observation), int(self.operator.modes)
        return int(
            8 * (6 * rows**2 + 4 * rows * TILE_SAMPLES + (2 * modes + 2) * observation.n_samples)
        )

    def estimate(self, context: Context) -> Estimate:
        """Its cost."""
        rows = self._rows(context.first)
        return Estimate(
            (),
            Cost(
                fixed=1e-9 * rows**3, per_sample=5e-9 + 1e-10 * rows**2 / context.first.n_detectors
            ),
        )


class CompareMapsPlanning(Planning[Any]):
    """A cost for the whole run."""

    of = "zonda.operators.diagnostics.compare_maps:CompareMaps"
    cost = Cost(once=0.5, kernel="python")
    holds = 60_000_000
    """Planes and Fourier transforms of two maps."""


class MapSpectrumPlanning(Planning[MapSpectrum]):
    """A cost for the whole run."""

    of = MapSpectrum
    cost = Cost(once=0.2, kernel="python")
    holds = 30_000_000
    """Fourier transforms of the maps."""


class TimeStreamsPlanning(Planning[TimeStreams]):
    """It reads the streams; its cost is small."""

    of = TimeStreams
    reads_streams = True
    cost = Cost(0.005)


class PowerSpectrumPlanning(Planning[PowerSpectrum]):
    """It reads the streams; its cost is that of the detectors it looks at."""

    of = PowerSpectrum
    reads_streams = True

    def estimate(self, context: Context) -> Estimate:
        """Its cost."""
        return Estimate(
            (),
            Cost(
                0.02,
                0.0,
                3.8e-9 * min(1.0, self.operator.detectors / context.first.n_detectors) * 14,
            ),
        )


class CompareStreamsPlanning(Planning[Any]):
    """It reads two streams of the detectors it looks at; its cost is that of their transforms."""

    of = "zonda.operators.diagnostics.compare_streams:CompareStreams"
    reads_streams = True

    def memory(self, observation: Observation) -> int:
        """Segments of a detector and their transforms, and the spectra of all."""
        count: int = min(observation.n_detectors, self.operator.detectors)
        from .compare_streams import LEAST_SEGMENTS

        length: float = min(
            observation.n_samples / LEAST_SEGMENTS, self.operator.segment * observation.sample_rate
        )
        return round(16 * observation.n_samples + (64 * CHUNK + 16 * count) * length)

    def estimate(self, context: Context) -> Estimate:
        """Its cost."""
        return Estimate(
            (),
            Cost(0.02, 0.0, 8e-8 * min(1.0, self.operator.detectors / context.first.n_detectors)),
        )
