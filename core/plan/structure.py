"""Structural pruning: from the requested outputs back to the operators that they depend on.

An operator takes part in a run if it is an output itself, if it changes a stream or a field that a later operator of the run
reads, or if what it does cannot be known. `Operator.product_only` marks operators whose work is worth nothing unless a later
step reads the product. A run is left out where nothing it makes is read; the main run too, where a companion run that keeps less
of the components can take its place, and no run needs the main run's singular modes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from .. import data
from ..mapmaker import MapMaker, filters, forms, makes_products
from ..operator import Operator
from ..output import Output
from ..pipeline import Pipeline
from ..run.signals import remainder
from ..signal import Signal
from .planning import planning_of

STREAMS = frozenset(data.STREAMS)


@dataclass(frozen=True)
class Row:
    """Why an operator runs or not: ``run`` is empty for the main run, ``operator`` for a run as a whole."""

    run: str
    operator: str
    runs: bool
    reason: str


@dataclass(frozen=True)
class Structure:
    """Result of `prune`.

    Attributes
    ----------
    operators
        Labels of the operators that act at all.
    runs
        Signal runs that are of use.
    rows
        What is left out, and why.
    instead
        The companion run that takes the main run's place, its name no longer needed; empty: none.
    derived
        Signal runs that cost nothing, and how they are derived (`core.run.derived`).
    """

    operators: tuple[str, ...]
    runs: tuple[str, ...]
    rows: tuple[Row, ...]
    instead: str = ""
    derived: Mapping[str, str] = field(default_factory=dict)


def prune(pipeline: Pipeline, keep: Sequence[str] = ()) -> Structure:
    """What the pipeline's outputs depend on. ``keep``: labels of operators that stay whatever depends on them."""
    rows: list[Row] = []
    in_memory = all(makes_products(o) or "boresight" in o.provides or o.provides <= STREAMS for o in pipeline.operators)
    needed: dict[str, dict[str, str]] = {}  # by run: label -> reason
    for run in [*pipeline.runs, ""]:  # the main run last: the others may need it
        steps, wanted = steps_of(pipeline, run), _wanted(pipeline, run)
        pinned = dict.fromkeys(keep, "asked for with --keep")
        if in_memory:
            wanted = set().union(*(o.provides for o in pipeline.operators))  # nothing is written: the products are the output
        for frozen in [r for r in needed if not run and pipeline.signals.all[r].model]:
            pinned |= {o.label: f"run {frozen} takes its modes" for o in steps if o.couples == "all"}
        found, left_out = _walk(steps, wanted, pinned)
        needed[run] = found
        if run and not any(_makes_something(o, wanted) for o in steps if o.label in found):
            reason = "nothing in it makes a product" if not _anything_made(steps) else "no later step reads what it makes"
        elif run and not any((o.requires | o.optional) & STREAMS for o in steps if o.label in found):
            reason = "nothing in it depends on the sky, the air or the noise"
        else:
            rows += [Row(run, label, False, reason) for label, reason in left_out.items()]
            rows += _not_in_run(pipeline, run, steps)
            continue
        rows.append(Row(run, "", False, reason))
        del needed[run]
    instead = _in_place_of_main(pipeline, needed, _wanted(pipeline, ""), {*keep}) if not in_memory else ""
    if instead:
        rows = [r for r in rows if r.run not in ("", instead)]
        words = "the sky alone" if pipeline.runs[instead].only == ["sky"] else f"run {instead.strip('_')}"
        reason = f"no step reads what a run of everything makes: {words} takes its place"
        rows += [Row("", o.label, False, reason) for o in pipeline.signals.steps if o.label not in needed[instead]]
        needed[""] = needed.pop(instead)
    acting = set().union(*(set(found) for found in needed.values()))
    outside = [o for o in pipeline.operators if isinstance(o, Output) or "boresight" in o.provides]
    acting |= {o.label for o in outside}
    nowhere = {r.operator for r in rows if r.run == "" and r.operator and r.operator not in acting}
    rows = [r for r in rows if not (r.run and r.operator in nowhere)]
    kept_rows = [r for r in rows if r.run or r.operator in nowhere]
    kept_rows.sort(key=lambda r: ["", *pipeline.runs].index(r.run))
    kept = tuple(o.label for o in pipeline.operators if o.label in acting)
    runs = tuple(r for r in pipeline.runs if r in needed)
    derived = {} if instead else remainders(pipeline, runs)
    return Structure(kept, runs, tuple(kept_rows), instead, derived)


def _wanted(pipeline: Pipeline, run: str) -> set[str]:
    """Products of a run that steps at the end read: those that need certain runs in these, the others in all but their own."""
    found: set[str] = set()
    for o in pipeline.operators:
        if isinstance(o, Output) and (run in o.shown if o.signals() or run.startswith("_") else True):
            found |= o.requires | o.optional
    return found


