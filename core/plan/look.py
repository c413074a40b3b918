"""What planning looks at before it decides: the pointed scans, the noise of the steps, the coverage
of the map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..data import Data, Observation
from ..mapmaker import made_by
from ..operator import Operator
from ..output import Output
from ..pipeline import Pipeline
from ..run.bands import data_of_bands, distribute, of_one_band, points
from ..run.signals import note_signals
from ..scene import Scene
from ..signal import is_stream
from .context import Context, Depth
from .coverage import cover
from .planning import planning_of
from .structure import Structure, work

LOOKED_AT = 4
"""Observations whose levels of noise are looked at, apart from those at the extremes of elevation.
"""


def observed(operators: Sequence[Operator], scene: Scene, band: str = "") -> Data:
    """What operators observe; of a camera of several bands this ``band``, its detectors where they
    are in the whole camera.
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


def look(pipeline: Pipeline, scene: Scene, structure: Structure, band: str = "") -> Context:
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
