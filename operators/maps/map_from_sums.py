"""Map products from the sums of their samples: m = A^-1 b and its covariance A^-1 N A^-1 in each
pixel, equations (1) and (2) of `binning`.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from zonda.core.data import Data
from zonda.core.errors import PipelineError
from zonda.core.log import Log
from zonda.core.maps.beams import SPREAD
from zonda.core.maps.map_file import Provenance
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import is_quiet
from zonda.core.maps.planes import ScanHits
from zonda.core.numerics.chunks import empty
from zonda.core.numerics.sphere import angle_text
from zonda.core.signal import MAIN, product_name
from zonda.core.types import AnyFloats, Floats

from .angle_checks import warn_after
from .grid import Grid
from .intensity_kernel import VALUE, WEIGHT
from .map_sums import MapSums, PixelSums
from .parameters import DIFFERENCES, MapParameters
from .stokes_kernel import PLACES

AT_ONCE = 1 << 14
"""Pixels whose maps are made at a time: intermediate arrays stay in the cache."""
TRIANGLE = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
"""Rows and columns of the elements of a symmetric matrix: ii, iq, iu, qq, qu, uu."""
SINGULAR = 1e-8
"""Of the smallest eigenvalue, as a share of the largest: below it is the rounding of the sums."""
UNSOLVED = "pixels whose samples do not determine I, Q and U: NaN"
"""A count of the log."""


@dataclass(frozen=True)
class MapFromSums:
    """Sums of a map's samples, and the parameters, pixels and layout of its product."""

    parameters: MapParameters
    grid: Grid
    layout: Mapping[str, Any]
    sums: MapSums

    def finish(self, data: Data) -> None:
        """Add the map of each signal to the products. Raises PipelineError where another step has
        made one of this name.
        """
        origin, runs = Provenance.of(data, tables=False), data.provenance.get("runs", {})
        for stream in self.sums.signals or (MAIN,):
            key = product_name(stream, self.parameters.product)
            if key in data.products:
                text = f"two steps make the product {self.parameters.product!r}"
                raise PipelineError(
                    text,
                    place=self.parameters.label,
                    cure="give one of them another product name",
                )
            product = self.map_of(stream)
            product.band = data.scene.instrument.band
            signal, slash, plain = key.rpartition("/")
            name = f"{signal}{slash}{data.named(plain)}"
            product.origin = replace(origin, product=name, quiet=is_quiet(runs, name))
            if stream == MAIN:
                self._add_coverage(product)
                self._state_choices(product, data.log)
                band = f", {data.band}" if data.band else ""
                warn_after(product, self.parameters.label + band)
                self._state_beams(product, data)
            if self.parameters.smooth is not None:
                product = product.smoothed(
                    product.fwhm
                    if self.parameters.smooth == "beam"
                    else float(self.parameters.smooth)
                )
            data.products[key] = product

    def map_of(self, stream: str) -> MapProduct:
        """The map of the signal ``stream``."""
        planes: dict[str, Any] = {}
        for start in range(0, max(self.grid.n_pixels, 1), AT_ONCE):
            part = slice(start, start + AT_ONCE)
            for name, values in self.planes_of(stream, part).items():
                if name not in planes:
                    planes[name] = empty((len(values), self.grid.n_pixels), values.dtype)
                planes[name][:, part] = values
        if self.parameters.contents == "hits":
            planes["signal"][:] = planes["noise"][:] = np.nan
        seen, shape = self.grid.seen(planes["hits"][0]), self.grid.shape
        planes = {name: rows[:, seen].reshape(len(rows), *shape) for name, rows in planes.items()}
        planes["hits"] = planes["hits"][0]
        return MapProduct(
            **planes,
            frame=self.parameters.frame,
            weighting=self.parameters.weights,
            noise_from=self.parameters.noise,
            fwhm=self.sums.beams.fwhm or self.layout["fwhm"],
            beams=self.sums.beams.extremes,
            scans=list(self.sums.scans),
            centre=tuple(self.layout["middle"]),
            difference=DIFFERENCES[self.parameters.split],
            contents=self.parameters.contents,
            sample_rate=min(self.sums.rates) if len(self.sums.rates) == 1 else 0.0,
            **self.grid.described(seen),
        )

    @property
    def halves(self) -> bool:
        """The difference of two halves is wanted."""
        wanted = self.parameters.half_difference and self.parameters.contents == "all"
        return bool(wanted) and self.sums.halved

    def planes_of(self, stream: str, part: slice) -> dict[str, AnyFloats]:
        """Planes by name, each (rows, n), of the signal ``stream`` in some pixels."""
        unit = self.layout["variance"] if self.parameters.weights == "inverse_variance" else 1.0
        make = self._polarized if self.sums.polarized else self._plain
        found = make(stream, part, self.layout["variance"])
        found["weights"] = found["weights"] / unit
        return {name: np.atleast_2d(values) for name, values in found.items()}

    def _plain(self, stream: str, part: slice, variance: float) -> dict[str, AnyFloats]:
        sums = self.sums.in_pixels(stream, part)
        hits, term = sums.hits, sums.noise[:, 0] / WEIGHT * variance
        signal, weight = _mean(sums)
        with np.errstate(invalid="ignore", divide="ignore"):
            if self.sums.scatter:
                # equal samples leave the rounding of their squares, of either sign: a scatter below
                # it is counted, and 0
                rest = np.maximum(term / weight - signal**2, 0.0)
                error = np.where(hits > 1, np.sqrt(rest / (hits - 1)), np.nan)
            else:
                error = np.where(hits > 0, np.sqrt(term) / weight, np.nan)
        found = {"signal": signal, "hits": hits, "weights": weight, "noise": error}
        if self.halves:
            (one, w), (two, v) = (_mean(self.sums.in_pixels(stream, part, half)) for half in (0, 1))
            with np.errstate(invalid="ignore", divide="ignore"):
                found["half_difference"] = (one - two) * np.sqrt(w * v) / (w + v)
        return found

    def _polarized(self, stream: str, part: slice, variance: float) -> dict[str, AnyFloats]:
        limit = self.parameters.condition_limit
        sums = self.sums.in_pixels(stream, part)
        solved = _solved(sums, limit, self.sums.own_noise)
        covariance = solved.covariance[:, TRIANGLE[0], TRIANGLE[1]].T * variance
        found = {
            "signal": solved.stokes.T,
            "hits": sums.hits,
            "weights": np.nan_to_num(1 / solved.spread.T),
            "noise": np.sqrt(covariance[[0, 3, 5]]),
            "covariance": covariance,
            "condition": solved.condition,
        }
        if self.halves:
            one, two = (
                _solved(self.sums.in_pixels(stream, part, half), limit, False) for half in (0, 1)
            )
            share = np.sqrt(solved.spread / (one.spread + two.spread))
            found["half_difference"] = ((one.stokes - two.stokes) * share).T
        return found

    def _add_coverage(self, product: MapProduct) -> None:
        """Add the planes that tell how scans cross, and the hits of each scan, if asked for."""
        coverage = self.sums.coverage
        if not coverage.sums and coverage.pixels is None:
            return
        seen = self.grid.seen(self.sums.hits.any(axis=0))
        for key, plane in coverage.planes().items():
            values = plane.values[:, seen].reshape(-1, *product.hits.shape)
            product.planes[key] = replace(plane, values=values)
        if (pixels := coverage.pixels) is not None:
            if product.pixels is not None:  # those of the product are those with hits
                pixels = [np.searchsorted(seen, some).astype(np.int32) for some in pixels]
            product.scan_hits = ScanHits(list(self.sums.scans), pixels, coverage.hits)

    def _state_beams(self, product: MapProduct, data: Data) -> None:
        """State the beam of a map whose detectors have several; warn where these differ much."""
        narrow, wide = product.beams
        if narrow < wide:
            beams = f"{angle_text(narrow)} to {angle_text(wide)}"
            text = (
                f"{angle_text(product.fwhm)}: peak times its area is the flux density;"
                f" detectors have {beams}"
            )
            data.log.state(self.parameters.label, "beam of the map (FWHM)", text)
            if wide > SPREAD * narrow:
                more = (
                    "fluxes are right by it, shapes are not: map detectors of one beam by"
                    " themselves for these"
                )
                bmaj = angle_text(product.fwhm)
                warnings.warn(
                    f"{self.parameters.label}: beams of {beams} are in one map,"
                    f" BMAJ is {bmaj}: {more}",
                    stacklevel=4,
                )

    def _state_choices(self, product: MapProduct, log: Log) -> None:
        """State how the map was made, and its approximations."""
        if product.polarization is not None:
            hit = int(np.count_nonzero(product.hits))
            log.count(
                self.parameters.label,
                UNSOLVED,
                hit - int(np.count_nonzero(product.known)),
                hit,
            )
        if self.parameters.noise == "scatter":
            alone = int(np.count_nonzero(product.hits == 1))
            log.count(
                self.parameters.label,
                "pixels with one sample, whose scatter is unknown: noise NaN",
                alone,
            )
            equal = int(np.count_nonzero((product.hits > 1) & (product.noise == 0)))
            log.count(
                self.parameters.label,
                "pixels whose samples scatter by less than rounding: noise 0",
                equal,
            )
            if self.parameters.smooth is not None:
                log.count(
                    self.parameters.label,
                    "of them left out of the smoothed noise, which is too low around them",
                    alone,
                )
        if self.sums.unknown_variance:
            log.state(self.parameters.label, "weights", "uniform: every NET is 0")
        log.state(
            self.parameters.label,
            "fixed-point step of the sums",
            f"{1 / VALUE:.1e} K per sample",
        )
        if not self.sums.of_scans:
            log.state(
                self.parameters.label,
                "half-difference of",
                DIFFERENCES[self.parameters.split],
            )
        if self.parameters.half_difference and not self.sums.halved:
            log.state(self.parameters.label, "half-difference", "not made: it needs two scans")


