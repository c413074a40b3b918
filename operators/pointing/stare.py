"""Looking at one point."""

from __future__ import annotations

import numpy as np

from zonda.core.types import Floats

from .base import Pointing


class PointingStare(Pointing):
    """Boresight fixed on the target: tracking if it is ICRS or Galactic, at rest if it is az/el."""

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        return np.zeros(len(seconds)), np.zeros(len(seconds))