def _in_place_of_main(pipeline: Pipeline, needed: Mapping[str, Mapping[str, str]], wanted: set[str], keep: set[str]) -> str:
    """A run whose components hold those of all other needed runs, where nothing reads what the main run makes; else empty."""
    signals = pipeline.signals
    main = [o for o in signals.steps if o.label in needed[""]]
    if any(_makes_something(o, wanted) or o.label in keep for o in main) or any(signals.all[run].model for run in needed):
        return ""
    others = [run for run in needed if run and pipeline.runs[run].only is not None]
    for run in others:
        made, filtered = signals.makers(run), signals.all[run].filtered
        if filtered and len(others) == len(needed) - 1 and all(signals.makers(r) <= made for r in others):
            return run
    return ""


def _walk(steps: Sequence[Operator], wanted: set[str], keep: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """(needed, left out) by label with reasons, going back through one run's steps."""
    read: dict[str, str] = {}  # stream or field -> who reads it
    needed: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for operator in reversed(steps):
        made = operator.provides
        readers = sorted({read[name] for name in made if name in read})
        if operator.label in keep:
            reason = keep[operator.label]
        elif readers:
            reason = f"read by {', '.join(readers)}"
        elif made and made <= STREAMS and type(operator).finalize is Operator.finalize:
            left_out[operator.label] = f"no step that is needed reads {' or '.join(sorted(made))}"
            continue
        elif makes_products(operator) and not made & wanted:
            left_out[operator.label] = f"no step writes or draws its {' or '.join(sorted(made))}"
            continue
        else:
            reason = "an output"
        needed[operator.label] = reason
        changes = made & operator.requires  # reads what it writes: those above still matter
        for name in made - changes:
            if name in STREAMS:
                others = [o for o in steps[: list(steps).index(operator)] if name in o.provides]
                if not others:
                    read.pop(name, None)
        for name in operator.requires | operator.optional:
            read.setdefault(name, operator.label)
    return needed, left_out


def _makes_something(operator: Operator, wanted: set[str]) -> bool:
    made = operator.provides - STREAMS - {"boresight"}
    return bool(made & wanted) or bool(made and not makes_products(operator)) or (not operator.provides)


def _anything_made(steps: Sequence[Operator]) -> bool:
    return any(o.provides - STREAMS - {"boresight"} for o in steps)


def _not_in_run(pipeline: Pipeline, run: str, steps: Sequence[Operator]) -> list[Row]:
    """Operators that a companion run leaves out by its definition."""
    if not run:
        return []
    taking = {o.label for o in steps}
    rows = []
    for o in pipeline.signals.steps:
        if o.label not in taking:
            why = "belongs to the main run only" if planning_of(o).reads_streams else f"the run has {_words(pipeline.runs[run])}"
            if not planning_of(o).reads_streams and pipeline.runs[run].keeps(o.provides) | ("signal" in o.provides):
                why = "the run has no filters"
            rows.append(Row(run, o.label, False, why))
    return rows


def _words(companion: Signal) -> str:
    if companion.only is not None:
        return f"only {' and '.join(companion.only)}"
    return f"no {' or '.join(companion.without or ())}"


def steps_of(pipeline: Pipeline, name: str) -> list[Operator]:
    """The steps that act on a signal (empty: the complete one)."""
    signals = pipeline.signals
    if not name:
        return signals.steps
    signal, made = signals.all[name], signals.makers(name)
    generators = [o for o in signals.steps if o.label in made or (signals.components_of(o) & signal.components)]
    found = []
    for o in signals.steps:
        changes = filters(o) and signal.filtered
        if o in generators or forms(o) or changes or isinstance(o, MapMaker):
            found.append(o)
    return found


def remainders(pipeline: Pipeline, names: Sequence[str]) -> dict[str, str]:
    """Of these signals, those that are not formed, and how they follow from others."""
    found = pipeline.signals.remainders.items()
    return {name: remainder(parts) for name, parts in found if {name, *parts} <= {*names}}


OTHER = {"filter": 1.0, "form": 0.3, "map": 0.35}
"""What a further signal costs beside the first, as a share of that."""


def selected(pipeline: Pipeline, structure: Structure) -> dict[str, float]:
    """How often each operator does its work, by label: once for components, for each signal that it forms, filters or maps."""
    formed = [pipeline.signals.all[name] for name in ["", *structure.runs] if name not in structure.derived]
    others, filtered = len(formed) - 1, sum(s.filtered for s in formed) - 1
    counts = dict.fromkeys(structure.operators, 1.0)
    for o in pipeline.signals.steps:
        if o.label in counts:
            more = OTHER["form"] * others if forms(o) else OTHER["filter"] * filtered if filters(o) else 0.0
            counts[o.label] += OTHER["map"] * others if isinstance(o, MapMaker) else more
    return counts
