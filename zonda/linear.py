"""Exact linear operators on the streams and maps of a run, as `scipy.sparse.linalg.LinearOperator`:
for solvers, deconvolution and statistics of your own (docs/linear.md).

    d = P m + n     `pointing`: a map seen by the samples                                    (1)
    y = F d         `filters`: zonda's filters, with the modes of singular filters fixed     (2)
    m = (P^T W P)^-1 P^T W d    `binning`: the map of `BinMap`                               (3)
    P^T Q P         `normal`, Q = `noise_weight`: the equations of `MaximumLikelihoodMap`    (4)

A stream is the flat array of (n_det, n_samp) samples of one scan, a map that of (n_stokes,
n_pixels); both are float64, in K_RJ. The adjoint of each operator is exact: <x, A y> = <A^T x, y>
but for rounding. Of a camera with several bands, an observation is that of one band
(``data.bands["f090"].observations[0]``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from zonda.core.assembly import arguments
from zonda.core.block import Block
from zonda.core.data import Data, Observation
from zonda.core.errors import InputError, PipelineError
from zonda.core.log import Log
from zonda.core.mapmaker import filters as filters_signals
from zonda.core.mapmaker import joins
from zonda.core.mapping import map as map_streams
from zonda.core.numerics.chunks import TILE_DETECTORS, chunks
from zonda.core.operator import Operator, labels
from zonda.core.pipeline import Pipeline
from zonda.core.signal import MAIN, stream_of
from zonda.core.stream import Stream
from zonda.core.types import Floats
from zonda.operators.filters.common_mode import CommonModeFilter, Modes
from zonda.operators.maps.baseline_noise import BaselineNoise
from zonda.operators.maps.bin_map import LIGHTEST, BinMap
from zonda.operators.maps.binning import weights_of
from zonda.operators.maps.compressed_scan import CompressedScan
from zonda.operators.maps.grid import Grid
from zonda.operators.maps.likelihood_maps import LikelihoodMaps
from zonda.operators.maps.map_from_sums import TRIANGLE
from zonda.operators.maps.map_layout import MapLayout
from zonda.operators.maps.maximum_likelihood import MaximumLikelihoodMap
from zonda.operators.maps.normal_equations import (
    EXACT,
    NormalEquations,
    WeighedScan,
    inverse_of,
    times,
)
from zonda.operators.maps.pointing_matrix import Pointing

__all__ = [
    "Filters", "Pointing", "binning", "compressed", "filters", "grid", "modes", "noise_weight",
    "normal", "pointing",
]  # fmt: skip

Steps = Pipeline | Sequence[Operator]


def grid(data: Data, maker: BinMap, band: str = "") -> Grid:
    """The pixels of the map that ``maker`` (`BinMap`, `MaximumLikelihoodMap`) makes of the scans of
    a run: ``shape`` (ny, nx) and ``wcs`` of an image, ``pixels_covered`` of a HEALPix map.

    ``band``: of a camera with several.
    """
    layout = MapLayout(maker)
    return layout.grid(layout.place(of_band(data, band, "zonda.linear.grid").observations, {}))


def of_band(data: Data, band: str, place: str) -> Data:
    """The data of a band. Raises InputError for one that there is not, or that is not named."""
    every = data.bands or {"": data}
    if band not in every:
        text = f"there is no band {band!r}" if band else "these data have several bands"
        cure = f"give one of {', '.join(every)}" if data.bands else "leave band out"
        raise InputError(text, place=place, cure=cure)
    return every[band]


def pointing(
    observation: Observation,
    grid: Grid,
    interpolation: Literal["nearest", "bilinear"] = "nearest",
    stokes: Literal["I", "IQU"] = "I",
) -> Pointing:
    """P of equation (1): what the samples of a scan see of a map.

    Parameters
    ----------
    observation
        A scan of a run, ``data.observations[0]``.
    grid
        Pixels, of `grid`.
    interpolation
        A sample sees the pixel that holds it, or the four around it (``bilinear``).
    stokes
        A map of I, or of I, Q and U in their order.

    Returns
    -------
    Pointing
        (n_det n_samp, n_stokes n_pixels). Samples beyond the map, without a signal (flags) or of
        dead detectors see 0, and its transpose does not read them.

    Raises
    ------
    ZondaError
        Where Q and U are asked for of detectors whose angles are not known.
    """
    for name, value, choices in (
        ("interpolation", interpolation, ("nearest", "bilinear")),
        ("stokes", stokes, ("I", "IQU")),
    ):
        if value not in choices:
            text, cure = f"there is no {name} {value!r}", f"choose {' or '.join(choices)}"
            raise InputError(text, place="zonda.linear.pointing", cure=cure)
    return Pointing(observation, grid, interpolation, 3 if stokes == "IQU" else 1)


class Filters(LinearOperator):
    """F of equation (2) for one scan, on streams (n_det, n_samp), flat.

    Attributes
    ----------
    observation
        The scan with the flags and windows that the filters give it: `pointing` takes it where
        filtered streams are mapped.
    models
        By label, what singular filters measured: their modes.
    """

    def __init__(
        self, pipeline: Steps, observation: Observation, models: Mapping[str, Any]
    ) -> None:
        self.observation, self.models = own_copy(observation), models
        given = pipeline.operators if isinstance(pipeline, Pipeline) else pipeline
        steps = [o for o in arguments.steps(given, "zonda.linear") if filters_signals(o)]
        named = [*zip(labels(steps), steps, strict=True)]
        for label, step in named:
            self._refuse_without_adjoint(label, step)
        self.steps = [(label, step, step.prepare(self.observation)) for label, step in named]
        samples = observation.n_detectors * observation.n_samples
        super().__init__(np.float64, (samples, samples))  # type: ignore[call-arg]

    def _matvec(self, d: Floats) -> Floats:
        block = self._block(d)
        for label, step, state in self.steps:
            if step.couples == "all":
                state = self.measured(block, step, state, self.models[label])
            step.exec(block, state)
        return np.asarray(block.detdata[MAIN].ravel(), np.float64)

    def _rmatvec(self, d: Floats) -> Floats:
        block = self._block(d)
        for label, step, state in reversed(self.steps):
            adjoint: Any = step
            adjoint.adjoint(block, self.models.get(label, state))
        return np.asarray(block.detdata[MAIN].ravel(), np.float64)

    def found(self, d: Floats) -> dict[str, Any]:
        """Modes that singular filters find in a stream, by label."""
        block, models = self._block(d), dict[str, Any]()
        for label, step, state in self.steps:
            if step.couples == "all":
                state = models[label] = self.measured(block, step, state)
            step.exec(block, state)
        return models

    def measured(self, block: Block, step: Operator, state: Any, model: Any = None) -> Any:
        """State of a singular filter for a stream, with a given ``model`` or the stream's own."""
        signal = MAIN if model is None else stream_of("linear")
        array = block.detdata[MAIN]
        return step.measure(
            Stream(MAIN, self.observation, array, {}, 1, signal=signal, state=state), model
        )

    def _refuse_without_adjoint(self, label: str, step: Operator) -> None:
        """Refuse a filter without an exact adjoint: its class has no ``adjoint(block, state)``, or
        one of a class whose ``exec`` it overrides; or it joins several bands.
        """
        owner = {
            name: k
            for name in ("exec", "adjoint")
            for k, cls in reversed([*enumerate(type(step).__mro__)])
            if name in vars(cls)
        }
        if owner.get("adjoint", len(type(step).__mro__)) > owner["exec"]:
            raise PipelineError(
                f"{type(step).__name__} has no exact adjoint",
                place=f"zonda.linear.filters, {label}",
                cure="leave it out, or write its method adjoint(block, state) beside exec",
            )
        if joins(step) and self.observation.common is not None:
            raise PipelineError(
                "the modes are those of all bands, and the streams those of one",
                place=f"zonda.linear.filters, {label}",
                cure="set group: band or wafer",
            )

    def _block(self, d: Floats) -> Block:
        """Copy of a whole stream as one block."""
        scan = self.observation
        if np.size(d) != self.shape[0]:
            text = f"a stream of {np.size(d)} samples for {scan.n_detectors} x {scan.n_samples}"
            raise InputError(text, place="zonda.linear", cure="give data.tod() of this scan")
        array = np.array(d, np.float64).reshape(scan.n_detectors, scan.n_samples)
        every = slice(0, scan.n_detectors), slice(0, scan.n_samples)
        return Block(scan, *every, {MAIN: array}, dtype=np.float64)


