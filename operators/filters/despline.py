"""Removes a spline from each detector's scan: equation (1) of `baseline`."""

from __future__ import annotations

from typing import ClassVar, Literal

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Seconds
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.flags import has_a_signal
from zonda.core.operator import Operator

from .baseline import Fit, splines
from .rows import by_rows

MOST = 2000
"""Knots of a scan: the normal equations are solved whole."""


class Despline(Operator):
    """Remove the cubic spline that fits each detector's scan best: equation (1) of `baseline` with
    B-splines.

    The knots are those of the mapper of maria 1.0.0: equally spaced, and centred on the scan. (Its
    own spacing is always 60 s: it gives `get_bspline_basis` the spacing under a name that this
    ignores.) Flagged samples are not used.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"

    knots: Seconds = quantity("60 s", gt=0)
    """Time between two knots."""

    def check(self, data: Data) -> list[str]:
        """Refuse more than `MOST` knots in a scan."""
        for observation in data.observations:
            self._check_number(observation)
        return []

    def _check_number(self, observation: Observation) -> None:
        if observation.duration > MOST * self.knots:
            raise PipelineError(
                f"knots every {self.knots:g} s are more than {MOST} in a scan of"
                f" {observation.duration:g} s",
                place=f"{self.label}, {observation.name}",
                cure="choose longer knots, or a HighpassFilter",
            )

    def prepare(self, observation: Observation) -> Fit:
        """The fit to this observation's good samples. Raises PipelineError for more than `MOST`
        knots.
        """
        spacing = self.knots * observation.sample_rate
        use = has_a_signal(observation.flags)
        self._check_number(observation)
        basis = splines(observation.n_samples, spacing)
        observation.tally.state(
            self.label, f"{observation.name}: functions fitted to each detector", f"{basis.size}"
        )
        return Fit.of(basis, use)

    def exec(self, block: Block, state: Fit) -> None:
        """Subtract the fit from each row."""
        by_rows(self.label, block, state.remove)
