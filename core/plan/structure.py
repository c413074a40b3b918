"""Structural pruning: from the requested outputs back to the operators that they depend on.

An operator takes part in a run if it is an output itself, if it changes a stream or a field that a later operator of the run
reads, or if what it does cannot be known. `Operator.product_only` marks operators whose work is worth nothing unless a later
step reads the product. A run is left out where nothing it makes is read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ..operator import Operator
from ..pipeline import Companion, Pipeline

STREAMS = frozenset({"sky", "atmosphere", "transmission", "white", "pink", "signal"})
"""Names whose only use is to be read by a later operator of the same run."""


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
        Companion runs that are of use.
    rows
        What is left out, and why.
    """

    operators: tuple[str, ...]
    runs: tuple[str, ...]
    rows: tuple[Row, ...]


def prune(pipeline: Pipeline, keep: Sequence[str] = ()) -> Structure:
    """What the pipeline's outputs depend on. ``keep``: labels of operators that stay whatever depends on them."""
    at_end = [o for o in pipeline.operators if o.at_end]
    rows: list[Row] = []
    wanted: set[str] = set().union(*(o.requires | o.optional for o in at_end))
    if all(o.product_only or "boresight" in o.provides or o.provides <= STREAMS for o in pipeline.operators):
        wanted = set().union(*(o.provides for o in pipeline.operators))  # nothing is written: the products are the output
    needed: dict[str, dict[str, str]] = {}  # by run: label -> reason
    for run in ["", *pipeline.runs]:
        steps = pipeline._selected(run)
        found, left_out = _walk(steps, wanted, {*keep})
        if run and not any(_makes_something(o, wanted) for o in steps if o.label in found):
            reason = "nothing in it makes a product" if not _anything_made(steps) else "no later step reads what it makes"
            rows.append(Row(run, "", False, reason))
            continue
        if run and not any((o.requires | o.optional) & STREAMS for o in steps if o.label in found):
            reason = "nothing in it depends on the sky, the air or the noise"
            rows.append(Row(run, "", False, reason))
            continue
        needed[run] = found
        rows += [Row(run, label, False, reason) for label, reason in left_out.items()]
        rows += _not_in_run(pipeline, run, steps)
    acting = set().union(*(set(found) for found in needed.values()))
    outside = [o for o in pipeline.operators if o.at_end or "boresight" in o.provides]
    acting |= {o.label for o in outside}
    nowhere = {r.operator for r in rows if r.run == "" and r.operator and r.operator not in acting}
    rows = [r for r in rows if not (r.run and r.operator in nowhere)]
    kept_rows = [r for r in rows if r.run or r.operator in nowhere]
    kept = tuple(o.label for o in pipeline.operators if o.label in acting)
    return Structure(kept, tuple(r for r in pipeline.runs if r in needed), tuple(kept_rows))


def _walk(steps: Sequence[Operator], wanted: set[str], keep: set[str]) -> tuple[dict[str, str], dict[str, str]]:
    """(needed, left out) by label with reasons, going back through one run's steps."""
    read: dict[str, str] = {}  # stream or field -> who reads it
    needed: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for operator in reversed(steps):
        made = operator.provides
        readers = sorted({read[name] for name in made if name in read})
        if operator.label in keep:
            reason = "asked for with --keep"
        elif readers:
            reason = f"read by {', '.join(readers)}"
        elif made and made <= STREAMS and type(operator).finalize is Operator.finalize:
            left_out[operator.label] = f"no step that is needed reads {' or '.join(sorted(made))}"
            continue
        elif operator.product_only and not made & wanted:
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
    return bool(made & wanted) or bool(made and not operator.product_only) or (not operator.provides)


def _anything_made(steps: Sequence[Operator]) -> bool:
    return any(o.provides - STREAMS - {"boresight"} for o in steps)


def _not_in_run(pipeline: Pipeline, run: str, steps: Sequence[Operator]) -> list[Row]:
    """Operators that a companion run leaves out by its definition."""
    if not run:
        return []
    taking = {o.label for o in steps}
    rows = []
    for o in pipeline._selected(""):
        if o.label not in taking:
            why = "belongs to the main run only" if o.main_run_only else f"the run has {_words(pipeline.runs[run])}"
            rows.append(Row(run, o.label, False, why))
    return rows


def _words(companion: Companion) -> str:
    if companion.only is not None:
        return f"only {' and '.join(companion.only)}"
    return f"no {' or '.join(companion.without or ())}"


def selected(pipeline: Pipeline, structure: Structure) -> dict[str, int]:
    """Number of runs in which each operator takes part, by label."""
    counts: Mapping[str, int] = {}
    counts = dict.fromkeys(structure.operators, 0)
    for run in ["", *structure.runs]:
        for operator in pipeline._selected(run):
            if operator.label in counts:
                counts[operator.label] += 1
    return dict(counts)
