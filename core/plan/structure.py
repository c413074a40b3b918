"""Structural pruning: from the requested outputs back to the operators and signals that they depend
on; and the narrowing of the complete signal to some components.

An operator takes part if it is an output itself, if it changes a stream or a field that a later
operator reads, or if what it does cannot be known. One that makes nothing but products
(`mapmaker.makes_products`) takes part only where a later step reads them. A signal is left out
where nothing that is made of it is read; the complete one too, where another that keeps fewer of
the components can take its place, and no signal takes its singular modes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from ..assembly.signals import Signals, acting_steps, remainder
from ..configuration.diagnostics import nearest
from ..configuration.loaded import PipelineFile
from ..errors import ZondaError
from ..mapmaker import MapMaker, filters, forms, made_by, makes_products
from ..operator import Operator
from ..output import Output, changes_observations, is_output
from ..pipeline import Pipeline
from ..signal import MAIN, TRANSMISSION, Component, is_stream, stream_of
from .bounds import Work


@dataclass(frozen=True)
class Row:
    """An omission and its reason: an operator of a signal (empty: the complete one), or a signal
    (``operator`` empty).
    """

    run: str
    operator: str
    reason: str


@dataclass(frozen=True)
class Structure:
    """Result of `prune`.

    Attributes
    ----------
    operators
        Labels of the operators that act at all.
    runs
        Names of the signals that are of use, beside the complete one.
    rows
        Omissions and their reasons.
    instead
        The signal that takes the place of the complete one, its name no longer needed; empty: none.
    derived
        Signals that are not formed, and how they follow from others (`core.assembly.signals`).
    """

    operators: tuple[str, ...]
    runs: tuple[str, ...]
    rows: tuple[Row, ...] = ()
    instead: str = ""
    derived: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_all(cls, pipeline: Pipeline) -> Structure:
        """The structure of a pipeline from which nothing is omitted."""
        return cls(
            tuple(o.label for o in pipeline.operators),
            tuple(pipeline.runs),
            derived=remainders(pipeline, pipeline.runs),
        )


def prune(pipeline: Pipeline, keep: Sequence[str] = ()) -> Structure:
    """Structure of what the pipeline's outputs depend on. ``keep``: labels of operators that stay
    whatever depends on them.
    """
    rows: list[Row] = []
    in_memory = not any(map(is_output, pipeline.operators))
    every = set().union(*(o.provides for o in pipeline.operators))
    needed: dict[str, dict[str, str]] = {}  # by signal: label -> reason
    for name in [*pipeline.runs, ""]:  # the complete signal last: the others may need its modes
        steps = steps_of(pipeline, name)
        wanted = (
            every if in_memory else _wanted(pipeline, name)
        )  # where nothing is written, the products are the output
        pinned = dict.fromkeys(keep, "asked for with --keep")
        for other in [n for n in needed if not name and _takes_modes(pipeline, n)]:
            pinned |= {
                o.label: f"signal {other} takes its modes" for o in steps if o.couples == "all"
            }
        compared = _is_compared(pipeline, name)
        found, left_out = _walk(steps, wanted | {MAIN} if compared else wanted, pinned)
        if name and not compared and (reason := _useless(steps, found, wanted)):
            rows.append(Row(name, "", reason))
        else:
            needed[name] = found
            rows += [Row(name, label, reason) for label, reason in left_out.items()]
    instead = _in_place_of_complete(pipeline, needed, {*keep}) if not in_memory else ""
    if instead:
        rows = [r for r in rows if r.run not in ("", instead)]
        words = (
            "the sky alone"
            if pipeline.runs[instead].only == ["sky"]
            else f"signal {instead.strip('_')}"
        )
        reason = f"no step reads what a run of everything makes: {words} takes its place"
        rows += [
            Row("", o.label, reason)
            for o in pipeline.signals.steps
            if o.label not in needed[instead]
        ]
        needed[""] = needed.pop(instead)
    acting = {
        o.label for o in pipeline.operators if isinstance(o, Output) or "boresight" in o.provides
    }.union(*needed.values())
    named = {part for name in needed if name for part in pipeline.runs[name].without or ()}
    acting |= {
        o.label for o in pipeline.operators if made_by(o) & named
    }  # a signal is not without what is not there
    rows = [r for r in rows if not r.operator or (r.operator in acting) == bool(r.run)]
    rows.sort(key=lambda r: ["", *pipeline.runs].index(r.run))
    runs = tuple(name for name in pipeline.runs if name in needed)
    derived = {} if instead else remainders(pipeline, runs)
    return Structure(
        tuple(o.label for o in pipeline.operators if o.label in acting),
        runs,
        tuple(rows),
        instead,
        derived,
    )


def _wanted(pipeline: Pipeline, name: str) -> set[str]:
    """Products and components of a signal that outputs read. Those that ask for certain signals
    read of these alone.
    """
    found: set[str] = set()
    for o in pipeline.operators:
        if isinstance(o, Output) and o.reads(name):
            found |= o.requires | o.optional
    return found


def _is_compared(pipeline: Pipeline, name: str) -> bool:
    """True if a step that acts on the complete signal reads the stream of another one, too."""
    return bool(name) and any(stream_of(name) in o.optional for o in pipeline.operators)


def _in_place_of_complete(
    pipeline: Pipeline, needed: Mapping[str, Mapping[str, str]], keep: set[str]
) -> str:
    """A signal whose components hold those of all other needed ones, where nothing reads what the
    complete one makes; else empty."""
    signals, wanted = pipeline.signals, _wanted(pipeline, "")
    steps = [o for o in signals.steps if o.label in needed[""]]
    if any(_makes_something(o, wanted) or o.label in keep for o in steps) or any(
        _takes_modes(pipeline, name) for name in needed if name
    ):
        return ""
    others = [name for name in needed if name and pipeline.runs[name].only is not None]
    for name in others:
        made = signals.makers(name)
        if (
            signals.all[name].filtered
            and len(others) == len(needed) - 1
            and all(signals.makers(n) <= made for n in others)
        ):
            return name
    return ""


def _takes_modes(pipeline: Pipeline, name: str) -> bool:
    """True if a signal is treated as a part of the complete one, by a filter or by the atmosphere's
    transmission.
    """
    signal = pipeline.signals.all[name]
    return signal.model and (
        TRANSMISSION in signal.components
        or any(
            filters(o) and o.couples == "all" and o.label not in signal.own
            for o in pipeline.operators
        )
    )


def _useless(steps: Sequence[Operator], found: Mapping[str, str], wanted: set[str]) -> str:
    """Why a signal is not needed; empty: it is needed."""
    acting = [o for o in steps if o.label in found]
    if not any(_makes_something(o, wanted) for o in acting):
        made = any(_products(o) for o in steps)
        return "no later step reads what it makes" if made else "nothing in it makes a product"
    if not any(is_stream(name) for o in acting for name in o.requires | o.optional):
        return "nothing in it depends on the sky, the atmosphere or the noise"
    return ""


def _walk(
    steps: Sequence[Operator], wanted: set[str], keep: Mapping[str, str]
) -> tuple[dict[str, str], dict[str, str]]:
    """(needed, omitted) by label with reasons, going back through one signal's steps."""
    read = {
        name: "an output" for name in wanted if is_stream(name)
    }  # stream or field -> who reads it
    needed: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for operator in reversed(steps):
        made = operator.provides
        readers = sorted({read[name] for name in made if name in read})
        if operator.label in keep:
            reason = keep[operator.label]
        elif readers:
            reason = f"read by {', '.join(readers)}"
        elif (
            made
            and all(map(is_stream, made))
            and (MAIN not in made or type(operator).finalize is Operator.finalize)
        ):
            left_out[operator.label] = f"no step that is needed reads {' or '.join(sorted(made))}"
            continue
        elif changes_observations(operator):
            reason = "changes the observations"
        elif makes_products(operator) and not made & wanted:
            left_out[operator.label] = f"no step writes or draws its {' or '.join(sorted(made))}"
            continue
        else:
            reason = "an output"
        needed[operator.label] = reason
        changes = made & operator.requires  # reads what it writes: those above still matter
        for name in made - changes:
            if is_stream(name):
                others = [o for o in steps[: list(steps).index(operator)] if name in o.provides]
                if not others:
                    read.pop(name, None)
        for name in (
            operator.requires
            | operator.optional
            | (_components_before(operator, steps) if forms(operator) else set())
        ):
            read.setdefault(name, operator.label)
    return needed, left_out


