"""Source masks: samples near a source, which filters do not use to find what they remove.

A filter y = F x that acts on each detector's scan becomes, with b the data in which masked samples
are bridged by straight lines,

    y = F b + m (x - b),
    m = 1 inside the mask, 0 outside:                                                (1)

what is removed, b - F b, is found outside of the mask and is subtracted inside too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from zonda.core.configuration.files import InputPath
from zonda.core.configuration.parameters import Parameters
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import PipelineError
from zonda.core.numerics.chunks import chunks, empty
from zonda.core.numerics.projection import rotation_matrices
from zonda.core.observation import Observation
from zonda.core.types import AnyFloats, Floats

from .brick_wall import bridge
from .mask_image import read_mask

RADIUS = math.radians(1 / 60)
"""Of a disc, where none is given."""
MASKED = "samples in the source mask, not used to find what is removed"
"""A count of the log."""


class SourceMask(Parameters):
    """A disc on the sky, or masked pixels of an image, whose samples a filter does not use to find
    what it removes.
    """

    radius: Angle | None = Field(None, gt=0, le=0.5)
    """Radius of the disc; where absent, 1 arcmin."""
    centre: Target | None = None
    """Centre of the disc; where absent, the target of the scan."""
    file: InputPath | None = None
    """In place of a disc: a FITS image (TAN) that is not zero where samples are masked. Beyond it
    nothing is.
    """

    @field_validator("centre")
    @classmethod
    def _on_the_sky(cls, value: Target | None) -> Target | None:
        if value is not None and value.frame == "horizontal":
            raise ValueError(
                "the centre of a mask must be fixed on the sky; give ICRS or galactic coordinates"
            )
        return value

    @model_validator(mode="after")
    def _one_kind(self) -> SourceMask:
        if self.file is not None and (self.radius is not None or self.centre is not None):
            raise ValueError("give either file, an image, or radius and centre of a disc")
        return self

    def of(self, observation: Observation) -> Inside:
        """Samples of a scan that are inside. Raises InputError for a file that cannot be used."""
        if self.file is not None:
            return read_mask(self.file).of(observation)
        ra, dec = self.centre.icrs() if self.centre else observation.centre
        centre = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
        seen = empty((3, observation.n_samples))
        for s in chunks(observation.n_samples):
            turn = rotation_matrices(observation.boresight_radec[s])
            seen[:, s] = sum(turn[:, k, :].T * centre[k] for k in range(3))
        plane = observation.focalplane
        rays = np.stack([-plane.eta, -plane.xi, np.ones(len(plane))])
        return InsideDisc(
            seen,
            rays / np.sqrt((rays * rays).sum(axis=0)),
            float(np.sin((self.radius or RADIUS) / 2)),
        )


class Inside(Protocol):
    """Samples of a scan in a mask."""

    @property
    def n_detectors(self) -> int:
        """Number of the scan's detectors."""

    def at(self, detectors: slice, samples: slice) -> NDArray[np.bool_]:
        """(n_det, n): True inside; it depends on absolute detectors and samples alone."""


@dataclass(frozen=True)
class InsideDisc:
    """Samples in a disc.

    Attributes
    ----------
    centre
        (3, n_samp): unit vector to the centre of the mask in the boresight's frame.
    rays
        (3, n_det): unit vectors of the detectors in that frame.
    half_chord
        Sine of half of the radius: |ray - centre| is at most twice that inside.
    """

    centre: Floats
    rays: Floats
    half_chord: float

    @property
    def n_detectors(self) -> int:
        """Number of the scan's detectors."""
        return int(self.rays.shape[1])

    def at(self, detectors: slice, samples: slice) -> NDArray[np.bool_]:
        """(n_det, n): True inside; it depends on absolute detectors and samples alone."""
        a, b = self.rays[:, detectors], self.centre[:, samples]
        found = np.zeros((a.shape[1], b.shape[1]))
        for k in range(3):
            found += (a[k, :, None] - b[k]) ** 2
        return np.asarray(found <= (2 * self.half_chord) ** 2)


def counts(inside: Inside, n_samples: int) -> tuple[int, int]:
    """(samples of all detectors inside, instants at which all detectors are)."""
    every, number, covered = slice(0, inside.n_detectors), 0, 0
    for samples in chunks(n_samples, 1 << 10):
        found = inside.at(every, samples)
        number, covered = number + int(found.sum()), covered + int(found.all(axis=0).sum())
    return number, covered


def filter_outside(
    row: AnyFloats,
    bad: NDArray[np.intp],
    inside: NDArray[np.bool_] | None,
    act: Callable[[AnyFloats], None],
) -> int:
    """Equation (1) on one detector's scan ``row`` (N,) in place; ``act`` is F, in place.

    Flagged samples ``bad`` are bridged, and so are those that are not finite; returns how many of
    these, which stay as they were. A detector that never leaves the mask is filtered as if there
    were none.
    """
    lost = np.flatnonzero(~np.isfinite(row))
    spoilt, gaps = row[lost], np.union1d(bad, lost)
    if gaps.size == row.size:
        return int(lost.size)
    masked = np.zeros(0, np.intp) if inside is None else np.flatnonzero(inside)
    every = np.union1d(gaps, masked)
    if every.size == row.size:
        masked, every = masked[:0], gaps
    before = row[masked]
    bridge(row, every)
    rest = before - row[masked]
    act(row)
    row[masked] += rest
    row[lost] = spoilt
    return int(lost.size)


def check_mask(inside: Inside, observation: Observation, place: str) -> None:
    """Raise PipelineError where a mask covers all that the middle detector sees."""
    middle = int(np.argmin(np.hypot(observation.focalplane.xi, observation.focalplane.eta)))
    if inside.at(slice(middle, middle + 1), slice(0, observation.n_samples)).all():
        raise PipelineError(
            "the source mask covers the whole scan", place=place, cure="choose a smaller one"
        )


ENOUGH = 256
"""Instants of a look at a scan from which it is judged whether a mask covers it."""


def check_masks(mask: SourceMask | None, data: Data, label: str) -> list[str]:
    """Check a mask for `Operator.check`. Raises InputError for a file that cannot be used, and
    PipelineError as `check_mask`.
    """
    for observation in data.observations if mask is not None else ():
        inside = mask.of(observation) if mask is not None else None
        if inside is not None and observation.n_samples >= min(ENOUGH, observation.sampling[0]):
            check_mask(inside, observation, f"{label}, {observation.name}")
    return []
