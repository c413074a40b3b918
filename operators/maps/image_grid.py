"""Base class of images, and the rays of detectors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.numerics.projection import frame_rotation, ray_coefficients
from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.data import Observation


@dataclass(frozen=True)
class ImageGrid:
    """An image: ``shape`` (ny, nx), pixels of side ``pixel`` [rad] in ``frame``; its projection
    says what ``origin`` is.
    """

    origin: tuple[float, float]
    pixel: float
    shape: tuple[int, int]
    frame: str = "icrs"

    @property
    def n_pixels(self) -> int:
        return self.shape[0] * self.shape[1]


def rays(observation: Observation, frame: str) -> Floats:
    """Coefficients (9, n_samp) of the directions that detectors look at, in ``frame``
    (`ray_coefficients`).
    """
    return np.ascontiguousarray(
        ray_coefficients(observation.boresight_radec, frame_rotation(frame)).T
    )
