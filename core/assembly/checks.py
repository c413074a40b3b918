"""Checks of a pipeline before any work: `zonda check` prints what they find, and every run begins
with them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence

from ..data import Data
from ..errors import ZondaError
from ..mapmaker import made_by, makes_products
from ..operator import Operator
from ..output import may_write
from ..pipeline import Pipeline
from ..plausibility import doubts
from ..scene import Scene
from ..signal import is_stream


def run_checks(pipeline: Pipeline, scene: Scene, *, saved: bool = True) -> list[list[str]]:
    """Lines to print that each operator's `check` returns, in the order of the steps.

    Warns where no step writes anything (unless not ``saved``: products are wanted in memory alone).

    Raises `ZondaError` as the checks do: a target that is not up, a scan that is too fast.
    """
    found, refused = looks(pipeline.operators, scene)
    for _, err in refused:
        raise err
    if saved:
        warn_of_nothing_saved(pipeline)
    return found


def warn_of_nothing_saved(pipeline: Pipeline) -> None:
    """Warn where no step writes anything."""
    if not writes(pipeline.operators):
        text = f"{pipeline.name}: no step writes a product, so what is computed is lost"
        warnings.warn(
            f"{text}; add a step that saves or shows it (`zonda plugins` lists the operators)",
            stacklevel=3,
        )


def looks(
    operators: Sequence[Operator | None],
    scene: Scene,
    say: Callable[[str], None] | None = None,
) -> tuple[list[list[str]], list[tuple[int, ZondaError]]]:
    """Lines that each operator's `check` returns, and every error, with the number of its step.

    None stands for a step that could not be made. ``say`` is told each step before it is looked at.
    """
    made = frozenset().union(*(made_by(operator) for operator in operators if operator is not None))
    data = Data(scene=scene, made=made)
    found = list[list[str]]()
    refused: list[tuple[int, ZondaError]] = []
    for text in doubts(scene.instrument):
        warnings.warn(text, stacklevel=3)
    for number, operator in enumerate(operators):
        if operator is None:
            continue
        if say is not None:
            say(operator.label)
        try:
            found.append(operator.check(data))
        except ZondaError as err:
            refused.append((number, err))
    return found, refused


def writes(operators: Iterable[Operator]) -> bool:
    """Tell whether any step may leave a file: one that is neither pointing nor a stream, nor keeps
    its products in memory.
    """
    return any(
        may_write(o)
        or (
            o.provides
            and not (
                makes_products(o) or "boresight" in o.provides or all(map(is_stream, o.provides))
            )
        )
        for o in operators
    )
