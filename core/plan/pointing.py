"""Scans of a pipeline for its plan: pointed, counted, with the noise of the steps and the coverage
of the map.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..assembly.signals import note_signals
from ..data import Data, Observation
from ..mapmaker import made_by
from ..numerics.projection import rotation_matrices
from ..operator import Operator
from ..output import Output
from ..pipeline import Pipeline
from ..run.bands import data_of_bands, distribute, of_one_band, points
from ..scene import Scene
from ..signal import is_stream
from ..types import Floats
from .bounds import Context, Coverage, Depth
from .planning import planning_of
from .structure import Structure, work

LOOKED_AT = 4
"""Observations whose levels of noise are looked at, apart from those at the extremes of elevation.
"""

DEEP = 0.9
"""Quantile of the hits over the covered map: its deeper part has the least noise, so what holds
there holds everywhere.
"""

CELLS, POINTS, DETECTORS = 32, 8192, 96
"""Hits are counted on CELLS x CELLS cells from at most about POINTS instants of all scans and
DETECTORS detectors of each; in pixels where no more samples than that are taken."""


def samples_of(pipeline: Pipeline, scene: Scene) -> int:
    """Detectors x samples x bands of a scene, without pointing all of it: the scans that
    `Operator.check` looks at stand for the others.
    """
    data, total = Data(scene=scene), 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the run warns
        for operator in pipeline.operators:
            if "boresight" not in operator.provides:
                continue
            before, first = data.n_scans, len(data.observations)
            operator.check(data)
            if len(data.observations) == first:
                operator.observe(data)
            looked = [o.n_detectors * o.sampling[0] for o in data.observations[first:]]
            total += (data.n_scans - before) * sum(looked) / max(len(looked), 1)
    return round(total)


def observed(operators: Sequence[Operator], scene: Scene, band: str = "") -> Data:
    """Observations of the operators; of a camera of several bands those of this ``band``, its
    detectors where they are in the whole camera.
    """
    data = Data(scene=scene)
    if band:
        for operator in filter(points, operators):
            operator.observe(data)
        bands = data_of_bands(data)
        distribute(data, [*bands.values()])
        for scan, whole in zip(bands[band].observations, data.observations, strict=True):
            scan.tally.update(whole.tally)
        data, operators = bands[band], [o for o in operators if of_one_band(o)]
    for operator in operators:
        operator.observe(data)
    return data


def context_of(pipeline: Pipeline, scene: Scene, structure: Structure, band: str = "") -> Context:
    """Point the telescope and gather what the bounds need, of one band where the camera has
    several.

    ``pipeline`` is the planner's own copy.
    """
    operators = [o for o in pipeline.operators if o.label in structure.operators]
    readers = frozenset(o.label for o in operators if planning_of(o).reads_streams)
    data = observed(
        [o for o in operators if o.label not in readers and not isinstance(o, Output)], scene, band
    )
    acting = work(pipeline, structure)
    note_signals(data.observations, acting.components, acting.signals)
    shown = _some(data.observations)
    for observation in shown:
        for operator in operators:
            operator.configure(observation)
    streams = frozenset().union(
        *((o.optional | o.requires) - {"signal"} for o in operators if o.label in readers)
    )
    context = Context(
        data.scene,
        data.observations,
        operators,
        acting,
        readers=readers,
        kept_streams=streams,
        band=band,
        bands_alike=scene.instrument.focalplane().bands_alike if band else 1,
    )
    context.traits = {o.label: planning_of(o).traits(context.lowest) for o in operators}
    context.depth = _depth(operators, shown, context)
    pixels = [t.pixel for t in context.traits.values() if t.pixel > 0]
    if pixels:
        context.coverage = cover(data.observations, min(pixels))
    context.metrics = _metrics(pipeline, structure, context)
    return context


def _some(observations: Sequence[Observation]) -> list[Observation]:
    """The first, the last, those at the lowest and at the highest elevation, and up to `LOOKED_AT`
    between them.
    """
    evenly = np.linspace(0, len(observations) - 1, min(LOOKED_AT, len(observations))).astype(int)
    low = min(range(len(observations)), key=lambda k: float(observations[k].elevation.min()))
    high = max(range(len(observations)), key=lambda k: float(observations[k].elevation.max()))
    return [observations[k] for k in sorted({*evenly.tolist(), low, high})]


def _depth(
    operators: Sequence[Operator], observations: Sequence[Observation], context: Context
) -> Depth:
    """See `Depth`. The quietest detector of all scans is noted in the traits."""
    makers = [o for o in operators if context.traits[o.label].noise > 0]
    if not makers:
        return Depth(0.0, 0.0)
    variances, numbers = [], []
    quietest = dict.fromkeys((o.label for o in makers), math.inf)
    for observation in observations:
        total = np.zeros(observation.n_detectors)
        for operator in makers:
            found = planning_of(operator).traits(observation)
            total += found.noise**2 if found.each is None else found.each**2
            quietest[operator.label] = min(quietest[operator.label], found.noise)
        variances.append(total)
        numbers.append(np.where(observation.good_detectors, float(observation.n_samples), 0.0))
    for label, level in quietest.items():
        context.traits[label] = replace(context.traits[label], noise=level)
    variance, number = np.concatenate(variances), np.concatenate(numbers)
    if not number.any():
        return Depth(0.0, 0.0)
    sample = math.sqrt(float(number @ variance / number.sum()))
    used = number > 0
    weighs = any(t.weighs for t in context.traits.values()) and bool((variance[used] > 0).all())
    weighed = (
        math.sqrt(float(number.sum() / (number[used] @ (1 / variance[used])))) if weighs else sample
    )
    return Depth(sample, weighed)


def _metrics(pipeline: Pipeline, structure: Structure, context: Context) -> frozenset[str]:
    found = set()
    if context.coverage is not None:
        found |= {"map_rms", "peak"}
        made = {name for o in context.operators for name in made_by(o) if is_stream(name)}
        if made <= {"sky", "signal"} or any(
            pipeline.runs[r].only == ["sky"] for r in structure.runs
        ):
            found.add("transfer")
    if context.readers or context.coverage is None:
        found |= {"tod", "psd"}
    return frozenset(found)


def cover(observations: Sequence[Observation], pixel: float) -> Coverage:
    """Hits per pixel of side ``pixel`` [rad] and scan speed, from a thinned set of instants and
    detectors.
    """
    points: list[Floats] = []
    weights: list[Floats] = []
    speeds: list[Floats] = []
    passed: list[Floats] = []
    centre = rotation_matrices(observations[0].boresight_radec[:1])[0]
    number, most = max(POINTS // len(observations), 64), DETECTORS
    if exact := sum(o.n_samples * o.n_detectors for o in observations) <= POINTS * DETECTORS:
        number, most = (
            max(sizes)
            for sizes in zip(*((o.n_samples, o.n_detectors) for o in observations), strict=True)
        )
    for o in observations:
        times = np.unique(np.linspace(0, o.n_samples - 1, min(number, o.n_samples)).astype(int))
        rows = np.unique(np.linspace(0, o.n_detectors - 1, min(most, o.n_detectors)).astype(int))
        turn = centre.T @ rotation_matrices(o.boresight_radec[times])
        plane = np.array([-o.focalplane.eta[rows], -o.focalplane.xi[rows], np.ones(len(rows))])
        looking = turn @ plane  # (time, 3, detector)
        front = looking[:, 2] > 0.1
        points.append(
            np.array(
                [
                    looking[:, 0][front] / looking[:, 2][front],
                    looking[:, 1][front] / looking[:, 2][front],
                ]
            )
        )
        weights.append(
            np.full(points[-1].shape[1], o.n_samples * o.n_detectors / (len(times) * len(rows)))
        )
        passage = np.full(
            len(times), float(o.n_samples)
        )  # samples that a detector takes to cross a pixel, at these instants
        if o.n_samples > 1:
            at = times[:-1]
            ends = rotation_matrices(o.boresight_radec[np.stack([at, at + 1], 1).ravel()])[
                :, :, 2
            ].reshape(-1, 2, 3)
            speeds.append(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) * o.sample_rate)
            crossing = (
                o.sample_rate * pixel / np.maximum(np.append(speeds[-1], speeds[-1][-1:]), 1e-12)
            )
            passage = np.clip(crossing, 1.0, passage)
        looked = np.maximum(passage * len(times) / o.n_samples, 1.0)
        share = np.stack(
            [1 / looked, o.n_samples * o.n_detectors / (len(times) * len(rows)) / passage]
        )
        passed.append(np.broadcast_to(share[:, :, None], (2, len(times), len(rows)))[:, front])
    where, weight = np.concatenate(points, axis=1), np.concatenate(weights)
    speed = float(np.median(np.concatenate(speeds))) if speeds else 0.0
    if exact:
        index = np.floor(where / pixel).astype(np.int64)
        index -= index.min(axis=1, keepdims=True)
        _, each = np.unique(index[0] * (index[1].max() + 1) + index[1], return_counts=True)
        return Coverage(max(float(np.quantile(each, DEEP)), 1.0), pixel, speed, exact)
    reach = np.maximum(np.ptp(where, axis=1), pixel)
    cells = np.maximum(1, np.minimum(CELLS, np.floor(reach / pixel))).astype(int)
    low = where.min(axis=1)
    side = np.maximum(np.ptp(where, axis=1) / cells, 1e-15)
    column, row = (
        np.minimum(((where[k] - low[k]) / side[k]).astype(np.int64), cells[k] - 1) for k in (0, 1)
    )
    cell = column * cells[1] + row
    covered = _covered(
        where,
        cell,
        pixel,
        max(float(side[0] * side[1]) / pixel**2, 1.0),
        np.concatenate(passed, axis=1),
    )
    counts = np.bincount(cell, weight, len(covered))
    hits = counts[covered > 0] / covered[covered > 0]
    return Coverage(max(float(np.quantile(hits, DEEP)), 1.0), pixel, speed)


def _covered(
    where: Floats, cell: NDArray[np.int64], pixel: float, most: float, passages: Floats
) -> Floats:
    """Pixels in each cell that samples fall in, of ``most`` in it, from some points ``where`` (2,
    n) that fall in u of them.

    ``passages`` (2, n): what each point counts of the passages through pixels that were looked at,
    and of all there are. Passages fall in u = P (1 - exp(-n / P)) of P pixels if they do so at
    random: P follows from those that were looked at, and then the pixels that all of them fall in.
    Few passages, each through a pixel of its own, do not tell P: it is the whole cell.
    """
    number = int(cell.max()) + 1
    index = np.floor(where / pixel).astype(np.int64)
    index -= index.min(axis=1, keepdims=True)
    one = (cell * (index[0].max() + 1) + index[0]) * (index[1].max() + 1) + index[1]
    _, first = np.unique(one, return_index=True)
    u = np.bincount(cell[first], minlength=number).astype(np.float64)
    looked, whole = (
        np.maximum(np.bincount(cell, some, number), np.minimum(u, 1.0)) for some in passages
    )
    pixels = np.minimum(u, most)
    for _ in range(50):
        pixels = np.minimum(
            u / np.maximum(-np.expm1(-looked / np.maximum(pixels, 1e-9)), 1e-9), most
        )
    pixels = np.where(looked <= 1.02 * u, most, pixels)
    covered = np.maximum(-pixels * np.expm1(-whole / np.maximum(pixels, 1e-9)), np.minimum(u, most))
    return np.asarray(np.where(u > 0, np.maximum(covered, 1.0), 0.0), np.float64)
