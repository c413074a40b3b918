"""`--only sky`: a pipeline whose main run keeps some components alone, as a companion run with ``only:`` would."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from ..configuration.diagnostics import nearest
from ..configuration.pipeline_file import PipelineFile, Step
from ..errors import ZondaError
from ..run.companion import Companion
from .outcome import same_labels


def only(file: PipelineFile, components: Sequence[str]) -> PipelineFile:
    """The file without the steps that make other components than these; the same random numbers, so the same bits.

    Companion runs go on with what is left of their components; one that has nothing left, or everything, is left out.

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
    return dataclasses.replace(file, header=header, steps=tuple(same_labels(steps, labels)))