def _components_before(operator: Operator, steps: Sequence[Operator]) -> set[str]:
    """The components that a step which forms the signal finds, whatever steps make them."""
    before = list(steps)[: list(steps).index(operator)]
    return {name for o in before for name in o.provides if isinstance(name, Component)}


def _products(operator: Operator) -> set[str]:
    """Names that it provides besides streams and the pointing."""
    return {name for name in operator.provides if name != "boresight" and not is_stream(name)}


def _makes_something(operator: Operator, wanted: set[str]) -> bool:
    made = _products(operator)
    unknown = not operator.provides and not changes_observations(operator)
    return bool(made & wanted) or bool(made and not makes_products(operator)) or unknown


def steps_of(pipeline: Pipeline, name: str) -> list[Operator]:
    """The steps that act on a signal (empty: the complete one)."""
    signals = pipeline.signals
    if not name:
        return signals.steps
    signal, made = signals.all[name], signals.makers(name)
    return [
        o
        for o in signals.steps
        if o.label in made
        or signals.components_of(o) & signal.components
        or forms(o)
        or (filters(o) and signal.filtered)
        or isinstance(o, MapMaker)
        or changes_observations(o)
    ]


def remainders(pipeline: Pipeline, names: Iterable[str]) -> dict[str, str]:
    """The remainders among these signals: those that are not formed but follow from others."""
    kept = {*names}
    return {
        name: remainder(parts)
        for name, parts in pipeline.signals.remainders.items()
        if {name, *parts} <= kept
    }


