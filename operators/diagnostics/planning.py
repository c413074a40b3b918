"""Planning of spectra, pictures and reports: their streams and memory."""

from __future__ import annotations

from typing import Any

from zonda.core.data import Observation
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.plan.planning import Planning

from .map_spectra import MapSpectrum
from .plot_operators import Plots
from .power_spectrum import PowerSpectrum
from .report import Report
from .series import TimeStreams
from .transfer_function import TransferFunction


class PlotsPlanning(Planning[Plots]):
    """matplotlib and the pictures."""

    of = Plots
    holds = 90_000_000
    per_pixel = 112


class ReportPlanning(Planning[Report]):
    """The page."""

    of = Report
    holds = 10_000_000


class TransferFunctionPlanning(Planning[TransferFunction]):
    """Fourier transforms of the maps."""

    of = TransferFunction
    holds = 20_000_000


class MeasureFiguresPlanning(Planning[Any]):
    """Smoothed maps, and Fourier transforms of maps."""

    of = "zonda.operators.diagnostics.measure_figures:MeasureFigures"
    holds = 20_000_000


class ModeSpectrumPlanning(Planning[Any]):
    """It reads the streams."""

    of = "zonda.operators.diagnostics.mode_spectrum:ModeSpectrum"
    reads_streams = True

    def memory(self, observation: Observation) -> int:
        """Covariance, eigenvectors and their work; a tile; the modes in time."""
        step = self.operator
        rows = min(observation.n_detectors, step.detectors) * (step.delays + 1)
        modes = (2 * step.modes + 2) * observation.n_samples
        return int(8 * (6 * rows**2 + 4 * rows * TILE_SAMPLES + modes))


class CompareMapsPlanning(Planning[Any]):
    """Planes and Fourier transforms of two maps."""

    of = "zonda.operators.diagnostics.compare_maps:CompareMaps"
    holds = 60_000_000


class MapSpectrumPlanning(Planning[MapSpectrum]):
    """Fourier transforms of the maps."""

    of = MapSpectrum
    holds = 30_000_000


class TimeStreamsPlanning(Planning[TimeStreams]):
    """It reads the streams."""

    of = TimeStreams
    reads_streams = True


class PowerSpectrumPlanning(Planning[PowerSpectrum]):
    """It reads the streams."""

    of = PowerSpectrum
    reads_streams = True


class CompareStreamsPlanning(Planning[Any]):
    """It reads two streams of the detectors it looks at."""

    of = "zonda.operators.diagnostics.compare_streams:CompareStreams"
    reads_streams = True

    def memory(self, observation: Observation) -> int:
        """Segments of a detector and their transforms, and the spectra of all."""
        from .compare_streams import LEAST_SEGMENTS

        step = self.operator
        n = observation.n_samples
        count: int = min(observation.n_detectors, step.detectors)
        length: float = min(n / LEAST_SEGMENTS, step.segment * observation.sample_rate)
        return round(16 * n + (64 + 16 * count) * length)
