"""The list of operators of a pipeline file."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from .. import registry
from ..assembly.order import check_order
from ..components import Registry
from ..errors import ZondaError
from ..operator import Operator
from .diagnostics import ConfigurationError, Diagnostic, refused
from .explain import explain, glued
from .loaded import Step
from .parameters import Parameters
from .yaml_places import Document, Span
from .yaml_places import Path as Place

P = TypeVar("P", bound=Parameters)


class Mistakes:
    """A document and what was found wrong with it.

    Parameters
    ----------
    folder
        Where relative paths in the document are looked for first.
    """

    def __init__(
        self,
        document: Document,
        folder: str | Path | None,
        found: list[Diagnostic],
    ) -> None:
        self.document = document
        self.found = found
        self.context = {"folder": folder}

    def wrong(self, message: str, span: Span, label: str = "", help: str = "") -> None:
        """Note a mistake."""
        self.found.append(Diagnostic(message, span, label, help))

    def validate(
        self,
        model: type[P],
        value: Any,
        at: Place,
        who: str,
        keys: Iterable[str] = (),
    ) -> P | None:
        """Validated ``value`` at ``at``, or None if it is mistaken. ``who`` and ``keys`` are those
        of `explain`.
        """
        try:
            return model.model_validate(value, context=self.context)
        except ValidationError as err:
            self.found += explain(err, model, self.document, at, who, keys)
        except ZondaError as err:
            self.refused(err, self.document.mark(at).start)
        return None

    def refused(self, err: ZondaError, span: Span) -> None:
        """Note an error that says what is wrong at ``span``."""
        self.found.append(refused(err, span))

    def named(self, given: dict[str, Any], key: str, names: Registry, at: Place) -> bool:
        """Put what the name stands for in its place; False where there is no such thing."""
        if not isinstance(given.get(key), str):
            return True
        try:
            given[key] = names.create(given[key], self.context["folder"])
        except ConfigurationError as err:
            self.found += err.diagnostics
            return False
        except ZondaError as err:
            self.refused(err, self.document.mark(at).value)
            return False
        return True


def read_steps(mistakes: Mistakes) -> list[Step | None]:
    """The steps; None stands for one that could not be made."""
    items = mistakes.document.value.get("operators")
    if not isinstance(items, list) or not items:
        there = ("operators",) in mistakes.document.marks
        span = (
            mistakes.document.mark(("operators",)).start
            if there
            else Span(mistakes.document.mark(()).value.source)
        )
        empty = items is None or items == []
        have = (
            "'operators' is empty: it must be a list of steps"
            if empty
            else "'operators' must be a list of steps"
        )
        message = have if there else "the pipeline needs 'operators', a list of steps"
        mistakes.wrong(
            message,
            span,
            "" if there else "add 'operators:'",
            "write one '- Name: {parameter: value}' per step",
        )
        return []
    steps: list[Step | None] = []
    standing: list[tuple[int, Operator]] = []  # what takes part in the check of the order
    unknown = len(items)
    for i, item in enumerate(items):
        step, stand_in = _step(mistakes, item, ("operators", i))
        steps.append(step)
        if stand_in is None:
            unknown = min(unknown, i)
        else:
            standing.append((i, stand_in))
    for problem in check_order([operator for _, operator in standing]):
        i = standing[problem.index][0]
        if i < unknown:  # an unknown step may provide anything
            mark = mistakes.document.mark(("operators", i))
            name = next(iter(items[i])) if isinstance(items[i], dict) else None
            span = (
                mistakes.document.mark(("operators", i, name)).start
                if name is not None
                else mark.value
            )
            mistakes.wrong(problem.message, span, problem.label, problem.cure)
    return steps


def _step(mistakes: Mistakes, item: Any, at: Place) -> tuple[Step | None, Operator | None]:
    """A step, and what stands for it in the check of the order: both None where the operator is not
    known.
    """
    name: Any
    parameters: Any
    if isinstance(item, str):  # - BinMap
        name = item
        parameters = {}
        span = mistakes.document.mark(at).value
        inner = at
    elif isinstance(item, dict) and len(item) == 1:  # - BinMap: {pixel: 2 arcsec}
        name, parameters = next(iter(item.items()))
        inner = (*at, name)
        span = mistakes.document.mark(inner).start
        parameters = {} if parameters is None else parameters
    else:
        message = "each step is one operator: '- Name: {...}'"
        span = mistakes.document.mark(at).value
        label = ""
        if isinstance(item, dict) and item:
            second = list(item)[1]
            span = mistakes.document.mark((*at, second)).start
            label = "indent this under the operator"
            message += f"; '{second}' may be indented too little"
        mistakes.wrong(message, span, label)
        return None, None
    name = str(name)
    try:
        operator = registry.operators.get(name)
    except ZondaError as err:
        first = re.split(r"[\s{:]", name)[0]
        if first != name and first in registry.operators:
            missing = (
                "a space is missing behind the colon"
                if name[len(first)] == ":"
                else "a colon is missing"
            )
            mistakes.wrong(
                f"cannot read the step '{name}'",
                span,
                missing,
                f"write '- {first}: {{...}}'",
            )
        else:
            mistakes.refused(err, span)
        return None, None
    if not isinstance(parameters, dict):
        message = f"{name} takes a mapping of parameters, not {noun(parameters)}"
        known = list(operator.model_fields)
        label = (
            isinstance(parameters, str) and glued(parameters, known)
        ) or f"write '- {name}: {{...}}'"
        mistakes.wrong(
            message,
            mistakes.document.mark(inner).value,
            label,
            f"{name} takes: {', '.join(known)}",
        )
        return None, operator.model_construct()
    made = mistakes.validate(operator, parameters, inner, name)
    if made is None:
        return None, operator.model_construct()
    return Step(name, made, inner), made


def noun(value: Any) -> str:
    """Kind of a YAML value, in words."""
    return (
        "a list" if isinstance(value, list) else "text" if isinstance(value, str) else "one value"
    )
