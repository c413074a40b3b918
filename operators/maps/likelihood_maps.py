"""Maximum-likelihood maps of the signals: noise of data minus the map, solutions, and what is taken
off them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Data
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.planes import Plane
from zonda.core.output import publish
from zonda.core.signal import MAIN, Signal, product_name
from zonda.core.types import Floats

from .baseline_noise import estimate, what_remains
from .grid import Grid
from .intensity_kernel import VALUE
from .map_from_sums import MapFromSums
from .map_sums import MapSums
from .noise_record import NoiseRecord
from .normal_equations import CompressedScans, NormalEquations, Solution, WeighedScan, Work
from .parameters import LikelihoodParameters
from .preconditioner import UNDETERMINED
from .undetermined import TINY, Patterns, undetermined

MOST_ITERATIONS = 1000
"""Iterations of conjugate gradients at most."""
TEMPLATE = 1e-8
"""Tolerance of the weights of templates where other bands' maps, or gaps, are unknown."""
POOR = 1e-2
"""Ritz value of a pattern whose noise is ten times white noise."""


@dataclass(frozen=True)
class LikelihoodSystem:
    """Equations of the maps of all bands that share modes, and their solutions.

    Attributes
    ----------
    parts
        Of each band the grid, layout and sums of its map, whose pixels follow those of the band
        before.
    scans
        With the detectors of all bands.
    data
        Those of the first band.
    work
        For all solutions.
    """

    parameters: LikelihoodParameters
    parts: Sequence[tuple[Grid, Mapping[str, Any], MapSums]]
    scans: CompressedScans
    data: Data
    work: Work = field(default_factory=Work)
    weighed: dict[int, tuple[Floats, list[Floats]]] = field(default_factory=dict)
    _solutions: dict[tuple[str, int | None], Solution] = field(default_factory=dict)

    @cached_property
    def pixels(self) -> list[slice]:
        """Pixels of each band."""
        ends = np.cumsum([0, *(grid.n_pixels for grid, _, _ in self.parts)]).tolist()
        return [slice(*some) for some in pairwise(ends)]

    @cached_property
    def equations(self) -> NormalEquations:
        """Normal equations of all scans, with the noise of data minus the map."""
        found = self._of([WeighedScan(one.scan, one.noise) for one in self.scans.scans])
        step, first = self.parameters, self.parts[0][2].first
        for turn in range(step.refined):
            solution = self._solve(found, self.right_side(found, first), "noise")
            remains = self._remains(found, turn)
            scans = []
            for k, (one, (scan, noise)) in enumerate(
                zip(self.scans.scans, found.scans, strict=True)
            ):
                new = estimate(
                    one.data[first][0] - found.baselines(solution, k),
                    scan.counted,
                    noise.white,
                    scan.length,
                    scan.rate,
                    modes=step.modes,
                    free=step.free,
                    trend=step.trend,
                    fixed=noise.modes[noise.kept],
                    lacking=scan.lacking,
                    groups=noise.groups,
                    places=noise.places,
                    remains=remains[k],
                )
                if step.noise != "estimated":
                    new = replace(new, own=noise.own)
                scans.append(WeighedScan(scan, new))
            found = self._of(scans)
        return found

    def _remains(self, found: NormalEquations, turn: int) -> Sequence[Floats | None]:
        """Shares of the detectors' own noise that a map leaves, of each scan, from a draw; None
        where it is not estimated. The draw is made again for its baselines, which would take 8
        bytes each.
        """
        if self.parameters.noise != "estimated":
            return [None] * len(found.scans)
        drawn, shares = self._solve(found, found.drawn(turn), "noise, a draw"), []
        for k, (scan, noise) in enumerate(found.scans):
            y = found.draw(turn, k)[1]
            rest = y - found.baselines(drawn, k)
            shares.append(what_remains(rest, y, scan.counted, noise))
        return shares

    @cached_property
    def equations_of_halves(self) -> list[NormalEquations]:
        """Normal equations of even and of odd scans, the same for all signals."""
        return [self._of(self.equations.scans[half::2]) for half in range(2)]

    def _of(self, scans: Sequence[WeighedScan]) -> NormalEquations:
        n_stokes = 3 if self.parts[0][2].polarized else 1
        return NormalEquations(
            scans, n_stokes, self.pixels[-1].stop, self.data.threads, self._places, self.work
        )

    def _places(self, pixels: NDArray[np.intp]) -> Floats:
        """(2, n) coordinates of pixels, rising; maps of several bands lie side by side."""
        found, edge = list[Floats](), 0.0
        for (grid, *_), own in zip(self.parts, self.pixels, strict=True):
            some = pixels[(pixels >= own.start) & (pixels < own.stop)] - own.start
            at = grid.places(some) if some.size else np.zeros((2, 0))
            if len(self.parts) > 1 and some.size:
                low, wide = at.min(axis=1, keepdims=True), max(float(np.ptp(at[0])), TINY)
                at = (at - low) * [[1 / wide], [1.0]] + [[edge], [0.0]]
                edge += 1.0
            found.append(at)
        return np.concatenate(found, axis=1)

    def solved(self, stream: str, half: int | None = None) -> Solution:
        """The solution for a signal, of all scans or of half of them; of several bands it is kept
        for the others.
        """
        key = stream, half
        if key in self._solutions:
            return self._solutions[key]
        equations = self.equations if half is None else self.equations_of_halves[half]
        what = product_name(stream, "map") + ("" if half is None else f", half {half + 1}")
        found = self._solve(equations, self.right_side(equations, stream, half), what)
        if len(self.parts) > 1:
            self._solutions[key] = found
        return found

    def progress(self, what: str, tolerance: float) -> Callable[[float], None]:
        """Make the function that shows how far a residual is on its way to the tolerance."""
        told = [0]

        def tell(residual: float) -> None:
            told[0] = max(told[0], int(100 * np.log(max(residual, tolerance)) / np.log(tolerance)))
            self.data.progress(told[0], 100, f"{self.parameters.label}: iterations, {what}")

        return tell

    def _solve(self, equations: NormalEquations, right: Floats, what: str) -> Solution:
        """The solution of a right side; ``what`` progress calls it."""
        step = self.parameters
        tell = self.progress(what, step.tolerance)
        return equations.solve(right, step.tolerance, MOST_ITERATIONS, tell=tell)

    def right_side(
        self, equations: NormalEquations, stream: str, half: int | None = None
    ) -> Floats:
        """P^T Q d of a signal, of all scans or of half of them: of map and gaps."""
        binned = [
            sums.in_pixels(stream, slice(None), half).data.T / VALUE / layout["variance"]
            for _, layout, sums in self.parts
        ]
        scans = self.scans.scans if half is None else self.scans.scans[half::2]
        data = [one.data[stream] for one in scans]
        return equations.right_side(np.concatenate(binned, axis=1), data)

    def chi_square(self, found: Solution) -> tuple[float, float]:
        """chi^2 of the complete signal, of all bands, per degree of freedom; and its standard
        error.
        """
        data = [one.data[MAIN] for one in self.scans.scans]
        return self.equations.chi_square(found, self.right_side(self.equations, MAIN), data)

    @cached_property
    def patterns(self) -> Patterns:
        """Patterns that the data hardly determine."""
        return undetermined(self.equations, self.parameters.patterns)


