"""Source masks: samples near a source, which filters do not use to find what they remove.

A filter y = F x that acts on each detector's scan becomes, with b the data in which masked samples
are bridged by straight lines,

    y = F b + m (x - b),
    m = 1 inside the mask, 0 outside:                                                (1)

what is removed, b - F b, is found outside of the mask and is subtracted inside too.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from astropy.wcs import WCS
from pydantic import Field, field_validator, model_validator

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.parameters import Parameters
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle
from zonda.core.errors import InputError, PipelineError
from zonda.core.maps.header import with_known_frame
from zonda.core.numerics.chunks import chunks, empty
from zonda.core.numerics.projection import pixel_matrix, ray_coefficients, rotation_matrices
from zonda.core.observation import Observation
from zonda.core.storage.files import reading
from zonda.core.storage.fits_files import check_size, opened
from zonda.core.types import AnyFloats, Bools, Floats, Indices

from .brick_wall import bridge, bridge_adjoint

CURE = "give a two-dimensional image with a celestial WCS, 0 where there is no source"

RADIUS = math.radians(1 / 60)
"""Of a disc, where none is given."""
ENOUGH = 256
"""Instants of a look at a scan from which it is judged whether a mask covers it."""
MUCH = 0.2
"""Share of masked samples above which a warning is given: a filter of each detector's scan must
then guess drifts across the mask from too few samples.
"""
MASKED = "samples in the source mask, not used to find what is removed"
"""A count of the log."""


SMALLER = "choose a smaller mask"


def _percent(share: float) -> str:
    """Share rounded to 5 %: different choices of instants give the same text."""
    return f"about {max(5 * round(20 * share), 1)} %"


class SourceMask(Parameters):
    """A disc on the sky, or masked pixels of an image, whose samples a filter does not use to find
    what it removes.
    """

    radius: Angle | None = Field(None, gt=0, le=0.5, examples=["30 arcsec"])
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

    def of_part(self, observation: Observation, label: str) -> Inside:
        """Samples of a scan that are inside; some must be outside. Few samples outside are warned
        of, in the first scan.

        Raises InputError for a file that cannot be used, and PipelineError where the mask covers
        all that the middle detector sees.
        """
        inside = self.of(observation)
        plane = observation.focalplane
        middle = int(np.argmin(np.hypot(plane.xi, plane.eta)))
        n = observation.n_samples
        judged = n >= min(ENOUGH, observation.sampling[0])
        if judged and inside.at(slice(middle, middle + 1), slice(0, n)).all():
            raise PipelineError(
                "the source mask covers the whole scan",
                place=f"{label}, {observation.name}",
                cure="choose a smaller one",
            )
        masked, _ = self._shares(observation)
        if masked > MUCH and observation.index == 0:
            left = f"leaves {_percent(1 - masked)} of the samples to tell drifts from"
            warnings.warn(f"{label}: the source mask {left}; {SMALLER}", stacklevel=1)
        return inside

    def of_modes(self, observation: Observation, label: str) -> Inside:
        """Samples of a scan that are inside. Raises InputError for a file that cannot be used, and
        warns where no detector is outside at some instants (of the first scan).
        """
        masked, covered = self._shares(observation)
        if covered and observation.index == 0:
            text = f"{label}: the source mask leaves {_percent(1 - masked)} of the samples, and"
            text += f" nothing is removed at {_percent(covered)} of the instants, where it covers"
            warnings.warn(f"{text} all detectors; {SMALLER}", stacklevel=1)
        return self.of(observation)

    def _shares(self, observation: Observation) -> tuple[float, float]:
        """Shares of the samples inside, and of the instants with all detectors inside; from
        `ENOUGH` instants.
        """
        thin = observation.thinned(slice(None, None, -(-observation.n_samples // ENOUGH)))
        masked, covered = counts(self.of(thin), thin.n_detectors, thin.n_samples)
        return masked / (thin.n_detectors * thin.n_samples), covered / thin.n_samples

    def of(self, observation: Observation) -> Inside:
        """Samples of a scan that are inside. Raises InputError for a file that cannot be used."""
        if self.file is not None:
            masked, matrix = _read(self.file, self.file.stat().st_mtime_ns)
            h = ray_coefficients(observation.boresight_radec, matrix)
            return InsideImage(h, observation.focalplane.xi, observation.focalplane.eta, masked)
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

    def at(self, detectors: slice, samples: slice) -> Bools:
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

    def at(self, detectors: slice, samples: slice) -> Bools:
        """(n_det, n): True inside; it depends on absolute detectors and samples alone."""
        a = self.rays[:, detectors]
        b = self.centre[:, samples]
        found = np.zeros((a.shape[1], b.shape[1]))
        for k in range(3):
            found += (a[k, :, None] - b[k]) ** 2
        return found <= (2 * self.half_chord) ** 2


def counts(inside: Inside, n_detectors: int, n_samples: int) -> tuple[int, int]:
    """(samples of all detectors inside, instants at which all detectors are)."""
    every = slice(0, n_detectors)
    number = 0
    covered = 0
    for samples in chunks(n_samples, 1 << 10):
        found = inside.at(every, samples)
        number = number + int(found.sum())
        covered = covered + int(found.all(axis=0).sum())
    return number, covered


def filter_outside(
    row: AnyFloats,
    bad: Indices,
    inside: Bools | None,
    act: Callable[[AnyFloats], object],
) -> int:
    """Equation (1) on one detector's scan ``row`` (N,) in place; ``act`` is F, in place.

    Flagged samples ``bad`` are bridged, and so are those that are not finite; returns how many of
    these, which stay as they were. A detector that never leaves the mask is filtered as if there
    were none.
    """
    lost = np.flatnonzero(~np.isfinite(row))
    spoilt = row[lost]
    gaps = np.union1d(bad, lost)
    if gaps.size == row.size:
        return int(lost.size)
    masked, every = _bridged(gaps, inside)
    before = row[masked]
    bridge(row, every)
    rest = before - row[masked]
    act(row)
    row[masked] += rest
    row[lost] = spoilt
    return int(lost.size)


def adjoint_outside(
    row: AnyFloats,
    bad: Indices,
    inside: Bools | None,
    act: Callable[[AnyFloats], object],
) -> None:
    """Transpose of `filter_outside` on a float64 row in place; ``act`` is F^T."""
    if bad.size == row.size:
        return
    masked, every = _bridged(bad, inside)
    before = row[masked]
    act(row)
    row[masked] -= before
    bridge_adjoint(row, every)
    row[masked] += before


def _bridged(gaps: Indices, inside: Bools | None) -> tuple[Indices, Indices]:
    """Samples in the mask, and those that are bridged; no mask where it leaves nothing."""
    masked = np.zeros(0, np.intp) if inside is None else np.flatnonzero(inside)
    every = np.union1d(gaps, masked)
    if inside is not None and every.size == inside.size:
        return masked[:0], gaps
    return masked, every


@dataclass(frozen=True)
class InsideImage:
    """Samples in masked pixels; none beyond the image.

    Attributes
    ----------
    h
        (9, n_samp): coefficients of equation (1) of `core.numerics.projection`.
    xi, eta
        (n_det,): offsets of the detectors, rad.
    """

    h: Floats
    xi: Floats
    eta: Floats
    masked: Bools

    def at(self, detectors: slice, samples: slice) -> Bools:
        """(n_det, n): True inside; it depends on absolute detectors and samples alone."""
        xi = self.xi[detectors, None]
        eta = self.eta[detectors, None]
        h = self.h[:, samples]
        x, y, w = (h[k] * xi + h[k + 1] * eta + h[k + 2] for k in (0, 3, 6))
        ny, nx = self.masked.shape
        with np.errstate(invalid="ignore", divide="ignore"):
            column = np.floor(x / w + 0.5)
            row = np.floor(y / w + 0.5)
            here = (w > 0) & (column >= 0) & (column < nx) & (row >= 0) & (row < ny)
        found = np.zeros(here.shape, bool)
        found[here] = self.masked[row[here].astype(np.int64), column[here].astype(np.int64)]
        return found


@lru_cache(4)
def _read(path: Path, changed: int) -> tuple[Bools, Floats]:
    """Masked pixels (ny, nx) of the first image of a FITS file, and the matrix (3, 3) from
    directions on the sky to its pixels (`projection.pixel_matrix`).

    Raises InputError for what is no image with a tangent-plane (TAN) WCS, for NaN, which is neither
    masked nor not, and for zeros alone.
    """
    place = f"source mask {path}"
    with opened(path, place, CURE) as hdus:
        hdu = next((h for h in hdus if h.is_image and len(h.shape) == 2), None)
        if hdu is None:
            raise InputError("has no two-dimensional image", place=place, cure=CURE)
        check_size(hdu, place)
        values = np.array(hdu.data)
        header = hdu.header.copy()
    if np.isnan(values).any():
        raise InputError(
            "has pixels that are NaN",
            place=place,
            cure="write 1 where samples are masked and 0 elsewhere",
        )
    if not values.any():
        raise InputError(
            "all of its pixels are 0: it masks nothing",
            place=place,
            cure="write 1 where samples are masked, or leave it out",
        )
    header, _ = with_known_frame(header, place)
    try:
        with reading(place, "a FITS image with world coordinates", CURE):
            wcs = WCS(header, naxis=2)
        return values != 0, pixel_matrix(wcs)
    except InputError as err:
        raise InputError(err.message, place=place, cure=err.cure or CURE) from None
