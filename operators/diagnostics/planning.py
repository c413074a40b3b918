"""Planning of spectra, pictures and reports: what they read and what they cost."""

from __future__ import annotations

from zonda.core.data import Observation
from zonda.core.plan.context import Context
from zonda.core.plan.estimate import Cost, Estimate
from zonda.core.plan.planning import Planning

from .plot_operators import Plots
from .power_spectrum import PowerSpectrum
from .report import Report
from .time_streams import TimeStreams
from .transfer_function import TransferFunction


class PlotsPlanning(Planning[Plots]):
    """A cost for the whole run."""

    of = Plots
    cost = Cost(once=1.2, kernel="python")

    def memory(self, observation: Observation) -> int:
        """matplotlib and the pictures."""
        return 150_000_000


class ReportPlanning(Planning[Report]):
    """A cost for the whole run, without that of the pictures."""

    of = Report
    cost = Cost(once=0.1, kernel="python")

    def memory(self, observation: Observation) -> int:
        """The page."""
        return 10_000_000


class TransferFunctionPlanning(Planning[TransferFunction]):
    """A cost for the whole run, without that of the two signals that it compares."""

    of = TransferFunction
    cost = Cost(once=0.15, kernel="python")

    def memory(self, observation: Observation) -> int:
        """Fourier transforms of the maps."""
        return 20_000_000


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
        return Estimate((), Cost(0.02, 0.0, 3.8e-9 * min(1.0, self.operator.detectors / context.first.n_detectors) * 14))