def own_copy(observation: Observation) -> Observation:
    """The scan with a log, flags and windows of its own."""
    return replace(
        observation,
        log=Log(),
        flags=observation.flags.copy(),
        detector_flags=observation.detector_flags.copy(),
        windows=dict(observation.windows),
    )


def filters(pipeline: Steps, observation: Observation, modes: Any = None) -> Filters:
    """F of equation (2): the filters of a pipeline, one after the other, on the streams of a scan.

    Parameters
    ----------
    pipeline
        A pipeline, of which those steps are taken that change ``signal``; or a list of filters.
    observation
        A scan of a run.
    modes
        Of singular filters (`CommonModeFilter`), which are linear only with modes that are given:
        what `modes` found in a stream, or U (k, n_det), orthonormal, for the only such filter:
        y = d - U^T U d at samples that are not flagged.

    Returns
    -------
    Filters
        (n_det n_samp, n_det n_samp). Samples must be finite.

    Raises
    ------
    ZondaError
        For a step without an exact adjoint, and modes that are missing or have another shape.
    """
    made = Filters(pipeline, observation, {})
    singular = [(label, step) for label, step, _ in made.steps if step.couples == "all"]
    place, missing = "zonda.linear.filters", "give modes=zonda.linear.modes(steps, scan, stream)"
    if isinstance(modes, Mapping):
        made.models = modes
    elif modes is not None:
        array = np.array(modes, np.float64, ndmin=2)
        only = singular[0][1] if len(singular) == 1 else None
        if not isinstance(only, CommonModeFilter) or only.group == "wafer" or only.method == "mean":
            text = "an array of modes serves for one CommonModeFilter alone, with method: svd and"
            raise InputError(f"{text} without group: wafer", place=place, cure=missing)
        if array.ndim != 2 or array.shape[1] != observation.n_detectors:
            text = f"modes of shape {array.shape} for {observation.n_detectors} detectors"
            raise InputError(text, place=place, cure="give U (k, n_det)")
        made.models = {singular[0][0]: Modes(array, np.zeros((len(array), 0)))}
    for label, _ in singular:
        if label not in made.models:
            text = f"{label} is linear only with modes that are given"
            raise InputError(text, place=place, cure=missing)
    return made


