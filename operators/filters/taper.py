"""A window that goes smoothly to zero at either end of a scan.

    w_n = sin^2(pi n / (a (N - 1)))   while n < a (N - 1) / 2, the same from the end, 1 between  (1)

is Tukey's window (`scipy.signal.windows.tukey`), a the share of the scan in which it is not 1.
"""

from __future__ import annotations

import numpy as np

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Fraction
from zonda.core.data import Block, Observation
from zonda.core.numerics.chunks import chunks
from zonda.core.types import Floats

from .rows import ROWS, LinearFilter

MEAN = "samples with mean emission under the window: put a Detrend before it"
"""A count of the log."""


class Taper(LinearFilter):
    """Multiply each scan by Tukey's window, equation (1), so that a filter behind it finds no jump
    at its ends.

    A map weighs samples by the window: it is the sum of w W d over that of w W, W d what filters
    made of the windowed signal. So a source keeps its brightness, the ends of scans count less, and
    the noise of a pixel follows. What steps behind the window add there, e.g. the transient of a
    filter, the window does not lessen, and the division by W raises it: what W < 1/10 leaves is in
    no map. It is what the mapper of maria 1.0.0 does (without that limit), behind a linear
    `Detrend`, which should stand before: the window acts on the mean emission too, tens of kelvin,
    and what it takes off is rounded as a part of it. The log says so.
    """

    knows_means = True
    couples = "sample"

    share: Fraction = quantity("10 %", ge=0, le=1)
    """Share of the scan in which the window is not 1, half of it at either end."""

    def prepare(self, observation: Observation) -> Floats:
        """The window, which maps of this observation use as weights."""
        from scipy.signal.windows import tukey

        window: Floats = tukey(observation.n_samples, self.share)
        observation.windows[self.label] = window
        return window

    def adjoint(self, block: Block, state: Floats) -> None:
        """The same: it is diagonal."""
        self.exec(block, state)

    def exec(self, block: Block, state: Floats) -> None:
        """Multiply the block's rows in place. Beside a mean M that stands beside x, W (x + M) - M
        takes the place of x.
        """
        window = state[block.samples]
        signal = block.detdata["signal"]
        mean = block.means.get("signal")
        if mean is None:
            signal *= window
            return
        largest = 0.0
        for part in chunks(len(signal), ROWS):
            detectors = slice(block.detectors.start + part.start, block.detectors.start + part.stop)
            level = mean.evaluate(detectors, block.samples).astype(np.float64)
            signal[part] = window * signal[part] - (1 - window) * level
            largest = max(largest, float(np.abs(level).max(initial=0.0)))
        log = block.observation.log
        log.count(self.label, MEAN, int((window < 1).sum()) * len(signal), signal.size)
        if largest:
            step = largest * float(np.finfo(signal.dtype).eps) / 2
            log.state(
                self.label,
                "rounding of the mean emission",
                f"up to {step * 1e6:.2g} µK in a sample",
            )
