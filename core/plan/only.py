"""`--only sky`: a pipeline whose main run keeps some components alone, as a companion run with ``only:`` would."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from ..configuration.diagnostics import nearest
from ..configuration.pipeline_file import PipelineFile, Step
from ..errors import ZondaError
from ..run.companion import Companion
from .figures import kelvin
from .summary import same_labels

if TYPE_CHECKING:
    from .estimate import Traits

FROM_OUTSIDE = frozenset({"sky"})
"""Streams whose level follows from no other step."""


def only(file: PipelineFile, components: Sequence[str]) -> PipelineFile:
    """The file without the steps that make other components than these; the same random numbers.

    The bits are those of the companion run with ``only``, unless the level of what is kept follows from a step that is left out
    (noise under the load of the atmosphere, pink noise that refers to the white noise): a warning states both levels. Companion
    runs go on with what is left of their components; one that has nothing left, or everything, is left out.

    Raises
    ------
    ZondaError
        Where no step provides a component, or a step asks for singular modes of the complete data.
    """
    pipeline = file.pipeline()
    makers = pipeline.selection.generators()
    provided = sorted(set().union(*(o.provides for o in makers)))
    for name in components:
        if name not in provided:
            cure = nearest(name, provided) or f"choose from: {', '.join(provided)}"
            raise ZondaError(f"no step of this pipeline makes {name!r}", place="--only", cure=cure)
    alone = Companion(only=list(components))
    dropped = {o.label for o in makers if not alone.keeps(o.provides)}
    left = [o for o in makers if o.label not in dropped]
    for operator in pipeline.operators:
        if dropped and any(run.modes == "full" for run in operator.needs()):
            left_over = " and ".join(components)
            raise ZondaError(
                f"{operator.label} asks for singular modes of the complete data, of which {left_over} alone is left",
                place="--only",
                cure=f"set modes to sky (--set {operator.label}.modes=sky), or leave --only out",
            )
    runs = {}
    for name, run in file.runs.items():
        kept = [o for o in left if run.keeps(o.provides)]
        if kept and (len(kept) < len(left) or run.filters == "none"):
            names = sorted(set().union(*(o.provides for o in kept)))
            runs[name] = Companion(only=names, modes=run.modes, filters=run.filters)
    labelled = list(zip((o.label for o in pipeline.operators), file.steps, strict=True))
    steps: list[Step] = [step for label, step in labelled if label not in dropped]
    labels = [label for label, _ in labelled if label not in dropped]
    header = file.header.model_copy(update={"runs": runs})
    alone_file = dataclasses.replace(file, header=header, steps=tuple(same_labels(steps, labels)))
    if dropped and not frozenset().union(*(o.provides for o in left)) <= FROM_OUTSIDE:
        _warn_of_levels(file, alone_file, [o.label for o in left], components)
    return alone_file


def _warn_of_levels(whole: PipelineFile, alone: PipelineFile, labels: Sequence[str], components: Sequence[str]) -> None:
    """Say which of the steps ``labels`` make their component at another level alone than in the whole scene."""
    there, here = _traits(whole), _traits(alone)
    for label in labels:
        before, after = (math.hypot(t[label].loudest, t[label].rms) for t in (there, here))
        if not math.isclose(before, after, rel_tol=1e-9):
            name = "_".join(components)
            warnings.warn(
                f"--only: {label} makes {kelvin(after)} per sample alone, {kelvin(before)} in the whole scene: its level follows "
                f"from steps that are left out. For the level of the scene leave --only out and write "
                f"runs: {{{name}_alone: {{only: [{', '.join(components)}], modes: full}}}}",
                stacklevel=3,
            )


def _traits(file: PipelineFile) -> Mapping[str, Traits]:
    """What the planner knows of each step, by label."""
    from .look import look
    from .structure import Structure

    pipeline = file.pipeline()
    every = Structure(tuple(o.label for o in pipeline.operators), tuple(pipeline.runs), ())
    return look(pipeline, file.scene(), every).traits