def modes(pipeline: Steps, observation: Observation, stream: Floats) -> dict[str, Any]:
    """Find the modes of singular filters in a stream (n_det, n_samp) [K_RJ], by label, as
    `filters` takes them. Filters before them act on the stream as they do in a run. Detectors that
    they find dead have no part in the modes; the scan itself is not flagged.
    """
    return Filters(pipeline, observation, {}).found(stream)


def binning(P: Pointing, weights: Floats | None = None) -> LinearOperator:
    """B = (P^T W P)^-1 P^T W of equation (3): the map of a scan's stream as `BinMap` makes it,
    (n_stokes n_pixels, n_det n_samp); 0 in pixels without samples.

    Flagged samples and detectors have no weight, and are not read. Where samples do not determine
    I, Q and U, the least values that fit are taken. With the windows of a `Taper` the weights are
    those of `BinMap`.

    Parameters
    ----------
    P
        Of `pointing`, nearest pixel.
    weights
        (n_det,) or (n_det, n_samp), 1 / K^2; where absent, the detectors' inverse variances.

    Raises
    ------
    ZondaError
        For a bilinear P, and weights that are negative or of another shape.
    """
    scan, place = P.observation, "zonda.linear.binning"
    shape = scan.n_detectors, scan.n_samples
    if P.interpolation != "nearest":
        cure = "solve (P.T @ W @ P) m = P.T @ W @ d, e.g. with scipy.sparse.linalg.cg"
        raise InputError("a bilinear map is no mean of samples", place=place, cure=cure)
    use, window = scan.good_detectors[:, None] & scan.good_samples, scan.window
    if window is not None:
        use &= window >= LIGHTEST
    if weights is None:
        net = scan.focalplane.net[scan.good_detectors]
        variance = float(np.median(net)) ** 2 * scan.sample_rate if net.size else 0.0
        weights = weights_of(scan, variance or 1.0, True, None, place).detector
    weights = np.asarray(weights, np.float64)
    if weights.shape not in (shape, shape[:1]) or not (weights >= 0).all():
        text = f"weights of shape {weights.shape}, for streams {shape}, or below 0"
        raise InputError(text, place=place, cure="give (n_det,) or (n_det, n_samp) of 0 or more")
    weights = weights.reshape(shape[0], -1)

    def weighed(d: Floats) -> Floats:
        return np.where(use, weights * d.reshape(shape), 0.0).ravel()

    columns = []
    for k in range(P.n_stokes):
        seen = P.matvec(np.repeat(np.arange(P.n_stokes) == k, P.grid.n_pixels))
        if window is not None:
            seen = (seen.reshape(shape) * window).ravel()
        columns.append(P.rmatvec(weighed(seen)).reshape(P.n_stokes, -1))
    places = zip(*TRIANGLE, strict=True) if P.n_stokes == 3 else [(0, 0)]
    inverse = inverse_of(np.stack([columns[i][j] for i, j in places]))

    def solved(m: Floats) -> Floats:
        return times(inverse, m.reshape(P.n_stokes, -1)).ravel()

    return LinearOperator(
        P.shape[::-1],
        matvec=lambda d: solved(P.rmatvec(weighed(d))),
        rmatvec=lambda m: weighed(P.matvec(solved(m))),
        dtype=np.float64,
    )