class Solved(NamedTuple):
    """I, Q and U of pixels.

    Attributes
    ----------
    stokes
        (n, 3) [K], NaN where the condition number is above the limit.
    spread
        (n, 3) diagonal of A^-1.
    covariance
        (n, 3, 3) A^-1 N A^-1, in units of the reference variance.
    condition
        (n,) condition number of A, NaN without hits.
    """

    stokes: Floats
    spread: Floats
    covariance: Floats
    condition: Floats


def _mean(sums: PixelSums) -> tuple[Floats, Floats]:
    """(signal, weight) of I; NaN where there are no hits."""
    weight = sums.weights[:, 0] / WEIGHT
    with np.errstate(invalid="ignore", divide="ignore"):
        signal = sums.data[:, 0] / VALUE / weight
    return np.where(sums.hits > 0, signal, np.nan), weight


def _solved(sums: PixelSums, limit: float, own_noise: bool) -> Solved:
    """I, Q and U of pixels whose condition number is at most the ``limit``."""
    n = len(sums.hits)
    stokes, spread = np.full((2, n, 3), np.nan)
    covariance, condition = np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    hit = np.flatnonzero(sums.hits)
    a = sums.weights[hit][:, PLACES].reshape(-1, 3, 3) / WEIGHT
    low, axes = np.linalg.eigh(a)
    with np.errstate(divide="ignore"):
        condition[hit] = np.where(low[:, 0] > SINGULAR * low[:, 2], low[:, 2] / low[:, 0], np.inf)
    fine = condition[hit] <= limit
    pixels, axes, low = hit[fine], axes[fine], low[fine]
    inverse, b = (axes / low[:, None, :]) @ axes.transpose(0, 2, 1), sums.data[pixels] / VALUE
    stokes[pixels] = np.einsum("nij,nj->ni", inverse, b)
    rest = b - np.einsum("nij,nj->ni", a[fine], stokes[pixels])  # one step of refinement
    stokes[pixels] += np.einsum("nij,nj->ni", inverse, rest)
    spread[pixels] = np.einsum("nii->ni", inverse)
    covariance[pixels] = inverse
    if own_noise:
        noise = sums.noise[pixels][:, PLACES].reshape(-1, 3, 3) / WEIGHT
        covariance[pixels] = inverse @ noise @ inverse
    return Solved(stokes, spread, covariance, condition)
