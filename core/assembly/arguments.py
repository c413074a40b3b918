"""Checks of the arguments of `Pipeline` and `Pipeline.run`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

from ..configuration.diagnostics import nearest
from ..errors import PipelineError
from ..operator import Operator, fault_of_step
from ..scene import Scene
from ..signal import Signal, needed_name

PRECISIONS = ("float32", "float64")


def steps(operators: Any, name: str) -> list[Operator]:
    """Copies of the operators, whose labels are the pipeline's own. Raises PipelineError for what
    is none.
    """
    if isinstance(operators, Operator | str | Mapping) or not isinstance(operators, Iterable):
        cure = "write Pipeline([zonda.Name(...), ...]): a list of operators"
        raise PipelineError(
            f"the steps are a list of operators, not {_what(operators)}",
            place=name,
            cure=cure,
        )
    made = []
    wrong = []
    cures = []
    for k, operator in enumerate(operators, 1):
        if isinstance(operator, Operator):
            made.append(operator.model_copy())
            continue
        wrong.append(f"step {k} is {_what(operator)}, not an operator")
        cures.append(_cure(operator, k))
    if wrong:
        raise PipelineError("; ".join(wrong), place=name, cure="\n".join(dict.fromkeys(cures)))
    faults = [
        (k, operator, found)
        for k, operator in enumerate(made, 1)
        if (found := fault_of_step(operator, Operator))
    ]
    if faults:
        text = "\n".join(
            f"step {k}, {type(operator).__name__}: {fault}" for k, operator, (fault, _) in faults
        )
        raise PipelineError(
            text,
            place=name,
            cure="\n".join(dict.fromkeys(cure for *_, (_, cure) in faults)),
        )
    return made


def runs(given: Any, name: str) -> dict[str, Signal]:
    """The signals by name. Raises PipelineError for what is not a mapping of them."""
    cure = "write runs={'noiseless': {'only': ['sky']}, 'source_free': {'without': ['sky']}}"
    if given is not None and not isinstance(given, Mapping):
        raise PipelineError(
            f"runs is a dict of signals by their names, not {_what(given)}",
            place=name,
            cure=cure,
        )
    made = {}
    for key, value in (given or {}).items():
        if not isinstance(value, Signal | Mapping):
            raise PipelineError(
                f"signal {key} is a dict, not {_what(value)}",
                place=name,
                cure=cure,
            )
        if isinstance(value, Signal) and key == needed_name(value):
            continue  # of `Pipeline.runs`: its output asks for it again
        made[str(key)] = value if isinstance(value, Signal) else Signal(**value)
    return made


def components(only: Any, name: str) -> Sequence[str]:
    """``only``, a list of names. Raises PipelineError."""
    if (
        isinstance(only, str)
        or not isinstance(only, Sequence)
        or not all(isinstance(what, str) for what in only)
    ):
        cure = f"write only=[{only!r}]" if isinstance(only, str) else "write only=['sky']"
        raise PipelineError(
            f"only is a list of components, not {_what(only)}",
            place=name,
            cure=cure,
        )
    return only


def precision(given: Any, name: str) -> Any:
    """``given``, one of `PRECISIONS`. Raises PipelineError."""
    if given not in PRECISIONS:
        cure = nearest(given, PRECISIONS) or f"write {' or '.join(map(repr, PRECISIONS))}"
        raise PipelineError(
            f"precision is 'float32' or 'float64', not {given!r:.60}",
            place=name,
            cure=cure,
        )
    return given


def check_run(
    scene: Any,
    output: Any,
    numbers: Mapping[str, Any],
    keep: Any,
    name: str,
) -> tuple[int | None, int | None, int | None]:
    """The threads, the memory and the ceiling of a run as whole numbers, None where they are
    absent. Raises PipelineError.
    """
    if not isinstance(scene, Scene):
        cure = (
            "write run(zonda.Scene(site=..., instrument=..., time=..., target=...)); a pipeline"
            " file has one: file.scene()"
        )
        raise PipelineError(
            f"a pipeline runs on a Scene, not on {_what(scene)}",
            place=name,
            cure=cure,
        )
    if output is not None and not isinstance(output, str | os.PathLike):
        raise PipelineError(
            f"output is the path of a folder, not {_what(output)}",
            place=name,
            cure="write output='out'",
        )
    if (
        isinstance(keep, str)
        or not isinstance(keep, Sequence)
        or not all(isinstance(k, str) for k in keep)
    ):
        cure = f"write keep=[{keep!r}]" if isinstance(keep, str) else "write keep=['signal']"
        raise PipelineError(f"keep is a list of streams, not {_what(keep)}", place=name, cure=cure)
    threads, memory, ceiling = (
        _whole(what, numbers[what], name) for what in ("threads", "memory", "ceiling")
    )
    return threads, memory, ceiling


def _whole(what: str, value: Any, name: str) -> int | None:
    if value is None:
        return None
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else 0.0
    if 1 <= number < 2**63 and (what != "threads" or number.is_integer()):
        return int(number)
    wanted, example = (
        ("a number of threads, 1 or more", "2")
        if what == "threads"
        else ("a number of bytes", "4e9")
    )
    raise PipelineError(
        f"{what} is {wanted}, not {value!r:.60}",
        place=name,
        cure=f"write {what}={example}, or leave it out",
    )


def _what(value: Any) -> str:
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if callable(value) and hasattr(value, "__name__"):
        return (
            f"the function {value.__name__}"
            if value.__name__ != "<lambda>"
            else "a function (lambda)"
        )
    if isinstance(value, str | Path):
        return f"the text {str(value)!r:.60}"
    return "None" if value is None else f"{value!r:.40} (of type {type(value).__name__})"


def _cure(value: Any, step: int) -> str:
    if isinstance(value, type) and issubclass(value, Operator):
        return f"make one of the class at step {step}: {value.__name__}(...)"
    name = (
        value
        if isinstance(value, str)
        else next(iter(value), "")
        if isinstance(value, Mapping)
        else ""
    )
    if isinstance(name, str) and name.isidentifier():
        return (
            f"write zonda.{name}(...) at step {step}; zonda.load(file).pipeline() makes the steps"
            " of a file"
        )
    if callable(value) and not isinstance(value, type):
        own = getattr(value, "__name__", "function")
        return (
            f"write zonda.operator({'lambda block: ...' if own == '<lambda>' else own}) at step"
            f" {step}"
        )
    return (
        "an operator is made of a class: zonda.Name(parameter=value); docs/plugins.md shows how to"
        " write your own"
    )