class _Unsolved(MaximumLikelihoodMap):
    """Equations of maximum-likelihood maps, in place of the maps."""

    def finalize(self, data: Data) -> None:
        (data.products["equations"],) = self.maps([data])


def compressed(
    data: Data, maker: MaximumLikelihoodMap, band: str = ""
) -> tuple[list[CompressedScan], list[BaselineNoise], Floats]:
    """Compressed scans of a run that kept its unfiltered signal, ``keep=["signal"]``; their noise
    as ``maker`` estimates it; and the right side P^T Q d (n_stokes n_pixels,), 1 / K.

    ``maker``: with the parameters of the map. ``band``: of a camera with several. Raises ZondaError
    as `zonda.map` and `MaximumLikelihoodMap` do.
    """
    own = {**dict(maker), "name": maker.label}
    step = _Unsolved.model_construct(maker.model_fields_set, **own)
    of_band(data, band, place := "zonda.linear.compressed")
    if band and joins(step):
        text = "the equations are those of all bands, and the map that of one"
        raise PipelineError(text, place=place, cure="set group: band or wafer")
    found: LikelihoodMaps = map_streams(data, [step])[f"equations_{band}" if band else "equations"]
    made, equations = found.system, found.system.equations
    right = equations.eliminated(made.right_side(equations, MAIN))
    scans, noise = zip(*equations.scans, strict=True)
    return list(scans), list(noise), right.ravel()


