"""Checks that the class of a step keeps the contract of `Operator`.

Declarations and methods are checked when the class is made, the rest when a pipeline is built: a
step that would do nothing, or fail amid a run, is refused before.
"""

from __future__ import annotations

import inspect
from collections.abc import Set
from typing import Any

from .configuration.diagnostics import nearest
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
NAMES = ("requires", "provides", "optional", "on_request")
SWITCHES = ("linear", "knows_means", "all_bands")

Fault = tuple[str, str]
"""A mistake and its cure."""


def fault_of_class(cls: type[Any], base: type[Any]) -> Fault | None:
    """Fault in the declarations and methods of a subclass of ``base``, which is `Operator`."""
    return _parameters(cls) or _declarations(cls) or _methods(cls, base)


def fault_of_step(operator: Any, base: type[Any]) -> Fault | None:
    """Fault of an operator that can be seen before it runs."""
    return _declarations(operator) or _acts(operator, base)


def _parameters(cls: type[Any]) -> Fault | None:
    """Declarations and methods that a type has made parameters."""
    for what in (*NAMES, "couples", *SWITCHES, *STAGES, *OTHERS):
        if what in cls.model_fields:
            method = what in STAGES | OTHERS
            cure = f"def {what}(self, ...): ..." if method else f"{what} = ... without a type"
            return f"{what} has a type, which makes it a parameter", f"write {cure}"
    return None


def _declarations(owner: Any) -> Fault | None:
    """Fault of what a class or an operator declares; the properties of a class are left out."""
    for what in NAMES:
        names = getattr(owner, what)
        if isinstance(names, property):
            continue
        if not isinstance(names, Set) or not all(isinstance(one, str) for one in names):
            listed = [names] if isinstance(names, str) else names
            listed = listed if isinstance(listed, tuple | list | Set) else ()
            texts = ", ".join(f'"{one}"' for one in listed if isinstance(one, str)) or '"signal"'
            return (
                f"{what} is a frozenset of names, not {names!r:.60}",
                f"write {what} = frozenset({{{texts}}})",
            )
    if not isinstance(owner.couples, property) and owner.couples not in COUPLES:
        cure = nearest(owner.couples, COUPLES) or f"choose from: {', '.join(COUPLES)}"
        return f"couples is one of {', '.join(COUPLES)}, not {owner.couples!r:.60}", cure
    for what in SWITCHES:
        value = getattr(owner, what)
        if not isinstance(value, bool | property):
            return (
                f"{what} is True or False, not {value!r:.60}",
                f"write {what} = True, or leave it out",
            )
    return None


def _methods(cls: type[Any], base: type[Any]) -> Fault | None:
    for stage, arguments in (STAGES | OTHERS).items():
        if (method := getattr(cls, stage, None)) is getattr(base, stage):
            continue
        head = f"def {stage}(self, {arguments})"
        if not callable(method):
            return f"{stage} is a method, not {method!r:.60}", f"write {head}: ..."
        try:
            bound = getattr(object.__new__(cls), stage)
            inspect.signature(bound).bind(*arguments.split(", "))
        except TypeError:
            return f"{stage} does not take {arguments}", f"write {head}: ..."
        except ValueError:  # a method of compiled code
            continue
    return None


def _acts(operator: Any, base: type[Any]) -> Fault | None:
    cls = type(operator)
    own = [stage for stage in STAGES if getattr(cls, stage) is not getattr(base, stage)]
    others = _further_methods(cls, base)
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


def _further_methods(cls: type[Any], base: type[Any]) -> list[str]:
    """Public methods that a class has beyond `Operator`."""
    classes = [c for c in cls.__mro__ if issubclass(c, base) and c is not base]
    methods = [
        name for c in classes for name, value in vars(c).items() if inspect.isfunction(value)
    ]
    return [name for name in methods if not name.startswith("_") and not hasattr(base, name)]


def _named(others: list[str], stage: str) -> str:
    """The cure of a class whose method has another name than ``stage``."""
    head = f"def {stage}(self, {STAGES[stage]})"
    return (
        f"is {others[0]} what the step does? call it {stage}: {head}"
        if others
        else f"write {head}: ..."
    )
