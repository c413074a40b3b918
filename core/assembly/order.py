"""The order of a pipeline's steps, checked before anything runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..configuration.diagnostics import nearest
from ..mapmaker import MapMaker, changes_components, forms, place_of_signal, removes
from ..operator import Operator
from ..output import Output
from ..registry import makers
from ..scene import WithScene
from ..signal import Component


@dataclass(frozen=True)
class OrderProblem:
    """A step that does not fit where it stands."""

    index: int
    message: str
    label: str
    cure: str = ""


def check_order(operators: Sequence[Operator]) -> list[OrderProblem]:
    """Every step whose inputs are not there yet, or whose output comes too late to be used."""
    problems = []
    have: set[str] = set()
    sky_is_signal = place_of_signal(operators)
    for index, operator in enumerate(operators):
        if index == sky_is_signal:
            have.add("signal")
        name = type(operator).__name__
        later = {
            what: type(o).__name__ for o in reversed(operators[index + 1 :]) for what in o.provides
        }
        made = {
            what: type(o).__name__
            for o in reversed(operators[index + 1 :])
            for what in o.provides - o.requires
        }
        for what in sorted(operator.requires - have):
            if what in made:
                problems.append(
                    OrderProblem(
                        index,
                        f"{name} needs {what}, which {made[what]} provides only later",
                        f"move it below {made[what]}",
                    )
                )
            else:
                found = makers(what)
                above = {type(o).__name__ for o in operators[:index]}
                cure = nearest(what, sorted(have)) or ""
                if found:
                    cure = f"{' or '.join(found)} provides it"
                if on_request := sorted(above & {*found}):
                    cure = f"{on_request[0]} makes it if its parameters ask for it"
                elif not found and not cure and have:
                    cure = f"what there is: {', '.join(sorted(have))}"
                message = f"{name} needs {what}, which no step provides"
                problems.append(
                    OrderProblem(index, message, f"add a step that provides {what} above", cure)
                )
        adds_up = forms(operator) and (operator.requires | operator.optional) - {"boresight"}
        components = {what for what in later if isinstance(what, Component)} if adds_up else set()
        late: dict[str, list[str]] = {}
        for what in sorted(((operator.optional | components) - operator.requires) & set(later)):
            late.setdefault(later[what], []).append(what)
        for step, whats in late.items() if not isinstance(operator, Output) else ():
            used = "it" if len(whats) == 1 else "them"
            message = f"{step} provides {' and '.join(whats)} only after {name} has used {used}"
            problems.append(OrderProblem(index, message, f"move {name} below {step}"))
        if operator.couples == "all" and len(operator.requires - {"boresight"}) != 1:
            problems.append(
                OrderProblem(
                    index,
                    f"{name} couples all samples but requires {len(operator.requires)} streams",
                    "it must require exactly one",
                )
            )
        taking = [type(o).__name__ for o in operators[:index] if removes(o)]
        if taking and isinstance(operator, MapMaker) and operator.unfiltered:
            names = " and ".join(dict.fromkeys(taking))
            message = f"{name} needs streams that no filter has changed, not those behind {names}"
            cure = f"move {name} above {taking[0]}, or leave {names} out"
            problems.append(OrderProblem(index, message, "what a filter removes is lost", cure))
        read = next((type(o).__name__ for o in operators[:index] if isinstance(o, WithScene)), None)
        if (
            read
            and "boresight" in operator.provides - operator.requires
            and not isinstance(operator, WithScene)
        ):
            message = (
                f"{name} would add scans to those that {read} has read, with nothing recorded in"
                " them"
            )
            problems.append(
                OrderProblem(index, message, f"leave {name} out: {read} brings the pointing")
            )
        if not changes_components(operator):
            have |= operator.provides
    if operators and not any("boresight" in o.provides | o.requires for o in operators):
        cure = f"steps that do: {', '.join(makers('boresight'))}"
        problems.append(
            OrderProblem(0, "no step points the telescope", "begin with a pointing step", cure)
        )
    return problems