def noise_weight(
    scan: CompressedScan, noise: BaselineNoise, observation: Observation | None = None
) -> LinearOperator:
    """Q of equation (4), symmetric: the inverse covariance of a scan's noise. Polynomials, free
    modes and samples that do not count have infinite variance.

    It is of streams of the good detectors, (n_good n_samp)^2; given the ``observation``, of all its
    detectors, of which the others weigh nothing.

    ``scan`` and ``noise`` are those of `compressed`. Raises InputError where the observation is
    another one.
    """
    n_good, n_base = scan.shape
    rows = np.arange(n_good)
    if observation is not None:
        rows = np.flatnonzero(observation.good_detectors)
    n_det = n_good if observation is None else observation.n_detectors
    if rows.size != n_good or (observation and observation.n_samples != scan.n_samples):
        text = f"the scan has {n_good} detectors and {scan.n_samples} samples"
        cure = "give the observation that was compressed"
        raise InputError(text, place="zonda.linear.noise_weight", cure=cure)
    parts = [
        np.repeat(pixel[first[0] : first[-1]], samples[first[0] : first[-1]])
        for _, (first, pixel, samples, *_) in scan.parts()
    ]
    pixel = np.concatenate(parts).reshape(n_good, -1)
    counts, gaps = pixel < scan.width, (pixel >= scan.n_pixels) & (pixel < scan.width)
    starts, a = np.arange(n_base) * scan.length, noise.free_modes
    of = np.repeat(np.arange(n_base), scan.length)[: scan.n_samples]

    def means(x: Floats, some: slice) -> Floats:
        """(n, n_base) of the samples that count."""
        total = np.add.reduceat(np.where(counts[some], x, 0.0), starts, axis=1)
        return np.asarray(total / np.maximum(scan.counted[some], 1))

    def about(x: Floats, some: slice) -> Floats:
        """Samples that count about the means of their baselines; 0 for others."""
        return np.where(counts[some], x - means(x, some)[:, of], 0.0)

    def whole(d: Floats) -> Floats:
        """Q of all samples, gaps too."""
        d, out = d.reshape(n_det, -1), np.zeros((n_det, scan.n_samples))
        y, s = np.empty(scan.shape), np.zeros((len(a), scan.n_samples))
        parts = chunks(n_good, TILE_DETECTORS)
        for some in parts:
            y[some] = means(d[rows[some]], some)
            s += np.einsum("kd,dt->kt", a[:, some], about(d[rows[some]], some))
        slow = noise.weigh(y, scan.counted) / np.maximum(scan.counted, 1)
        for some in parts:
            x = about(d[rows[some]], some) / noise.white[some, None]
            x -= about(np.einsum("kd,kt->dt", a[:, some], s), some)
            out[rows[some]] = x + np.where(counts[some], slow[some][:, of], 0.0)
        return out.ravel()

    size = n_det * scan.n_samples
    every = np.zeros((n_det, scan.n_samples), np.bool_)
    every[rows] = gaps
    lacking = np.flatnonzero(every)
    variance = np.repeat(noise.white, gaps.sum(axis=1))

    def weigh(d: Floats) -> Floats:
        """Q of samples that count: gaps have the values that make the product 0 there."""
        x = np.where(every, 0.0, d.reshape(n_det, -1)).ravel()
        out = whole(x)
        if lacking.size:
            unit = np.zeros(size)

            def of_gaps(values: Floats) -> Floats:
                unit[lacking] = values
                return whole(unit)[lacking]

            shape = (lacking.size, lacking.size)
            left = LinearOperator(shape, matvec=of_gaps, dtype=np.float64)
            inverse = LinearOperator(shape, matvec=lambda r: r.ravel() * variance, dtype=np.float64)
            x[lacking] = cg(left, -out[lacking], rtol=EXACT, M=inverse)[0]
            out = np.where(every.ravel(), 0.0, whole(x))
        return out

    return LinearOperator((size, size), matvec=weigh, rmatvec=weigh, dtype=np.float64)


def normal(
    scans: Sequence[CompressedScan], noise: Sequence[BaselineNoise], threads: int = 1
) -> LinearOperator:
    """P^T Q P of equation (4), symmetric, added up over scans: what `MaximumLikelihoodMap` solves,
    (n_stokes n_pixels)^2, 1 / K^2; at the cost of an iteration. ``scans``, ``noise``: of
    `compressed`. ``threads``: scans that are worked on at a time.
    """
    first = scans[0]
    n_stokes = 3 if first.angles.shape[1] else 1
    weighed = [WeighedScan(*pair) for pair in zip(scans, noise, strict=True)]
    equations = NormalEquations(weighed, n_stokes, first.n_pixels, threads)

    def applied(m: Floats) -> Floats:
        return equations.apply(m.reshape(n_stokes, -1)).ravel()

    size = n_stokes * first.n_pixels
    return LinearOperator((size, size), matvec=applied, rmatvec=applied, dtype=np.float64)