def work(pipeline: Pipeline, structure: Structure) -> Work:
    """Steps and signals of each observation."""
    signals = tuple(
        pipeline.signals.all[name]
        for name in ["", *structure.runs]
        if name not in structure.derived
    )
    acting = [o for o in pipeline.operators if o.label in structure.operators]
    return Work(tuple(acting_steps(acting)), signals, pipeline.signals.components)


def only(file: PipelineFile, components: Sequence[str]) -> PipelineFile:
    """The file with its complete signal narrowed to some components (``--only sky``): the same
    levels, flags and random numbers.

    The bits are those of the signal with this ``only``. Other signals go on with what is left of
    their components; one that has nothing left, or everything, is left out.

    Raises
    ------
    ZondaError
        Where no step provides a component, or a step asks for singular modes of the complete data.
    """
    pipeline = file.pipeline()
    signals, operators = pipeline.signals, pipeline.operators
    provided = sorted(signals.components)
    for name in components:
        if name not in provided:
            cure = nearest(name, provided) or f"choose from: {', '.join(provided)}"
            raise ZondaError(f"no step of this pipeline makes {name!r}", place="--only", cure=cure)
    narrowed = Signals(operators, {}, components, file.header.name)
    for o in operators if narrowed.makers("") < signals.makers("") else ():
        if isinstance(o, Output) and any(signal.modes == "full" for signal in o.signals()):
            left = " and ".join(components)
            raise ZondaError(
                f"{o.label} asks for singular modes of the complete data, of which {left} alone is"
                " left",
                place="--only",
                cure=f"set modes to sky (--set {o.label}.modes=sky), or leave --only out",
            )
    header = file.header.model_copy(update={"only": list(components)})
    return replace(file, header=header)
