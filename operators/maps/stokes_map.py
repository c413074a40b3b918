"""Maps of I, Q and U from their sums: equations (1) and (2) of `stokes_sums`, solved in each
pixel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.projection import frame_rotation
from zonda.core.polarization import PolarizationAngles
from zonda.core.types import Floats

from .grid import Grid, HealpixGrid
from .halves import DIFFERENCES, halves_of
from .parameters import MapParameters
from .pixels import Looking, fingerprint
from .stokes_kernel import HIT
from .stokes_product import StokesSums
from .stokes_sums import PLACES, StokesBinning
from .sums import VALUE, WEIGHT, Sums

AT_ONCE = 1 << 14
"""Pixels that are solved at a time."""
TRIANGLE = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
"""Rows and columns of the elements of a symmetric matrix: ii, iq, iu, qq, qu, uu."""
SINGULAR = 1e-8
"""Of the smallest eigenvalue, as a share of the largest: below it is the rounding of the sums."""
UNSOLVED = "pixels whose samples do not determine I, Q and U: NaN"
"""A count of the log."""


def check_polarized(step: MapParameters, observation: Observation) -> None:
    """Raise PipelineError where I, Q and U are wanted and no detector is polarized."""
    if step.stokes != "IQU" or observation.focalplane.polarized:
        return
    camera = observation.instrument
    by = camera.polarized_by
    if (table := camera.focalplane_table) is not None:
        by = (
            f"add the column polarization_angle to {table} (polarization_efficiency, if it is"
            " there, must be above 0)"
        )
    message = f"stokes: IQU needs polarized detectors, and none of {camera.name} is"
    raise PipelineError(message, place=step.label, cure=f"{by}, or set stokes: I")


def stokes_binnings(
    step: MapParameters,
    looking: Looking,
    levels: tuple[Floats, Floats, Floats],
    good: Any,
    spare: list[Sums],
) -> list[StokesBinning]:
    """Empty sums for one observation, one for each half of its samples.

    ``levels``: weights and noise of the detectors (`bin_map.weights_of`), and the window (n_samp,)
    or (0,); ``good`` (n_samp,): which samples count. Raises PipelineError where no detector is
    polarized.
    """
    observation, (weight, noise, window) = looking.observation, levels
    check_polarized(step, observation)
    own = bool(window.size) or not np.allclose(weight, noise, rtol=1e-6, atol=0)
    angles = PolarizationAngles.of(
        observation, observation.boresight_radec, frame_rotation(step.frame)[2]
    )
    signals, key = len(observation.signals), None
    halves = [
        (use, (good & samples).astype(np.uint8))
        for use, samples in halves_of(step.split, observation)
    ]
    if looking.key is not None:
        seen = (
            angles.poles,
            angles.axes,
            angles.plate,
            angles.gamma,
            observation.focalplane.polarization_efficiency,
            window,
        )
        key = looking.key, own, fingerprint(*seen, *(mask for half in halves for mask in half))
    return [
        StokesBinning(looking, angles, *half, window, weight, noise, signals, own, spare, key)
        for half in halves
    ]


@dataclass(frozen=True)
class _Solved:
    """I, Q and U of some pixels.

    Attributes
    ----------
    values, covariance
        (n, 3) K; (n, 3, 3) K^2; NaN where they are not determined. ``spread``: (n, 3) diagonal of
        A^-1.
    condition
        (n,) NaN without hits.
    """

    values: Floats
    covariance: Floats
    spread: Floats
    condition: Floats

    @classmethod
    def of(
        cls, sums: tuple[Sums, Sums, Sums], limit: float, variance: float, own_noise: bool
    ) -> _Solved:
        """``limit`` of the condition number, ``variance`` of the reference weight."""
        counts, data, noise = sums
        n = len(counts)
        values, spread = np.full((2, n, 3), np.nan)
        covariance, condition = np.full((n, 3, 3), np.nan), np.full(n, np.nan)
        hit = np.flatnonzero(counts[:, HIT])
        a = counts[hit][:, PLACES].reshape(-1, 3, 3) / WEIGHT
        low, axes = np.linalg.eigh(a)
        with np.errstate(divide="ignore"):
            condition[hit] = np.where(
                low[:, 0] > SINGULAR * low[:, 2], low[:, 2] / low[:, 0], np.inf
            )
        fine = condition[hit] <= limit
        pixels, axes, low = hit[fine], axes[fine], low[fine]
        inverse = (axes / low[:, None, :]) @ axes.transpose(0, 2, 1)
        values[pixels] = np.einsum("nij,nj->ni", inverse, data[pixels] / VALUE)
        values[pixels] += np.einsum(
            "nij,nj->ni", inverse, _rest(a[fine], values[pixels], data[pixels] / VALUE)
        )
        spread[pixels] = np.einsum("nii->ni", inverse)
        covariance[pixels] = inverse * variance
        if own_noise:
            middle = noise[pixels][:, [k - 1 for k in PLACES]].reshape(-1, 3, 3) / WEIGHT
            covariance[pixels] = inverse @ middle @ inverse * variance
        return cls(values, covariance, spread, condition)


def _rest(a: Floats, values: Floats, data: Floats) -> Floats:
    """What a solution leaves of b: one step of refinement."""
    return np.asarray(data - np.einsum("nij,nj->ni", a, values))


def stokes_map_of(
    step: MapParameters, grid: Grid, layout: Mapping[str, Any], sums: StokesSums, stream: str
) -> MapProduct:
    """The map of the signal ``stream``."""
    n, variance = grid.n_pixels, layout["variance"]
    unit = variance if step.weights == "inverse_variance" else 1.0
    halves = bool(step.half_difference) and (len(sums.scans) >= 2 or not sums.of_scans)
    hits = np.zeros(n, np.int64)
    values, covariance, weights = np.empty((3, n)), np.empty((6, n)), np.zeros((3, n))
    condition, half = np.empty(n), np.full((3, n), np.nan)
    for start in range(0, n, AT_ONCE):
        part = slice(start, start + AT_ONCE)
        whole = sums.parts(stream, part)
        found = _Solved.of(whole, step.condition_limit, variance, sums.noise is not None)
        hits[part], condition[part], values[:, part] = (
            whole[0][:, HIT],
            found.condition,
            found.values.T,
        )
        covariance[:, part] = found.covariance[:, TRIANGLE[0], TRIANGLE[1]].T
        weights[:, part] = np.nan_to_num(1 / found.spread.T / unit)
        if halves:
            one, two = (
                _Solved.of(sums.parts(stream, part, k), step.condition_limit, 1.0, False)
                for k in (0, 1)
            )
            share = found.spread / (one.spread + two.spread)
            half[:, part] = ((one.values - two.values) * np.sqrt(share)).T
    keep = hits > 0 if isinstance(grid, HealpixGrid) else slice(None)

    def shaped(plane: Any) -> Any:
        rest = (-1,) if isinstance(grid, HealpixGrid) else grid.shape
        return plane[..., keep].reshape(*plane.shape[:-1], *rest)

    noise = np.sqrt(covariance[[0, 3, 5]])
    return MapProduct(
        shaped(values),
        shaped(hits),
        shaped(weights),
        shaped(noise),
        shaped(half) if halves else None,
        covariance=shaped(covariance),
        condition=shaped(condition),
        **_common(step, grid, layout, sums, keep),
    )


def _common(
    step: MapParameters, grid: Grid, layout: Mapping[str, Any], sums: StokesSums, keep: Any
) -> dict[str, Any]:
    """What is said of the map beside its planes."""
    found: dict[str, Any] = {
        "frame": step.frame,
        "weighting": step.weights,
        "noise_from": step.noise,
        "fwhm": sums.beams.fwhm or layout["fwhm"],
        "beams": sums.beams.extremes,
        "scans": list(sums.scans),
        "centre": tuple(layout["middle"]),
        "difference": DIFFERENCES[step.split],
        "sample_rate": min(sums.rates) if len(sums.rates) == 1 else 0.0,
    }
    if not isinstance(grid, HealpixGrid):
        return found | {"header": grid.header, "pixel": grid.pixel}
    side = math.sqrt(4 * math.pi / (12 * grid.nside**2))
    pixels = grid.pixels_covered[keep]
    return found | {
        "header": None,
        "pixel": side,
        "nside": grid.nside,
        "nest": grid.nest,
        "pixels": pixels,
    }
