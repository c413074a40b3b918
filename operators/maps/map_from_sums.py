"""Makes the map of a signal from its sums."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from zonda.core.data import Data
from zonda.core.errors import PipelineError
from zonda.core.maps.beams import SPREAD
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.scan_hits import ScanHits
from zonda.core.numerics.angles import angle_text
from zonda.core.numerics.chunks import empty
from zonda.core.signal import MAIN, product_name
from zonda.core.tally import Tally

from .angle_checks import warn_after
from .grid import Grid, HealpixGrid
from .halves import DIFFERENCES
from .map_sums import MapSums
from .parameters import MapParameters
from .solve import Solver
from .sums import VALUE

AT_ONCE = 1 << 14
"""Pixels whose maps are made at a time: what is only used for a moment stays in the cache."""
UNSOLVED = "pixels whose samples do not determine I, Q and U: NaN"
"""A count of the log."""


def finish(
    step: MapParameters,
    data: Data,
    grid: Grid,
    layout: Mapping[str, Any],
    sums: MapSums,
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
        product = map_of(step, grid, layout, sums, stream)
        product.band = data.scene.instrument.band
        if stream == MAIN:
            _with_coverage(product, grid, sums)
            state_choices(step, product, sums, data.tally)
            band = f", {data.band}" if data.band else ""
            warn_after(product, step.label + band)
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
    variance = layout["variance"]
    solver = Solver(
        sums,
        variance,
        variance if step.weights == "inverse_variance" else 1.0,
        step.noise == "scatter",
        step.condition_limit,
        bool(step.half_difference) and sums.halved and step.contents == "all",
    )
    planes: dict[str, Any] = {}
    for start in range(0, max(grid.n_pixels, 1), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        for name, values in solver.planes(stream, part).items():
            if name not in planes:
                planes[name] = empty((len(values), grid.n_pixels), values.dtype)
            planes[name][:, part] = values
    if step.contents == "hits":
        planes["signal"][:] = planes["noise"][:] = np.nan
    keep: Any = slice(None)
    shape: tuple[int, ...] = (-1,)
    if isinstance(grid, HealpixGrid):
        keep = np.flatnonzero(planes["hits"][0])
    else:
        shape = grid.shape
    planes = {name: rows[:, keep].reshape(len(rows), *shape) for name, rows in planes.items()}
    planes["hits"] = planes["hits"][0]
    return MapProduct(
        **planes,
        frame=step.frame,
        weighting=step.weights,
        noise_from=step.noise,
        fwhm=sums.beams.fwhm or layout["fwhm"],
        beams=sums.beams.extremes,
        scans=list(sums.scans),
        centre=tuple(layout["middle"]),
        difference=DIFFERENCES[step.split],
        contents=step.contents,
        sample_rate=min(sums.rates) if len(sums.rates) == 1 else 0.0,
        **pixels_of(grid, keep),
    )


def pixels_of(grid: Grid, keep: Any) -> dict[str, Any]:
    """Where the pixels of a map are: those of a list that it has are numbered ``keep``."""
    if not isinstance(grid, HealpixGrid):
        return {"header": grid.header, "pixel": grid.pixel}
    return {
        "header": None,
        "pixel": math.sqrt(4 * math.pi / (12 * grid.nside**2)),
        "nside": grid.nside,
        "nest": grid.nest,
        "pixels": grid.pixels_covered[keep],
    }


def _with_coverage(product: MapProduct, grid: Grid, sums: MapSums) -> None:
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


def state_choices(step: MapParameters, product: MapProduct, sums: MapSums, tally: Tally) -> None:
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
    if step.half_difference and not sums.halved:
        tally.state(step.label, "half-difference", "not made: it needs two scans")
