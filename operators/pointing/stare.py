"""Looking at one point."""

from __future__ import annotations

import numpy as np

from zonda.core.types import Floats

from .base import Pointing


class PointingStare(Pointing):
    """The boresight stays on the target: tracked where the target is ICRS or Galactic, still where it is az/el."""

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        return np.zeros(len(seconds)), np.zeros(len(seconds))
