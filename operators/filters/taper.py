"""A window that goes smoothly to zero at either end of a scan.

    w_n = sin^2(pi n / (a (N - 1)))   while n < a (N - 1) / 2, the same from the end, 1 between                (1)

is Tukey's window (`scipy.signal.windows.tukey`), a the share of the scan in which it is not 1.
"""

from __future__ import annotations

from typing import ClassVar

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Fraction
from zonda.core.data import Block, Observation
from zonda.core.operator import Operator
from zonda.core.types import Floats


class Taper(Operator):
    """Multiply each scan by Tukey's window, equation (1), so that a filter behind it finds no jump at its ends.

    A map weighs samples by the window: it is the sum of w W d over that of w W, W d what the filters made of the windowed signal.
    So a source keeps its brightness, the ends of scans count less, and the noise of a pixel follows. It is what the mapper of
    maria 1.0.0 does, behind a linear `Detrend`, which should stand before: the window acts on the mean emission too.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    linear: ClassVar[bool] = True

    share: Fraction = quantity("10 %", ge=0, le=1)
    """Share of the scan in which the window is not 1, half of it at either end."""

    def prepare(self, observation: Observation) -> Floats:
        """The window, which maps of this observation use as weights."""
        from scipy.signal.windows import tukey

        window: Floats = tukey(observation.n_samples, self.share)
        observation.windows[self.label] = window
        return window

    def exec(self, block: Block, state: Floats) -> None:
        """Multiply the block's rows in place."""
        block.detdata["signal"] *= state[block.samples]
