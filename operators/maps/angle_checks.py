"""Checks that detectors and samples see enough angles of polarization to determine I, Q and U."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.projection import frame_rotation
from zonda.core.polarization import PolarizationAngles
from zonda.core.types import Floats

SCANS, SAMPLES, DETECTORS = 32, 256, 2000
"""Most scans, samples of all of them and detectors that are checked beforehand; scans and detectors
are drawn at random, as angles may repeat from one to the next."""
CURE = (
    "add detectors at other angles (two pairs at 45 deg whose paths cross), scans at other"
    " parallactic angles, or a HalfWavePlate"
)


def check_polarized(observation: Observation, place: str) -> None:
    """Raise PipelineError for maps of I, Q and U where no detector is polarized."""
    if observation.focalplane.polarized:
        return
    camera = observation.instrument
    by = camera.polarized_by
    if (table := camera.focalplane_table) is not None:
        by = (
            f"add the column polarization_angle to {table} (polarization_efficiency, if it is"
            " there, must be above 0)"
        )
    message = f"stokes: IQU needs polarized detectors, and none of {camera.name} is"
    raise PipelineError(message, place=place, cure=f"{by}, or set stokes: I")


def warn_before(
    observations: Sequence[Observation],
    frame: str,
    condition_limit: float,
    place: str,
) -> None:
    """Warn where the samples of all scans, taken together, do not determine I, Q and U of ``frame``
    within ``condition_limit``.
    """
    bands = np.unique(observations[0].focalplane.band)
    for band in bands:
        some = [observations[k] for k in _some(len(observations), SCANS)]
        number = SAMPLES // len(some)
        found = [
            _weights(frame, o, np.flatnonzero(o.focalplane.band == band), number) for o in some
        ]
        condition = _condition(np.sum(found, axis=0))
        if condition > condition_limit:
            of = f", {list(observations[0].instrument.cameras)[band]}" if len(bands) > 1 else ""
            text = (
                "all samples together see too few angles of polarization, hardly a pixel will have"
                " I, Q and U"
            )
            limit = f"(condition number {condition:.2g}, condition_limit {condition_limit:g})"
            warnings.warn(f"{place}{of}: {text} {limit}; {CURE}", stacklevel=4)


def warn_after(product: MapProduct, place: str) -> None:
    """Warn where I, Q and U of most pixels with samples are NaN."""
    if product.polarization is None:
        return
    hit, solved = int(np.count_nonzero(product.hits)), int(np.count_nonzero(product.known))
    if 2 * solved < hit:
        number = (
            f"{hit - solved} of {hit} pixels with samples have no I, Q and U"
            if solved
            else "the whole map is NaN"
        )
        text = f"{number}: the samples in a pixel see too few angles of polarization"
        warnings.warn(
            f"{place}: {text}; {CURE}, or larger pixels",
            stacklevel=5,
        )


def _some(n: int, most: int) -> NDArray[np.intp]:
    """Numbers below ``n``: all, or ``most`` at random."""
    return np.random.default_rng(0).permutation(n)[:most]


def _weights(frame: str, observation: Observation, rows: NDArray[np.intp], number: int) -> Floats:
    """(3, 3) sum of (1, c, s) (1, c, s)^T over a ``number`` of samples of some detectors: equation
    (1) of `core.polarization`.
    """
    rows = rows[observation.good_detectors[rows]]
    rows = rows[_some(rows.size, DETECTORS)]
    at = (np.linspace(0, 1, number) ** 2 * (observation.n_samples - 1)).astype(
        np.intp
    )  # in step with no plate
    plate = None if observation.hwp_angle is None else observation.hwp_angle[at]
    angles = PolarizationAngles.of(
        replace(observation, hwp_angle=plate),
        observation.boresight_radec[at],
        frame_rotation(frame)[2],
    )
    both = np.empty((2, rows.size, number))
    angles.fill(rows, 0, *both)
    both *= observation.focalplane.polarization_efficiency[rows, None]
    terms = np.stack([np.ones(rows.size * number), *both.reshape(2, -1)])
    return np.asarray(terms @ terms.T)


def _condition(a: Floats) -> float:
    """Condition number of a symmetric matrix; infinite within rounding, 0 where it is zero (all
    detectors are flagged).
    """
    low = np.linalg.eigvalsh(a)
    return float(low[-1] / low[0]) if low[0] > 1e-12 * low[-1] else math.inf if low[-1] > 0 else 0.0
