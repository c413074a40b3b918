"""`--drop OPERATOR`: the error of omitting an operator altogether, with all that its absence
changes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from ..configuration.pipeline_file import PipelineFile
from ..errors import ZondaError
from .context import OTHER_MODES, Context
from .estimate import Bound, Choice, Effect, Estimate, add, full
from .look import look
from .planning import planning_of
from .structure import Structure

NAME = "everything"
"""Name of the effect."""


def without(
    file: PipelineFile, structure: Structure, dropped: Sequence[str], band: str = ""
) -> Context:
    """The context of the bounds without these operators (labels), of one ``band`` where the camera
    has several.

    Raises
    ------
    ZondaError
        Where the others cannot run without one.
    """
    pipeline = file.pipeline()
    names = {o.label: o.provides for o in pipeline.operators}
    for label in dropped:
        others = [
            o
            for o in pipeline.operators
            if o.label in structure.operators and o.label not in dropped
        ]
        made = frozenset().union(*(o.provides for o in others if not o.requires & o.provides))
        for o in others:
            if missing := (o.requires & names[label]) - made:
                what = " and ".join(sorted(missing))
                raise ZondaError(
                    f"{label!r} cannot be dropped: {o.label} reads its {what}, which no other step"
                    " makes",
                    place="zonda plan",
                    cure="remove this --drop, or drop both",
                )
    kept = tuple(label for label in structure.operators if label not in dropped)
    return look(pipeline, file.scene(), dataclasses.replace(structure, operators=kept), band)


def everything_of(
    label: str, estimates: Mapping[str, Estimate], context: Context, left: Context
) -> Effect:
    """All effects of an operator as one, that is there or not: what they contribute, and what other
    operators (noise whose level depends on the load) make at another level without it. ``left``:
    without the operator."""
    bound = _contributes(label, estimates[label], context)
    for other in left.operators:
        before, after = context.traits[other.label], left.traits[other.label]
        if (before.loudest, before.noise, before.rms) != (after.loudest, after.noise, after.rms):
            # two levels differ by less than the larger of them
            there, here = estimates[other.label], planning_of(other).estimate(left)
            one, two = (
                _contributes(other.label, e, c) for e, c in ((there, context), (here, left))
            )
            bound = add(bound, {m: max(one.get(m, 0.0), two.get(m, 0.0)) for m in {*one, *two}})
    text = "sum of what its effects contribute, and of what others make at another level without it"
    if any(t.turns for other, t in context.traits.items() if other != label):
        bound = add(bound, context.other_modes(label))
        text += OTHER_MODES
    return Effect(
        NAME,
        (full("in full"), Choice("dropped", "left out", leave_out=True, bound=bound, formula=text)),
        bound,
        text,
    )


def _contributes(label: str, estimate: Estimate, context: Context) -> Bound:
    traits = context.traits[label]
    if estimate.without is not None:
        bound: Bound = estimate.without
    elif traits.peak is not None:
        bound = {"tod": traits.peak, "map_rms": traits.peak, "psd": 1.0, **context.sky_error(1.0)}
    else:
        bound = add(*(e.size for e in estimate.effects if e.choices[0].decision != "not simulated"))
    return (
        add(bound, {**context.bound(traits.loudest), "psd": 1.0}) if traits.loudest > 0 else bound
    )
