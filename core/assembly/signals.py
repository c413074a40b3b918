"""Signals that a pipeline makes, of which components, the steps that make them, and which of them
follow from others.

With the complete data's modes and the same transmission of the atmosphere (``modes: full``) a
pipeline of linear steps is a linear map L of the components. For a signal of the components C and
others of P_1, P_2 ..., which together are all the rest,

    L(C) = L(all) - L(P_1) - L(P_2) - ...                                                        (1)

Such a *remainder* is neither formed nor filtered: its sums in the pixels of a map are those of the
complete signal minus those of the others, exactly.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

from ..configuration.diagnostics import nearest
from ..errors import PipelineError
from ..mapmaker import MapMaker, acts, changes_components, filters, forms, with_calibrated_signal
from ..observation import Observation
from ..operator import Operator
from ..output import Output
from ..signal import (
    BUILT_IN,
    MAIN,
    TRANSMISSION,
    Component,
    Formed,
    Signal,
    can_be_named,
    is_signal,
    needed_name,
    stream_of,
)

MOST_PARTS = 4
"""Signals that may be taken from the complete one: each adds its rounding."""

COMPLETE = (Formed(MAIN, frozenset()),)
"""The complete signal alone."""


@dataclass(frozen=True)
class Chain:
    """The steps that act on an observation, and the signals that they make.

    Attributes
    ----------
    steps
        In order.
    signals
        Those that are formed, the complete one first.
    components
        Names of all streams that become part of a signal.
    keep
        Streams that the user asked for.
    """

    steps: Sequence[Operator]
    signals: tuple[Formed, ...] = COMPLETE
    components: frozenset[str] = frozenset()
    keep: tuple[str, ...] = ()

    def expanded(self, names: Collection[str]) -> frozenset[str]:
        """Names of streams, with those of all signals in place of ``signal``."""
        return (
            frozenset(names) | {s.stream for s in self.signals}
            if MAIN in names
            else frozenset(names)
        )

    @property
    def read(self) -> frozenset[str]:
        """Names of the streams that are needed: what `Operator.exec` or `Operator.measure` reads,
        and what is kept.
        """
        names = frozenset(self.keep)
        for step in self.steps:
            if type(step).exec is not Operator.exec or type(step).measure is not Operator.measure:
                names |= (
                    self.of(step, self.signals) if forms(step) else step.requires | step.optional
                )
        return self.expanded(names - {"boresight"})

    def of(self, step: Operator, signals: Collection[Formed]) -> frozenset[str]:
        """Names of the streams that a step which forms signals reads for these."""
        unknown = not self.components
        parts = frozenset[str]().union(*(s.components for s in signals))
        return frozenset(
            n
            for n in step.requires | step.optional | parts
            if unknown or n in parts or n not in self.components
        )

    def needed_for(self, signals: Collection[Formed], *, filtered: bool) -> list[Operator]:
        """The steps that form signals, those that filter them if so wanted, and those that make
        what these read.
        """
        found: list[Operator] = []
        names = frozenset[str]()
        for step in reversed(self.steps):
            if forms(step) or (filtered and filters(step)):
                names |= self.of(step, signals)
            elif step.provides & names:
                names |= step.requires | step.optional
            else:
                continue
            found.insert(0, step)
        return found


class Signals:
    """The signals of a pipeline.

    Parameters
    ----------
    operators
        The pipeline's steps, named.
    runs
        Signals by name, those of the pipeline file. What outputs need (`Output.signals`) is added.
    only
        Components that the complete signal is narrowed to (``--only``); empty: all.
    place
        The pipeline's name, for errors.

    Raises
    ------
    PipelineError
        For a signal that cannot be made of these steps.

    Attributes
    ----------
    all
        By name (empty: the complete one).
    formed
        Those that are made of their components, the complete one first.
    remainders
        By name of the others: the names of the signals that are taken from the complete one,
        equation (1).
    not_linear
        Label of the first filter that is not linear; empty: all are. From there on signals with
        ``modes: full`` have modes of their own, and there are no remainders.
    """

    def __init__(
        self,
        operators: Sequence[Operator],
        runs: Mapping[str, Signal],
        only: Sequence[str],
        place: str,
    ) -> None:
        self.operators = list(operators)
        self.runs = dict(runs)
        self._place = place
        self._generators = _generators(operators)
        former = next((o for o in operators if forms(o)), None)
        self._inputs = (
            frozenset[str]()
            if former is None
            else (former.requires | former.optional) - {"boresight"}
        )
        self.components = frozenset[Component]().union(
            *(self.components_of(o) for o in self._generators)
        )
        self._only = Signal(only=list(only)) if only else None
        for name, signal in self.runs.items():
            if not can_be_named(name):
                cure = "use letters, digits and underscores, the first a letter"
                raise PipelineError(f"{name!r} cannot name a signal", place=place, cure=cure)
            self._check_components(signal, f"signal {name} names")
        if self._only:
            self._check_components(self._only, "--only names")
            self.runs = {name: s for name, s in self.runs.items() if self._is_left(s)}
        self._add_needed(runs)
        changing = [o for o in operators if filters(o)]
        self.not_linear = next((o.label for o in changing if not o.linear), "")
        labels = [o.label for o in changing]
        self._own = frozenset(labels[labels.index(self.not_linear) :] if self.not_linear else ())
        self.all = {
            name: self._formed(name, signal) for name, signal in [("", None), *self.runs.items()]
        }
        self.remainders = {} if self.not_linear else self._remainders()
        self.formed = tuple(f for name, f in self.all.items() if name not in self.remainders)

    # ---- steps

    @property
    def steps(self) -> list[Operator]:
        """The operators that act on observations, in order."""
        return acting_steps(self.operators)

    def makers(self, name: str) -> frozenset[str]:
        """Labels of the steps whose components a signal consists of."""
        signal = self.runs[name] if name else None
        return frozenset(o.label for o in self._generators if self._keeps(signal, o))

    def components_of(self, operator: Operator) -> frozenset[Component]:
        """The components that a step makes: those of `core.signal`, and what the step that forms
        the signal reads.
        """
        known = {*BUILT_IN, *(c for c in operator.provides if isinstance(c, Component))}
        made = operator.provides & (known | self._inputs)
        named = {c: c for c in known}
        found = (named.get(name) or Component(name) for name in made)  # type: ignore[call-overload]
        return frozenset(found)

    def check_kept(self, streams: Sequence[str]) -> None:
        """Refuse to keep a stream that no step makes, or a signal that has none."""
        made = [formed.stream for formed in self.formed]
        others = frozenset[str]().union(*(o.provides for o in self.operators))
        for stream in streams:
            if stream in made or stream == MAIN or stream in others:
                continue
            if not is_signal(stream):
                have = sorted({*made, *self.components})
                cure = nearest(stream, have) or f"there are: {', '.join(have)}"
                raise PipelineError(
                    f"the stream {stream!r} cannot be kept: no step makes it",
                    place=self._place,
                    cure=cure,
                )
            parts = self.remainders.get(stream.partition("/")[2], ())
            what = "there is no such signal"
            cure = nearest(stream, made) or f"choose from: {', '.join(made)}"
            if parts:
                what = f"it is {remainder(parts)}, in the maps alone"
                cure = (
                    f"keep {' and '.join([MAIN, *(stream_of(part) for part in parts)])}, and"
                    " subtract"
                )
            raise PipelineError(
                f"the stream {stream!r} cannot be kept: {what}",
                place=self._place,
                cure=cure,
            )

    # ---- what a signal is

    def _keeps(self, signal: Signal | None, operator: Operator) -> bool:
        within = self._only is None or self._only.keeps(operator.provides)
        return within and (signal is None or signal.keeps(operator.provides))

    def _formed(self, name: str, signal: Signal | None) -> Formed:
        kept = [o for o in self._generators if self._keeps(signal, o)]
        components = frozenset[Component]().union(*(self.components_of(o) for o in kept))
        model = signal is not None and signal.modes == "full"
        if signal is not None and model and TRANSMISSION not in (signal.without or ()):
            components |= {c for c in self.components if c == TRANSMISSION}
        filtered = signal is None or signal.filters == "all"
        return Formed(
            stream_of(name),
            components,
            model and len(kept) < len(self._generators),
            filtered,
            self._own,
        )

    def _is_left(self, signal: Signal) -> bool:
        """Tell whether a signal is another than the narrowed complete one, and not empty."""
        kept = [o for o in self._generators if self._keeps(signal, o)]
        every = [o for o in self._generators if self._keeps(None, o)]
        return bool(kept) and (len(kept) < len(every) or signal.filters == "none")

    def _check_components(self, signal: Signal, who: str) -> None:
        for what in [*(signal.only or ()), *(signal.without or ())]:
            if what not in self.components:
                cure = (
                    nearest(what, sorted(self.components))
                    or f"choose from: {', '.join(sorted(self.components))}"
                )
                raise PipelineError(
                    f"{who} {what!r}, which no step provides",
                    place=self._place,
                    cure=cure,
                )

    def _add_needed(self, given: Mapping[str, Signal]) -> None:
        """Find for each output the signals that it reads; add those that are not there. ``given``:
        those of the pipeline.
        """
        for operator in self.operators:
            if not isinstance(operator, Output):
                continue
            for name in {*operator.named_signals()} - {"", *given}:
                cure = (
                    nearest(name, sorted(given))
                    or f"add it to runs, e.g. `runs: {{{name}: {{without: [sky]}}}}`"
                )
                raise PipelineError(
                    f"{operator.label} reads the signal {name!r}, which is not among runs",
                    place=self._place,
                    cure=cure,
                )
            names = []
            for wanted in operator.signals():
                self._check_components(wanted, f"{operator.label} needs")
                kind = self._kind(wanted)
                same = [name for name, signal in self.runs.items() if self._kind(signal) == kind]
                if kind == self._kind(None):
                    names.append("")
                elif same:
                    names.append(same[0])
                else:
                    names.append(needed_name(wanted))
                    self.runs[names[-1]] = wanted
            operator._shown = tuple(names)

    def _kind(self, signal: Signal | None) -> tuple[frozenset[str], bool, bool]:
        """Features that distinguish signals: steps of components, filters, whether modes and
        transmission are the complete data's.
        """
        kept = frozenset(o.label for o in self._generators if self._keeps(signal, o))
        changing = [o for o in self.operators if filters(o) or _weighs(o)]
        filtered = signal is None or signal.filters == "all" or not changing
        full = signal is not None and signal.modes == "full" and len(kept) < len(self._generators)
        gone = any(TRANSMISSION in o.provides and o.label not in kept for o in self._generators)
        return kept, filtered, full and (gone or any(o.couples == "all" for o in changing))

    # ---- remainders

    def _remainders(self) -> dict[str, tuple[str, ...]]:
        makers = [o for o in self.operators if isinstance(o, MapMaker)]
        if not all(o.linear for o in makers) or not all(
            o.linear for o in self.operators if forms(o)
        ):
            return {}
        every = self.makers("")
        made = {name: self.makers(name) for name in self.runs if self._fits(name)}
        found: dict[str, tuple[str, ...]] = {}
        taken: set[str] = set()
        for name in sorted(made, key=lambda n: -len(made[n])):
            if name in taken:
                continue
            rest = every - made[name]
            others = [
                other
                for other in made
                if other != name and other not in found and made[other] <= rest
            ]
            for parts in (p for n in range(1, MOST_PARTS + 1) for p in combinations(others, n)):
                if (
                    sum(len(made[p]) for p in parts) == len(rest)
                    and frozenset().union(*(made[p] for p in parts)) == rest
                ):
                    found[name] = parts
                    taken.update(parts)
                    break
        return found

    def _fits(self, name: str) -> bool:
        """Tell whether a signal is a term of equation (1)."""
        signal = self.runs[name]
        kept = self.makers(name)
        names_it = TRANSMISSION in [*(signal.only or ()), *(signal.without or ())]
        narrowed = self._only is not None
        whole = kept == self.makers("")
        return (
            signal.modes == "full"
            and signal.filters == "all"
            and not names_it
            and bool(kept)
            and not whole
            and not narrowed
        )


def _weighs(operator: Operator) -> bool:
    """Tell whether a step is a map maker that does more than to average."""
    return isinstance(operator, MapMaker) and not operator.averages


def acting_steps(operators: Sequence[Operator], keep: Iterable[str] = ()) -> list[Operator]:
    """The operators that act on observations, and a `CalibratedSignal` where none of them forms a
    signal that one reads or that is to be kept.
    """
    return with_calibrated_signal([o for o in operators if acts(o)], any(map(is_signal, keep)))


def note_signals(
    observations: Iterable[Observation],
    components: Iterable[str],
    formed: Iterable[Formed],
) -> None:
    """Note in observations which components there are and which signals are formed."""
    formed = list(formed)
    names = frozenset(components)
    streams = tuple(sorted(signal.stream for signal in formed))
    unfiltered = frozenset(signal.stream for signal in formed if not signal.filtered)
    for observation in observations:
        observation.components, observation.signals, observation.unfiltered = (
            names,
            streams,
            unfiltered,
        )


def _generators(operators: Sequence[Operator]) -> list[Operator]:
    """The steps that make components: those before ``signal`` is formed."""
    found = []
    for operator in operators:
        if MAIN in operator.provides | operator.requires:
            break
        if operator.provides - {"boresight"} and not changes_components(operator):
            found.append(operator)
    return found


def remainder(parts: Sequence[str]) -> str:
    """Description of a remainder, e.g. ``the complete signal minus noiseless``."""
    return f"the complete signal minus {' and '.join(parts)}"
