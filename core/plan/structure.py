"""Structural pruning: from the requested outputs back to the operators and signals that they depend
on; and the narrowing of the complete signal to some components.

An operator takes part if it is an output itself, if it changes a stream or a field that a later
operator reads, or if what it does cannot be known. One that makes nothing but products
(`mapmaker.makes_products`) takes part only where a later step reads them. A signal is left out
where nothing that is made of it is read; the complete one too, where another that keeps fewer of
the components can take its place, and no signal takes its singular modes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from ..assembly.signals import Chain, Signals, acting_steps, remainder
from ..configuration.diagnostics import nearest
from ..configuration.loaded import PipelineFile
from ..errors import ZondaError
from ..mapmaker import MapMaker, filters, forms, made_by, makes_products
from ..operator import Operator
from ..output import Output, changes_observations, is_output
from ..pipeline import Pipeline
from ..signal import MAIN, TRANSMISSION, Component, is_stream, stream_of


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
    every = frozenset[str]().union(*(o.provides for o in pipeline.operators))
    needed: dict[str, set[str]] = {}  # labels of steps by signal
    for name in [*pipeline.runs, ""]:  # the complete signal last: the others may need its modes
        steps = steps_of(pipeline, name)
        # where nothing is written, the products are the output
        wanted = every if in_memory else _wanted(pipeline, name)
        pinned = {*keep}
        if not name and any(_takes_modes(pipeline, other) for other in needed):
            pinned |= {o.label for o in steps if o.couples == "all"}
        # another step of the complete signal reads this one's stream too
        compared = bool(name) and any(stream_of(name) in o.optional for o in pipeline.operators)
        found, left_out = _walk(steps, wanted | {MAIN} if compared else wanted, pinned)
        reason = _useless(steps, found, wanted) if name and not compared else ""
        if reason:
            rows.append(Row(name, "", reason))
        else:
            needed[name] = found
            rows += [Row(name, label, why) for label, why in left_out.items()]
    instead = "" if in_memory else _in_place_of_complete(pipeline, needed, keep)
    if instead:
        alone = pipeline.runs[instead].only == ["sky"]
        words = "the sky alone" if alone else f"signal {instead.strip('_')}"
        reason = f"no step reads what a run of everything makes: {words} takes its place"
        needed[""] = needed.pop(instead)
        rows = [r for r in rows if r.run not in ("", instead)]
        rows += [Row("", o.label, reason) for o in pipeline.signals.steps
                 if o.label not in needed[""]]  # fmt: skip
    acting = set().union(*needed.values())
    # a signal cannot be without what is not there
    named = {part for name in needed if name for part in pipeline.runs[name].without or ()}
    for o in pipeline.operators:
        if isinstance(o, Output) or "boresight" in o.provides or made_by(o) & named:
            acting.add(o.label)
    rows = [r for r in rows if not r.operator or (r.operator in acting) == bool(r.run)]
    rows.sort(key=lambda r: ["", *pipeline.runs].index(r.run))
    runs = tuple(name for name in pipeline.runs if name in needed)
    return Structure(
        tuple(o.label for o in pipeline.operators if o.label in acting),
        runs,
        tuple(rows),
        instead,
        {} if instead else remainders(pipeline, runs),
    )


def _wanted(pipeline: Pipeline, name: str) -> frozenset[str]:
    """Products and components of a signal that outputs read. Those that ask for certain signals
    read of these alone.
    """
    outputs = [o for o in pipeline.operators if isinstance(o, Output) and o.reads(name)]
    return frozenset[str]().union(*(o.requires | o.optional for o in outputs))


def _in_place_of_complete(
    pipeline: Pipeline,
    needed: Mapping[str, Collection[str]],
    keep: Collection[str],
) -> str:
    """A signal whose components hold those of all other needed ones, where nothing reads what the
    complete one makes; else empty."""
    signals = pipeline.signals
    wanted = _wanted(pipeline, "")
    steps = [o for o in signals.steps if o.label in needed[""]]
    names = [name for name in needed if name]
    if (
        any(_makes_something(o, wanted) or o.label in keep for o in steps)
        or any(_takes_modes(pipeline, name) for name in names)
        or any(pipeline.runs[name].only is None for name in names)
    ):
        return ""
    makers = {name: signals.makers(name) for name in names}
    whole = (name for name in names if all(made <= makers[name] for made in makers.values()))
    return next((name for name in whole if signals.all[name].filtered), "")


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


def _useless(steps: Sequence[Operator], found: Collection[str], wanted: frozenset[str]) -> str:
    """Why a signal is not needed; empty: it is needed."""
    acting = [o for o in steps if o.label in found]
    if not any(_makes_something(o, wanted) for o in acting):
        made = any(map(_products, steps))
        return "no later step reads what it makes" if made else "nothing in it makes a product"
    if not any(is_stream(name) for o in acting for name in o.requires | o.optional):
        return "nothing in it depends on the sky, the atmosphere or the noise"
    return ""


def _walk(
    steps: Sequence[Operator],
    wanted: frozenset[str],
    keep: Collection[str],
) -> tuple[set[str], dict[str, str]]:
    """Labels of the steps of a signal that are needed, going back from its end, and why each of the
    others is omitted.
    """
    read = {name for name in wanted if is_stream(name)}
    needed: set[str] = set()
    left_out: dict[str, str] = {}
    for k, operator in reversed([*enumerate(steps)]):
        made = operator.provides
        before = steps[:k]
        names = " or ".join(sorted(made))
        if operator.label not in keep and not made & read:
            ends = MAIN in made and type(operator).finalize is not Operator.finalize
            if made and all(map(is_stream, made)) and not ends:
                left_out[operator.label] = f"no step that is needed reads {names}"
                continue
            products = makes_products(operator) and not changes_observations(operator)
            if products and not made & wanted:
                left_out[operator.label] = f"no step writes or draws its {names}"
                continue
        needed.add(operator.label)
        # of what it reads and writes, and of what others above make too, those above still matter
        above = operator.requires.union(*(o.provides for o in before))
        read -= {name for name in made - above if is_stream(name)}
        read |= operator.requires | operator.optional
        if forms(operator):  # of whatever components it finds
            read |= {name for o in before for name in o.provides if isinstance(name, Component)}
    return needed, left_out


def _products(operator: Operator) -> set[str]:
    """Names that it provides besides streams and the pointing."""
    return {name for name in operator.provides if name != "boresight" and not is_stream(name)}


def _makes_something(operator: Operator, wanted: Collection[str]) -> bool:
    """True if it makes a product that is wanted, or something that is not known."""
    made = _products(operator)
    if not operator.provides:
        return not changes_observations(operator)
    return bool(made and (not makes_products(operator) or not made.isdisjoint(wanted)))


def steps_of(pipeline: Pipeline, name: str) -> list[Operator]:
    """The steps that act on a signal (empty: the complete one)."""
    signals = pipeline.signals
    if not name:
        return signals.steps
    signal = signals.all[name]
    made = signals.makers(name)
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
    parts = pipeline.signals.remainders.items()
    return {name: remainder(of) for name, of in parts if {name, *of} <= kept}


def chain_of(pipeline: Pipeline, structure: Structure) -> Chain:
    """Steps and signals of each observation."""
    signals = pipeline.signals
    formed = [name for name in ["", *structure.runs] if name not in structure.derived]
    acting = [o for o in pipeline.operators if o.label in structure.operators]
    return Chain(
        acting_steps(acting),
        tuple(signals.all[name] for name in formed),
        signals.components,
    )


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
    signals = pipeline.signals
    operators = pipeline.operators
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
