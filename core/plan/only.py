"""`--only sky`: a pipeline whose complete signal is narrowed to some components."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from ..configuration.diagnostics import nearest
from ..configuration.loaded import PipelineFile
from ..errors import ZondaError
from ..output import Output
from ..run.signals import Signals


def only(file: PipelineFile, components: Sequence[str]) -> PipelineFile:
    """The file with its complete signal narrowed to some components: the same levels, flags and
    random numbers.

    The bits are those of the signal with this ``only``. Other signals go on with what is left of
    their components; one that has nothing left, or everything, is left out.

    Raises
    ------
    ZondaError
        Where no step provides a component, or a step asks for singular modes of the complete data.
    """
    pipeline = file.pipeline()
    provided = sorted(pipeline.signals.components)
    for name in components:
        if name not in provided:
            cure = nearest(name, provided) or f"choose from: {', '.join(provided)}"
            raise ZondaError(f"no step of this pipeline makes {name!r}", place="--only", cure=cure)
    narrowed = Signals(pipeline.operators, {}, components, file.header.name).makers(
        ""
    ) < pipeline.signals.makers("")
    for operator in pipeline.operators:
        if (
            narrowed
            and isinstance(operator, Output)
            and any(signal.modes == "full" for signal in operator.signals())
        ):
            left = " and ".join(components)
            raise ZondaError(
                f"{operator.label} asks for singular modes of the complete data, of which {left}"
                " alone is left",
                place="--only",
                cure=f"set modes to sky (--set {operator.label}.modes=sky), or leave --only out",
            )
    return dataclasses.replace(
        file, header=file.header.model_copy(update={"only": list(components)})
    )
