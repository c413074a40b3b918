"""Scans of a pipeline for its plan: pointed, counted, with the noise of the steps and the coverage
of the map.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..assembly.signals import note_signals
from ..data import Data, Observation
from ..mapmaker import made_by
from ..numerics.projection import boresights, rotation_matrices
from ..operator import Operator
from ..output import Output
from ..pipeline import Pipeline, of_one_band, points
from ..scene import Scene
from ..signal import MAIN, is_stream
from ..types import Floats, Indices, Integers
from .bounds import Context, Coverage, Depth, evenly
from .planning import planning_of
from .structure import Structure, chain_of

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
    data = Data(scene=scene)
    total = 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the run warns
        for operator in pipeline.operators:
            if "boresight" not in operator.provides:
                continue
            before = data.n_scans
            first = len(data.observations)
            operator.check(data)
            if len(data.observations) == first:
                operator.observe(data)
            looked = [o.n_detectors * o.sampling[0] for o in data.observations[first:]]
            total += (data.n_scans - before) * sum(looked) / max(len(looked), 1)
    return round(total)


def observed(
    operators: Sequence[Operator],
    scene: Scene,
    band: str = "",
    **run: Any,
) -> Data:
    """Observations of the operators; of a camera of several bands those of this ``band``, its
    detectors where they are in the whole camera. ``run``: threads and files of the run (`Data`).
    """
    data = Data(scene=scene, **run)
    if band:
        for operator in filter(points, operators):
            operator.observe(data)
        data.split()
        data.hand_out()
        for scan, whole in zip(data.bands[band].observations, data.observations, strict=True):
            scan.log.update(whole.log)
        data = data.bands[band]
        operators = [o for o in operators if of_one_band(o)]
    for operator in operators:
        operator.observe(data)
    return data


def context_of(
    pipeline: Pipeline,
    scene: Scene,
    structure: Structure,
    band: str = "",
    **run: Any,
) -> Context:
    """Point the telescope and gather what the bounds need, of one band where the camera has
    several.

    ``pipeline`` is the planner's own copy.
    """
    operators = [o for o in pipeline.operators if o.label in structure.operators]
    reading = [o for o in operators if planning_of(o).reads_streams]
    readers = frozenset(o.label for o in reading)
    others = [o for o in operators if o.label not in readers and not isinstance(o, Output)]
    data = observed(others, scene, band, **run)
    chain = chain_of(pipeline, structure)
    note_signals(data.observations, chain.components, chain.signals)
    shown = _some(data.observations)
    for observation in shown:
        for operator in operators:
            operator.configure(observation)
    context = Context(
        data.scene,
        data.observations,
        operators,
        readers=readers,
        kept_streams=frozenset().union(*(o.optional | o.requires for o in reading)) - {MAIN},
        band=band,
        chain=chain,
    )
    context.traits = {o.label: planning_of(o).traits(context.lowest) for o in operators}
    context.depth = _depth(shown, context)
    if pixels := [t.pixel for t in context.traits.values() if t.pixel > 0]:
        context.coverage = cover(data.observations, min(pixels))
    context.metrics = _metrics(pipeline, structure, context)
    return context


def _some(observations: Sequence[Observation]) -> list[Observation]:
    """The first, the last, those at the lowest and at the highest elevation, and up to `LOOKED_AT`
    between them.
    """
    low = np.argmin([o.elevation.min() for o in observations])
    high = np.argmax([o.elevation.max() for o in observations])
    return [observations[k] for k in sorted({*evenly(len(observations), LOOKED_AT), low, high})]


def _depth(observations: Sequence[Observation], context: Context) -> Depth:
    """See `Depth`. The quietest detector of all scans is noted in the traits."""
    makers = [o for o in context.operators if context.traits[o.label].noise > 0]
    variances = []
    numbers = []
    quietest = dict.fromkeys((o.label for o in makers), math.inf)
    for observation in observations:
        total = np.zeros(observation.n_detectors)
        for operator in makers:
            found = planning_of(operator).traits(observation)
            total += (found.noise if found.each is None else found.each) ** 2
            quietest[operator.label] = min(quietest[operator.label], found.noise)
        variances.append(total)
        numbers.append(np.where(observation.good_detectors, float(observation.n_samples), 0.0))
    for label, level in quietest.items():
        context.traits[label] = replace(context.traits[label], noise=level)
    variance = np.concatenate(variances)
    number = np.concatenate(numbers)
    used = number > 0
    if not makers or not used.any():
        return Depth(0.0, 0.0)
    sample = weighed = math.sqrt(float(number @ variance / number.sum()))
    if any(t.weighs for t in context.traits.values()) and (variance[used] > 0).all():
        weighed = math.sqrt(float(number.sum() / (number[used] @ (1 / variance[used]))))
    return Depth(sample, weighed)


def _metrics(pipeline: Pipeline, structure: Structure, context: Context) -> frozenset[str]:
    """The errors that matter to the products."""
    found = {"map_rms", "peak"} if context.coverage else {"tod", "psd"}
    made = frozenset[str]().union(*map(made_by, context.operators))
    alone = {name for name in made if is_stream(name)} <= {"sky", MAIN}
    if context.coverage and (
        alone or any(pipeline.runs[r].only == ["sky"] for r in structure.runs)
    ):
        found.add("transfer")
    return frozenset(found | {"tod", "psd"} if context.readers else found)


def speeds(o: Observation, at: Indices) -> Floats:
    """Speed of the boresight on the sky from each of these samples to the next, rad/s."""
    both = np.stack([at, at + 1], axis=1) if o.n_samples > 1 else np.zeros((0, 2), int)
    ends = boresights(o.boresight_radec[both.ravel()]).reshape(3, -1, 2)
    return np.asarray(np.linalg.norm(ends[..., 1] - ends[..., 0], axis=0) * o.sample_rate)


def cover(observations: Sequence[Observation], pixel: float) -> Coverage:
    """Hits per pixel of side ``pixel`` [rad] and scan speed, from a thinned set of instants and
    detectors.
    """
    most = POINTS * DETECTORS
    exact = sum(o.n_samples * o.n_detectors for o in observations) <= most
    instants = max(POINTS // len(observations), 64)
    detectors = DETECTORS
    if exact:
        instants = detectors = most
    centre = rotation_matrices(observations[0].boresight_radec[:1])[0]
    points = []
    seen = []
    for o in observations:
        times = evenly(o.n_samples, instants)
        rows = evenly(o.n_detectors, detectors)
        plane = np.array([-o.focalplane.eta[rows], -o.focalplane.xi[rows], np.ones(len(rows))])
        x, y, z = np.moveaxis(centre.T @ rotation_matrices(o.boresight_radec[times]) @ plane, 1, 0)
        scale = np.maximum(z, 0.1)
        # samples that a detector takes to cross a pixel, at these instants
        passage = np.full(len(times), float(o.n_samples))
        if o.n_samples > 1:
            speed = speeds(o, times[:-1])
            seen.append(speed)
            speed = np.maximum(np.append(speed, speed[-1:]), 1e-12)
            passage = np.clip(o.sample_rate * pixel / speed, 1.0, passage)
        each = o.n_samples * o.n_detectors / (len(times) * len(rows))
        looked = 1 / np.maximum(passage * len(times) / o.n_samples, 1.0)
        found = (x / scale, y / scale, each, looked[:, None], (each / passage)[:, None])
        points.append(np.stack(np.broadcast_arrays(*found))[:, z > 0.1])
    median = float(np.median(np.concatenate(seen))) if seen else 0.0
    where, counted = np.split(np.concatenate(points, axis=1), [2])
    if exact:
        deep = np.quantile(np.unique(_numbers(where, pixel), return_counts=True)[1], DEEP)
    else:
        deep = np.quantile(_hits(where, pixel, *counted), DEEP)
    return Coverage(max(float(deep), 1.0), pixel, median, exact)


def _numbers(where: Floats, pixel: float) -> Integers:
    """(n,) number of the pixel that each point (2, n) falls in."""
    index = np.floor(where / pixel).astype(np.int64)
    index -= index.min(axis=1, keepdims=True)
    return np.asarray(index[0] * (index[1].max() + 1) + index[1])


def _hits(where: Floats, pixel: float, weight: Floats, looked: Floats, whole: Floats) -> Floats:
    """Samples per pixel that samples fall in, for each cell of a coarse grid with points ``where``
    (2, n).

    ``weight`` (n,): number of samples that a point stands for. ``looked``, ``whole``: number of
    passages through pixels that it counts of those that were looked at, and of all there are.
    Passages fall in u = P (1 - exp(-n / P)) of P pixels if they do so at random: P follows from
    those that were looked at, and then the pixels that all of them fall in. Few passages, each
    through a pixel of its own, do not tell P: it is the whole cell.
    """
    extent = np.ptp(where, axis=1)
    cells = np.clip(np.floor(extent / pixel), 1, CELLS).astype(int)
    side = np.maximum(extent / cells, 1e-15)
    index = ((where - where.min(axis=1, keepdims=True)) / side[:, None]).astype(np.int64)
    index = np.minimum(index, cells[:, None] - 1)
    cell = index[0] * cells[1] + index[1]
    pixels = _numbers(where, pixel)
    _, first = np.unique(cell * (pixels.max() + 1) + pixels, return_index=True)
    u = np.bincount(cell[first]).astype(np.float64)
    seen, every = (np.maximum(np.bincount(cell, n), np.minimum(u, 1.0)) for n in (looked, whole))
    most = max(float(side[0] * side[1]) / pixel**2, 1.0)
    there = np.minimum(u, most)
    for _ in range(50):
        there = np.minimum(u / np.maximum(-np.expm1(-seen / np.maximum(there, 1e-9)), 1e-9), most)
    there = np.where(seen <= 1.02 * u, most, there)
    covered = np.maximum(-there * np.expm1(-every / np.maximum(there, 1e-9)), np.minimum(u, most))
    return np.asarray((np.bincount(cell, weight) / np.maximum(covered, 1.0))[u > 0])