@dataclass(frozen=True)
class LikelihoodMaps(MapFromSums):
    """Maps of the signals in one band, from sums in pixels and the solutions of all bands."""

    parameters: LikelihoodParameters
    system: LikelihoodSystem
    band: int
    data: Data

    def map_of(self, stream: str) -> MapProduct:
        """The map of a signal; its weights and its noise are those of white noise. Without filters
        it is the mean of the samples, of which the same is taken off.
        """
        product, system = super().map_of(stream), self.system
        if stream not in system.scans.scans[0].data:
            rows = np.nan_to_num(product.planes["signal"].values)
            values = np.zeros((len(rows), self.grid.n_pixels))
            values[:, self._seen] = rows.reshape(len(rows), -1)
            return self._with_values(product, values, stream)
        solution, own = system.solved(stream), self._own
        if self.halves:
            (one, first), (two, second) = (self._half(stream, k, product) for k in range(2))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.sqrt(system.equations.spread[:, own] / (first + second))
                values = np.where((first > 0) & (second > 0), (one - two) * share, np.nan)
            product = product.with_planes(half_difference=self._rows(product, values))
        made = self._with_values(product, solution.values[:, own], stream)
        if stream == MAIN:
            made.chi2 = system.chi_square(solution)
            self._tell(solution, made.chi2)
            self._publish(solution, made.chi2)
            made = self._with_patterns(made)
        return made

    @property
    def _own(self) -> slice:
        """The band's pixels among those of the equations."""
        return self.system.pixels[self.band]

    def _publish(self, solution: Solution, chi2: tuple[float, float]) -> None:
        """Make the product `NoiseRecord`, and write its tables."""
        models = [noise for _, noise in self.system.equations.scans]
        record = NoiseRecord(
            list(self.sums.scans),
            [
                noise.of_some(slice(*one.ends[self.band :][:2]))
                for noise, one in zip(models, self.system.scans.scans, strict=True)
            ],
            solution.history,
            solution.ritz,
            solution.before,
            chi2,
            self.parameters.tolerance,
            self.parameters.label,
            self.parameters.model,
            self.system.work,
        )
        product = self.parameters.product
        key = "noise_model" if product == "map" else f"noise_model_{product}"
        publish(self.data, key, record, record.tables(), CHI2=chi2[0], NOISE=record.noise)

    def _with_patterns(self, product: MapProduct) -> MapProduct:
        """The product with planes of the patterns that the data hardly determine, if asked for."""
        number, told = self.parameters.patterns, []
        if not number:
            return product
        found, planes = self.system.patterns, dict(product.planes)
        for k, (value, whole) in enumerate(zip(*found, strict=True), 1):
            pattern = whole[:, self._own]
            determined = value > UNDETERMINED
            told.append(f"{value:.1e}" if determined else f"< {UNDETERMINED:g}")
            title = f"Pattern {k}, Ritz value {told[-1]}"
            caption = "A pattern that the data do not determine, up to a factor."
            if determined:
                caption = (
                    "A pattern of the map, up to a factor: the noise along it is"
                    f" {value**-0.5:.2g} times that of white noise."
                )
            most = int(np.abs(pattern).max(axis=1).argmax())
            for j, row in enumerate(self._rows(product, pattern)):
                key = f"undetermined_{k}{('', '_q', '_u')[j]}"
                colours = (-1.0, 1.0) if j == most else None
                planes[key] = Plane(
                    row[None],
                    {key: title},
                    unit="share of the largest value",
                    colours=colours,
                    title=title,
                    caption=caption,
                )
        label = self.parameters.label
        self.data.log.state(label, "Ritz values of patterns in the map", ", ".join(told))
        return replace(product, planes=planes)

    def _with_values(self, product: MapProduct, values: Floats, stream: str) -> MapProduct:
        """The product of a signal with these values, (n_stokes, n_pixels), and its weights as a
        template where it is without noise.
        """
        rows = self._rows(product, self._determined(values, self.system.equations, product))
        made = product.with_planes(signal=rows)
        made = replace(made, noise_from=self.parameters.noise_from, taken_off=self._taken)
        runs, signal = self.data.provenance.get("runs", {}), stream.partition("/")[2]
        if signal not in runs or not Signal(**runs[signal]).is_source:
            return made
        t = np.zeros((len(rows), self.grid.n_pixels))
        t[:, self._seen] = np.nan_to_num(rows).reshape(len(rows), -1)
        return made.with_planes(template=self._rows(product, self._as_template(t, product)))

    def _as_template(self, t: Floats, product: MapProduct) -> Floats:
        """A t of a map (n_stokes, n_pixels), less what belongs to the patterns P that are taken
        off:

            A' t,   A' = A - A P (P^T A P)^-1 P^T A,                                            (1)

        the weights of t beside unknown amplitudes of P. A' P = 0.
        """
        weights = self._apply(t)
        for one, product_of in zip(*self._weighed_patterns(t.shape, product), strict=True):
            weights -= float((one * weights).sum()) * product_of
        return weights

    def _weighed_patterns(
        self, shape: tuple[int, ...], product: MapProduct
    ) -> tuple[Floats, list[Floats]]:
        """Patterns P that are taken off, with P^T A P = 1, and A P; the same for all signals."""
        if self.band in self.system.weighed:
            return self.system.weighed[self.band]
        patterns = np.zeros((len(self._patterns), *shape))
        patterns[:, 0, self._seen] = np.where(
            product.known.ravel(), self._patterns[:, self._seen], 0
        )
        white = self.system.equations.weights[0][self._own]
        products = [self._apply(one) for one in patterns]
        for k, one in enumerate(patterns):
            for other, product_of in zip(patterns[:k], products[:k], strict=True):
                share = float((one * product_of).sum())
                one -= share * other
                products[k] = products[k] - share * product_of
            size = float((one * products[k]).sum())
            least = UNDETERMINED * float((white * one[0] ** 2).sum())
            unit = 1 / np.sqrt(size) if size > least else 0.0
            one *= unit
            products[k] = products[k] * unit
        self.system.weighed[self.band] = patterns, products
        return patterns, products

    def _apply(self, m: Floats) -> Floats:
        """A m of a map (n_stokes, n_pixels), A the information of this band's map beside those of
        other bands, which are unknown.
        """
        equations = self.system.equations
        whole = np.zeros((len(m), equations.n_pixels))
        whole[:, self._own] = m
        tell = self.system.progress("weights of templates", TEMPLATE)
        return equations.apply(whole, self._own, TEMPLATE, tell)[:, self._own]

    def _half(self, stream: str, half: int, product: MapProduct) -> tuple[Floats, Floats]:
        """The map of the even or odd scans, and its inverse weights (n_stokes, n_pixels)."""
        equations = self.system.equations_of_halves[half]
        values = self.system.solved(stream, half).values[:, self._own]
        return self._determined(values, equations, product), equations.spread[:, self._own]

    @property
    def _seen(self) -> Any:
        """Places of the pixels that the product has."""
        return self.grid.seen(self.sums.hits.any(axis=0))

    @property
    def _taken(self) -> str:
        """`taken_off`, as products state it."""
        return self.parameters.taken_off.removeprefix("none")

    @cached_property
    def _patterns(self) -> Floats:
        """(k, n_pixels) patterns that are taken off I."""
        made, taken = [], self.parameters.taken_off
        if taken != "none":
            made.append(np.ones(self.grid.n_pixels))
        if taken == "plane":
            rows, columns = np.indices(self.grid.shape)
            made += [rows.ravel() - rows.mean(), columns.ravel() - columns.mean()]
        return np.array(made).reshape(-1, self.grid.n_pixels)

    def _determined(
        self,
        values: Floats,
        equations: NormalEquations,
        product: MapProduct,
    ) -> Floats:
        """A map without what the data hardly determine, as fitted to pixels with values."""
        values, weight = values.copy(), np.zeros(self.grid.n_pixels)
        white = equations.weights[0][self._own][self._seen].reshape(product.hits.shape)
        weight[self._seen] = np.where(product.known, white, 0.0).ravel()
        patterns = self._patterns
        if not len(patterns):
            return values
        basis = patterns * np.sqrt(weight)
        matrix = np.einsum("ip,jp->ij", basis, basis)
        right = np.einsum("ip,p->i", basis, values[0] * np.sqrt(weight))
        values[0] -= np.einsum("i,ip->p", np.linalg.lstsq(matrix, right)[0], patterns)
        return values

    def _rows(self, product: MapProduct, values: Floats) -> Floats:
        """Rows in the shape of the map, NaN where there is no value."""
        shaped = values[:, self._seen].reshape(len(values), *product.hits.shape)
        return np.where(product.known, shaped, np.nan)

    def _tell(self, solution: Solution, chi2: Sequence[float]) -> None:
        """Log how the solution was found."""
        log, label, step = self.data.log, self.parameters.label, self.parameters
        log.state(label, "iterations", str(len(solution.history)))
        if solution.history:
            least = min(solution.history)
            log.state(label, "residual over right side", f"{least:.1e}")
            where = "" if step.patterns or solution.ritz[0] > POOR else "; patterns: 3 shows where"
            log.state(label, "smallest Ritz value", f"{solution.ritz[0]:.1e}{where}")
            if solution.smooth:
                found = f"{len(solution.smooth.rows)}, after {solution.before} iterations"
                log.state(label, "smooth patterns of the preconditioner", found)
            log.state(label, "chi^2 per sample", f"{chi2[0]:.5g} +- {chi2[1]:.1g}")
            if least >= step.tolerance:
                warnings.warn(
                    f"{label}: after {len(solution.history)} iterations the residual is"
                    f" {least:.1e} of the right side, not {step.tolerance:g}",
                    stacklevel=4,
                )
        if step.taken_off != "none":
            log.state(label, "taken off the map of I", f"its weighted {step.taken_off}")
        log.state(label, "noise of a pixel", "white noise alone, of the noise model")
