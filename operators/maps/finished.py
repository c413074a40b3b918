"""Makes the map of a signal from its sums."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Data
from zonda.core.errors import PipelineError
from zonda.core.maps.beams import SPREAD
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.scan_hits import ScanHits
from zonda.core.numerics.angles import angle_text
from zonda.core.numerics.chunks import empty
from zonda.core.signal import MAIN, product_name
from zonda.core.tally import Tally
from zonda.core.types import Floats

from .few_angles import warn_after
from .grid import Grid, HealpixGrid
from .halves import DIFFERENCES
from .map_sums import MapSums
from .parameters import MapParameters
from .stokes_map import UNSOLVED, stokes_map_of
from .stokes_product import StokesSums
from .sums import DATA, HITS, NOISE, VALUE, WEIGHT, WEIGHTS, Sums

AT_ONCE = 1 << 15
"""Pixels whose maps are made at a time: what is only used for a moment stays in the cache."""


def finish(
    step: MapParameters,
    data: Data,
    grid: Grid,
    layout: Mapping[str, Any],
    sums: MapSums | StokesSums,
) -> None:
    """Add the map of each signal to the products. Raises PipelineError where another step has made
    one of this name.
    """
    for stream in sums.signals or (MAIN,):
        key = product_name(stream, step.product)
        if key in data.products:
            text = f"two steps make the product {step.product!r}"
            raise PipelineError(
                text, place=step.label, cure="give one of them another product name"
            )
        polarized = isinstance(sums, StokesSums)
        make = stokes_map_of if polarized else map_of
        product = make(step, grid, layout, sums, stream)  # type: ignore[arg-type]
        product.band = data.scene.instrument.band
        if stream == MAIN:
            _with_coverage(product, grid, sums)
            state_choices(step, product, sums, data.tally)
            warn_after(step, product, data.band)
            tell_beams(step, product, data)
        if step.smooth is not None:
            product = product.smoothed(
                product.fwhm if step.smooth == "beam" else float(step.smooth)
            )
        data.products[key] = product


def map_of(
    step: MapParameters, grid: Grid, layout: Mapping[str, Any], sums: MapSums, stream: str
) -> MapProduct:
    """The map of the signal ``stream``."""
    n, variance = grid.n_pixels, layout["variance"]
    unit = variance if step.weights == "inverse_variance" else 1.0
    hits, signal, weight, noise = (
        empty((n, 1), kind).reshape(n) for kind in (np.int64, float, float, float)
    )
    halves = (
        bool(step.half_difference)
        and (len(sums.scans) >= 2 or not sums.of_scans)
        and step.contents == "all"
    )
    half = empty((n, 1), float).reshape(n) if halves else None
    for start in range(0, n, AT_ONCE):
        part = slice(start, start + AT_ONCE)
        total = sums.total(stream, part)
        hits[part] = total[:, HITS]
        if step.contents == "hits":
            signal[part], noise[part], weight[part] = np.nan, np.nan, hits[part] / unit
            continue
        signal[part], w = _mean(total)
        weight[part], noise[part] = (
            w / unit,
            _noise(total, signal[part], w, variance, step.noise == "scatter"),
        )
        if half is not None:
            (even, w_even), (odd, w_odd) = (_mean(sums.half(stream, k, part)) for k in (0, 1))
            with np.errstate(invalid="ignore", divide="ignore"):
                half[part] = (even - odd) * np.sqrt(w_even * w_odd) / (w_even + w_odd)
    keep = hits > 0 if isinstance(grid, HealpixGrid) else slice(None)
    planes: list[NDArray[Any]] = [signal, hits, weight, noise] + (
        [half] if half is not None else []
    )
    planes = [
        plane[keep].reshape(-1 if isinstance(grid, HealpixGrid) else grid.shape) for plane in planes
    ]
    common: dict[str, Any] = {
        "frame": step.frame,
        "weighting": step.weights,
        "noise_from": step.noise,
        "fwhm": sums.beams.fwhm or layout["fwhm"],
        "beams": sums.beams.extremes,
        "scans": list(sums.scans),
        "centre": tuple(layout["middle"]),
        "half_difference": planes[4] if half is not None else None,
        "difference": DIFFERENCES[step.split],
        "contents": step.contents,
        "sample_rate": min(sums.rates) if len(sums.rates) == 1 else 0.0,
    }
    if not isinstance(grid, HealpixGrid):
        header = grid.header
        return MapProduct(
            planes[0], planes[1], planes[2], planes[3], header=header, pixel=grid.pixel, **common
        )
    size = math.sqrt(4 * math.pi / (12 * grid.nside**2))
    return MapProduct(
        planes[0],
        planes[1],
        planes[2],
        planes[3],
        header=None,
        pixel=size,
        nside=grid.nside,
        nest=grid.nest,
        pixels=grid.pixels_covered[keep],
        **common,
    )


def _with_coverage(product: MapProduct, grid: Grid, sums: MapSums | StokesSums) -> None:
    """Give a map how its scans cross, and their hits, where these were asked for."""
    coverage = sums.coverage
    planes, pixels = coverage.planes(), coverage.pixels
    if isinstance(grid, HealpixGrid):  # the product's pixels are those with hits
        keep = np.flatnonzero(sums.hits.any(axis=0))
        planes = {key: replace(p, values=p.values[:, keep]) for key, p in planes.items()}
        pixels = (
            None
            if pixels is None
            else [np.searchsorted(keep, some).astype(np.int32) for some in pixels]
        )
    for key, plane in planes.items():
        values = plane.values.reshape(-1, *product.hits.shape)
        product.planes[key] = replace(plane, values=values)
    if pixels is not None:
        product.scan_hits = ScanHits(list(sums.scans), pixels, coverage.hits)


def tell_beams(step: MapParameters, product: MapProduct, data: Data) -> None:
    """Tell which beam a map has whose detectors have several; warn where these differ much."""
    narrow, wide = product.beams
    if narrow < wide:
        beams = f"{angle_text(narrow)} to {angle_text(wide)}"
        text = (
            f"{angle_text(product.fwhm)}: peak times its area is the flux density; detectors have"
            f" {beams}"
        )
        data.tally.state(step.label, "beam of the map (FWHM)", text)
        if wide > SPREAD * narrow:
            more = (
                "fluxes are right by it, shapes are not: map detectors of one beam by themselves"
                " for these"
            )
            bmaj = angle_text(product.fwhm)
            warnings.warn(
                f"{step.label}: beams of {beams} are in one map, BMAJ is {bmaj}: {more}",
                stacklevel=4,
            )


def state_choices(
    step: MapParameters, product: MapProduct, sums: MapSums | StokesSums, tally: Tally
) -> None:
    """Tell how the map was made, and what is approximate about it."""
    if product.polarization is not None:
        hit = int(np.count_nonzero(product.hits))
        tally.count(step.label, UNSOLVED, hit - int(np.count_nonzero(product.known)), hit)
    if step.noise == "scatter":
        alone = int(np.count_nonzero(product.hits == 1))
        tally.count(
            step.label, "pixels with one sample, whose scatter is unknown: noise NaN", alone
        )
        equal = int(np.count_nonzero((product.hits > 1) & (product.noise == 0)))
        tally.count(
            step.label, "pixels whose samples scatter by less than rounding: noise 0", equal
        )
        if step.smooth is not None:
            tally.count(
                step.label,
                "of them left out of the smoothed noise, which is too low around them",
                alone,
            )
    if sums.unknown_variance:
        tally.state(step.label, "weights", "uniform: every NET is 0")
    tally.state(step.label, "fixed-point step of the sums", f"{1 / VALUE:.1e} K per sample")
    if not sums.of_scans:
        tally.state(step.label, "half-difference of", DIFFERENCES[step.split])
    if step.half_difference and sums.of_scans and len(sums.scans) < 2:
        tally.state(step.label, "half-difference", "not made: it needs two scans")


def _mean(sums: Sums) -> tuple[Floats, Floats]:
    """(signal, weight) of fixed-point sums (n_pixel, 4); NaN where there are no hits."""
    weight = sums[:, WEIGHTS] / WEIGHT
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(sums[:, HITS] > 0, sums[:, DATA] / VALUE / weight, np.nan), weight


def _noise(total: Sums, signal: Floats, weight: Floats, variance: float, scatter: bool) -> Floats:
    """Standard deviation of each pixel's mean: from the NET, or from the scatter of the samples."""
    term = total[:, NOISE] / WEIGHT * variance
    hits = total[:, HITS]
    with np.errstate(invalid="ignore", divide="ignore"):
        if not scatter:
            return np.where(hits > 0, np.sqrt(term) / weight, np.nan)
        # equal samples leave the rounding of their squares, of either sign: a scatter below it is
        # counted, and 0
        found = np.maximum(term / weight - signal**2, 0.0)
        return np.where(hits > 1, np.sqrt(found / (hits - 1)), np.nan)
