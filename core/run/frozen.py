"""What a main run found in its data, kept so that a companion run can be treated in the same way.

A filter that measures the data (singular modes) is not linear in them. With what it measured in the complete data d held fixed
it is: F_d(a) = a - U_d U_d^T a, and F_d(sky) + F_d(rest) = F_d(d), the main run itself. A companion run with ``modes: full``
applies F_d; one with ``modes: own`` measures its own data, as the paper's noiseless run does. Samples that the main run left out
because of their values (not finite) are left out too, so that every map has the same hits.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..data import Observation

T = TypeVar("T", bound=np.generic)
Used = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float64]]


@dataclass
class Frozen:
    """One observation of the main run.

    It is filled while the main run goes through the observation, and read once ``complete``. Memory: what the operators keep
    (singular modes: n_modes x n_det x 8 bytes), and the flags, once for each time that they changed.

    Attributes
    ----------
    found
        What `Operator.freeze` returned, by label.
    kept_out
        What `Operator.keep_out` returned, by label.
    complete
        True: the main run is done, `at` puts back what it recorded.
    """

    found: dict[str, Any] = field(default_factory=dict)
    kept_out: dict[str, Any] = field(default_factory=dict)
    complete: bool = False
    _used: dict[tuple[str, str], Used] = field(default_factory=dict)

    def at(self, observation: Observation, label: str, stage: str) -> None:
        """Record which samples, detectors and NETs are in use at this point of the run, or put back what was then."""
        here = (label, stage)
        if self.complete:
            if here not in self._used:  # a step that the main run does not have uses what is used
                return
            flags, detector_flags, net = self._used[here]
            observation.flags, observation.detector_flags = flags.copy(), detector_flags.copy()
            observation.focalplane.net = net.copy()
            return
        before = next(reversed(self._used.values())) if self._used else None
        self._used[here] = (
            _copy(observation.flags, before and before[0]),
            _copy(observation.detector_flags, before and before[1]),
            _copy(observation.focalplane.net, before and before[2]),
        )


def _copy(now: NDArray[T], before: NDArray[T] | None) -> NDArray[T]:
    """``before`` where nothing has changed, so that it is kept once."""
    return before if before is not None and np.array_equal(before, now) else now.copy()
