"""Check that the class of a step keeps the contract of `Operator`.

What would otherwise be a step that does nothing, or a fault amid a run, is found before."""

from __future__ import annotations

import inspect
from collections.abc import Set
from typing import Any

from .configuration.diagnostics import nearest
from .operator import Operator
from .signal import is_stream

STAGES = {
    "observe": "data",
    "check": "data",
    "configure": "observation",
    "prepare": "observation",
    "measure": "stream, model",
    "exec": "block, state",
    "collect": "data, observation, state",
    "finalize": "data",
}
"""Methods of an operator of which one at least is its own, and their arguments."""
OTHERS = {"halo": "observation", "discard": "observation, state"}
COUPLES = ("sample", "detectors", "time", "all")


def broken(operator: Operator) -> tuple[str, str] | None:
    """Fault of the class of an operator, and the cure; None: nothing that can be seen before it
    runs.
    """
    return _fields(operator) or _methods(operator) or _acts(operator)


def _fields(operator: Operator) -> tuple[str, str] | None:
    for what in ("requires", "provides", "optional"):
        names = getattr(operator, what)
        if not isinstance(names, Set) or not all(isinstance(one, str) for one in names):
            listed = (
                [names]
                if isinstance(names, str)
                else names
                if isinstance(names, tuple | list | Set)
                else ()
            )
            texts = ", ".join(f'"{one}"' for one in listed if isinstance(one, str)) or '"signal"'
            return (
                f"{what} is a frozenset of names, not {names!r:.60}",
                f"write {what} = frozenset({{{texts}}})",
            )
    if operator.couples not in COUPLES:
        cure = nearest(str(operator.couples), COUPLES) or f"choose from: {', '.join(COUPLES)}"
        return f"couples is one of {', '.join(COUPLES)}, not {operator.couples!r:.60}", cure
    for what in ("linear", "knows_means"):
        if not isinstance(getattr(operator, what), bool):
            return (
                f"{what} is True or False, not {getattr(operator, what)!r:.60}",
                f"write {what} = True, or leave it out",
            )
    return None


def _methods(operator: Operator) -> tuple[str, str] | None:
    cls = type(operator)
    for stage, arguments in (STAGES | OTHERS).items():
        if (method := getattr(cls, stage, None)) is getattr(Operator, stage):
            continue
        head = f"def {stage}(self, {arguments})"
        if not callable(method):
            return f"{stage} is a method, not {method!r:.60}", f"write {head}: ..."
        try:
            inspect.signature(getattr(operator, stage)).bind(*arguments.split(", "))
        except TypeError:
            return f"{stage} does not take {arguments}", f"write {head}: ..."
        except ValueError:  # a method of compiled code
            continue
    return None


def _acts(operator: Operator) -> tuple[str, str] | None:
    cls = type(operator)
    own = [stage for stage in STAGES if getattr(cls, stage) is not getattr(Operator, stage)]
    others = _methods_of(cls)
    if not own:
        return f"overrides none of {', '.join(STAGES)}: it would do nothing", _named(others, "exec")
    if "exec" not in own and (
        streams := sorted(name for name in operator.provides if is_stream(name))
    ):
        return (
            f"provides {' and '.join(streams)}, but overrides no exec: it would do nothing to it",
            _named(others, "exec"),
        )
    if operator.couples == "all" and "measure" not in own:
        return (
            "couples all samples, but overrides no measure, which reads the whole stream",
            _named(others, "measure"),
        )
    return None


def _methods_of(cls: type[Any]) -> list[str]:
    """Public methods that a class has beyond `Operator`."""
    classes = [c for c in cls.__mro__ if issubclass(c, Operator) and c is not Operator]
    methods = [
        name for c in classes for name, value in vars(c).items() if inspect.isfunction(value)
    ]
    return [name for name in methods if not name.startswith("_") and not hasattr(Operator, name)]


def _named(others: list[str], stage: str) -> str:
    """``stage`` is what the method is called."""
    head = f"def {stage}(self, {STAGES[stage]})"
    return (
        f"is {others[0]} what the step does? call it {stage}: {head}"
        if others
        else f"write {head}: ..."
    )
