"""An ordered list of operators: checked before it runs, then run over every observation."""

from __future__ import annotations

import copy
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from . import ahead as preparation
from .ahead import Ahead
from .configuration.parameters import Parameters
from .data import Data, Observation, Tally, html_table
from .derived import Packed, derivable, derivation, subtract
from .errors import PipelineError
from .execution import Execution, Settings, Timer
from .forecast import room
from .frozen import Frozen
from .machine import available_memory, available_threads, resident_memory
from .operator import Operator
from .same_air import TRANSMISSION, SameAir
from .sky_signal import SkySignal, place_of_signal

if TYPE_CHECKING:
    from .scene import Scene


class Companion(Parameters):
    """A companion run: the same pipeline and random numbers with some signal components absent."""

    only: list[str] | None = Field(None, min_length=1)
    """Components to keep (e.g. [sky]: the noiseless run); all others are left out."""
    without: list[str] | None = Field(None, min_length=1)
    """Components to leave out (e.g. [sky]: the source-free run)."""
    modes: Literal["own", "full"] = "own"
    """Singular modes of filters: those of this run's own data (`own`: the noiseless run), or those of the complete data (`full`:
    with the main run's modes, flags, weights and transmission of the air all is linear, and what is left of each part adds up to
    the main run; of two runs that are its parts one need not be simulated, see `core.derived`)."""
    filters: Literal["all", "none"] = "all"
    """`none`: leave out every step that changes the signal once it is formed."""

    @model_validator(mode="after")
    def _one_of_two(self) -> Companion:
        if (self.only is None) == (self.without is None):
            raise ValueError("give either only or without")
        return self

    def keeps(self, provides: frozenset[str]) -> bool:
        """Whether an operator that provides these components takes part."""
        if self.only is not None:
            return bool(provides & set(self.only))
        return not provides & set(self.without or ())


@dataclass
class Part:
    """Some of the scans of a run, whose products stay unfinished, to be combined with those of other parts (`core.campaign`).

    Attributes
    ----------
    scans
        Positions of the scans; None: all.
    layouts
        By label: what `Operator.agree` found for all scans of all parts.
    first
        Whether the very first scan is among them.
    packed
        By run and label: what `Operator.pack` took out. Filled by `Pipeline.run`.
    """

    scans: Sequence[int] | None = None
    layouts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    first: bool = True
    packed: dict[str, dict[str, Mapping[str, Any]]] = field(default_factory=dict)

    def take(self, operator: Operator, data: Data) -> None:
        """Pack one operator's products of the run in progress."""
        found = operator.pack(data, self.first)
        if found is not None:
            self.packed.setdefault(data.run, {})[operator.label] = found


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
        later = {what: type(o).__name__ for o in reversed(operators[index + 1 :]) for what in o.provides}
        for what in sorted(operator.requires - have):
            if what in later:
                problems.append(
                    OrderProblem(
                        index, f"{name} needs {what}, which {later[what]} provides only later", f"move it below {later[what]}"
                    )
                )
            else:
                problems.append(
                    OrderProblem(index, f"{name} needs {what}, which no step provides", f"add a step that provides {what} above")
                )
        for what in sorted((operator.optional - operator.requires) & set(later)):
            if not operator.at_end:
                problems.append(
                    OrderProblem(
                        index, f"{later[what]} provides {what} only after {name} has used it", f"move {name} below {later[what]}"
                    )
                )
        if operator.couples == "all" and len(operator.requires - {"boresight"}) != 1:
            problems.append(
                OrderProblem(
                    index,
                    f"{name} couples all samples but requires {len(operator.requires)} streams",
                    "it must require exactly one",
                )
            )
        have |= operator.provides
    if operators and not any("boresight" in o.provides | o.requires for o in operators):
        problems.append(OrderProblem(0, "no step points the telescope", "begin with a pointing step, e.g. PointingDaisy"))
    return problems


class Pipeline:
    """Operators in the order in which they act.

    Parameters
    ----------
    operators
        The steps. Namesakes are numbered (``WhiteNoise``, ``WhiteNoise.2``).
    runs
        Companion runs by name, e.g. ``{"noiseless": {"only": ["sky"]}, "source_free": {"without": ["sky"]}}``.
    name, description
        Shown in products.
    precision
        Type of the time streams. float32 carries fluctuations of some kelvin to 1e-7 K (the mean emission is kept apart in
        float64); float64 is for common modes 1e6 times the signal.

    Raises
    ------
    PipelineError
        When a step's inputs are missing or come too late; the message names every such step.
    """

    def __init__(
        self,
        operators: Iterable[Operator],
        *,
        runs: Mapping[str, Companion | Mapping[str, Any]] | None = None,
        name: str = "pipeline",
        description: str = "",
        precision: Literal["float32", "float64"] = "float32",
    ) -> None:
        self.operators = [o.model_copy() for o in operators]  # labels are this pipeline's own
        self.runs = {k: v if isinstance(v, Companion) else Companion.model_validate(v) for k, v in (runs or {}).items()}
        self.name, self.description, self.precision = name, description, precision
        self._name_steps()
        if problems := check_order(self.operators):
            lines = [f"step {p.index + 1}: {p.message} ({p.label})" for p in problems]
            raise PipelineError("\n".join(lines), place=self.name)
        self._check_runs()
        self._add_needed_runs()
        self.derived = derivable(self, tuple(self.runs))
        """Companion runs that are derived from the main run and these others, if the operators find nothing against it."""

    def _name_steps(self) -> None:
        seen: dict[str, int] = {}
        for operator in self.operators:
            base = operator.name or type(operator).__name__
            seen[base] = seen.get(base, 0) + 1
            operator._label = base if seen[base] == 1 else f"{base}.{seen[base]}"

    def _check_runs(self) -> None:
        for name, companion in self.runs.items():
            if not name.isidentifier() or name.startswith("_"):
                cure = "use letters, digits and underscores, the first a letter"
                raise PipelineError(f"{name!r} cannot name a run", place=self.name, cure=cure)
            self._check_components(companion, f"run {name} names")
            self._check_frozen(name)

    def _check_components(self, companion: Companion, who: str) -> None:
        components = sorted(set().union(*(o.provides for o in self._generators())))
        for what in [*(companion.only or ()), *(companion.without or ())]:
            if what not in components:
                cure = f"choose from: {', '.join(components)}"
                raise PipelineError(f"{who} {what!r}, which no step provides", place=self.name, cure=cure)

    def _check_frozen(self, name: str) -> None:
        if self.runs[name].modes == "own":
            return
        for operator in self._selected(name):
            if operator.couples == "all" and not operator.can_freeze:
                raise PipelineError(
                    f"run {name} has modes: full, but {operator.label} cannot freeze what it measures",
                    place=self.name,
                    cure=f"leave modes: full out, or give {type(operator).__name__} freeze and measure_frozen (docs/plugins.md)",
                )

    def _add_needed_runs(self) -> None:
        """Find for each step the runs that it reads, see `Operator.needs`; add those that are not there."""
        for operator in self.operators:
            names = []
            for wanted in operator.needs():
                self._check_components(wanted, f"{operator.label} needs")
                kind = self._kind(wanted)
                same = [name for name, run in self.runs.items() if self._kind(run) == kind]
                if kind == self._kind(None):
                    names.append("")
                elif same:
                    names.append(same[0])
                else:
                    parts = [*(wanted.only or ["without", *(wanted.without or ())])]
                    parts += ["unfiltered"] * (wanted.filters == "none") + ["full"] * (wanted.modes == "full")
                    names.append("_" + "_".join(parts))
                    self.runs[names[-1]] = wanted
                    self._check_frozen(names[-1])
            operator._runs = tuple(names)

    def _kind(self, run: Companion | None) -> tuple[frozenset[str], frozenset[str], bool]:
        """What tells runs apart: steps of components, filters, whether modes are the complete data's. None: the main run."""
        makers, filters = self._generators(), self._filters()
        kept = frozenset(o.label for o in makers if run is None or run.keeps(o.provides))
        frozen = run is not None and run.modes == "full" and len(kept) < len(makers)
        labels = frozenset(o.label for o in filters if run is None or run.filters == "all")
        differ = any(o.couples == "all" or (TRANSMISSION in o.provides and o.label not in kept) for o in self.operators)
        return kept, labels, frozen and differ

    def is_frozen(self, run: str) -> bool:
        """Whether a companion run takes singular modes from the main run (empty: the main run itself, which never does)."""
        return bool(run) and self._kind(self.runs[run])[2]

    def components(self, run: str) -> frozenset[str]:
        """Labels of the steps whose components a run keeps."""
        return self._kind(self.runs[run] if run else None)[0]

    def _filters(self) -> list[Operator]:
        """The operators that change the signal."""
        return [o for o in self.operators if "signal" in o.requires & o.provides]

    def _generators(self) -> list[Operator]:
        """The operators that make signal components: those before `signal` is formed, pointing aside."""
        found = []
        for operator in self.operators:
            if "signal" in operator.provides | operator.requires:
                break
            if operator.provides and "boresight" not in operator.provides:
                found.append(operator)
        return found

    def _selected(self, run: str) -> list[Operator]:
        steps = [o for o in self.operators if not o.at_end and "boresight" not in o.provides]
        if place_of_signal(self.operators) is not None:
            steps.insert(place_of_signal(steps) or 0, SkySignal())
        if not run:
            return steps
        companion = self.runs[run]
        dropped = {o.label for o in self._generators() if not companion.keeps(o.provides)}
        if companion.filters == "none":
            dropped |= {o.label for o in self._filters()}
        found: list[Operator] = []
        for operator in steps:
            if operator.main_run_only:
                continue
            if operator.label not in dropped:
                found.append(operator)
            elif companion.modes == "full" and TRANSMISSION in operator.provides - {*(companion.without or ())}:
                found += [operator, SameAir.behind(operator)]
        return found

    @property
    def order(self) -> list[str]:
        """The runs in the order in which they are made: the main run (empty), what is simulated, what is derived."""
        return ["", *(r for r in self.runs if r not in self.derived), *self.derived]

    def run(
        self,
        scene: Scene,
        *,
        output: str | Path | None = None,
        threads: int | None = None,
        memory: int | None = None,
        ceiling: int | None = None,
        keep: Sequence[str] = (),
        provenance: Mapping[str, Any] | None = None,
        part: Part | None = None,
    ) -> Data:
        """Observe the scene and return what came out.

        Parameters
        ----------
        scene
            What exists.
        output
            Folder for files; None: operators that write are refused (see `SaveMap`).
        threads
            Threads; default: the CPUs this process may use. Results do not depend on it.
        memory
            Bytes for streams and blocks; default: what the ceiling leaves. Results do not depend on it.
        ceiling
            Bytes that the process may hold (``--memory``); default, where no ``memory`` is given: what it holds now and half
            of the free memory. A run that would not fit is refused before it starts.
        keep
            Streams to keep in ``observation.detdata`` (float64, mean emission included) as they stand after the last step.
        provenance
            Entries added to ``data.provenance``.
        part
            Run some of the scans only and pack their products instead of finishing them; nothing acts at the end.
        """
        from .files import check_output_folder
        from .hooks import manager

        hooks = manager().hook
        data = Data(scene=scene, output=None if output is None else Path(output))
        if data.output is not None and part is None:  # a part makes a folder only when it writes there
            check_output_folder(data.output)
        data.provenance = {**self._provenance(scene), **(provenance or {})}
        settings = Settings(
            threads=threads or available_threads(),
            memory=memory or available_memory() // 2,  # less, once the operators have said what they hold
            dtype=np.float64 if self.precision == "float64" else np.float32,
            progress=lambda done, total, what: hooks.zonda_progress(done=done, total=total, what=what),
        )
        data.threads = settings.threads
        listeners = hooks.zonda_before_operator.get_hookimpls() or hooks.zonda_after_operator.get_hookimpls()
        ahead = Ahead(settings.threads > 1 and not listeners)  # who listens hears of one observation after the other
        timer = Timer()
        hooks.zonda_pipeline_start(pipeline=self, data=data)
        for operator in self.operators:
            timer.add(operator.label, "observe", 0.0)  # rows in the order of the steps
        for operator in sorted(self.operators, key=lambda o: not o.at_end):  # what only acts at the end may refuse at once
            start = time.thread_time()
            if part is None or not (operator.at_end or operator.label in part.layouts):
                operator.observe(data)  # pointing steps append observations; map makers lay out the grid of all of them
            elif operator.label in part.layouts:
                operator.lay_out(part.layouts[operator.label])
            timer.add(operator.label, "observe", time.thread_time() - start)
        if not data.observations:
            raise PipelineError("the pointing steps made no observation", place=self.name, cure="ask for at least one scan")
        if part is not None and part.scans is not None:
            data.observations = [data.observations[k] for k in part.scans]
        if part is None:
            self._meanwhile(data, "pointing")
        self._keep_to(ceiling, memory, data, settings, ahead)
        make = _Runs(self, data, keep, hooks, settings, timer, ahead, part is None)
        kept: dict[str, Packed] = {}
        try:
            for run in self.order:
                data.run = run
                if not self._derive(run, data, kept, make.kept_out):
                    make(run)
                if run in self._parts():
                    kept[run] = self._packed(run, data)
                for operator in self._selected(run):
                    if part is None:
                        self._finalize(operator, data, timer, hooks)
                    else:
                        part.take(operator, data)
                if part is None:
                    self._meanwhile(data, "run")
        finally:
            ahead.close()
        data.run = ""
        make.leave_main()
        if part is None:
            self._meanwhile(data, "runs")
        for operator in self.operators:
            if operator.at_end and part is None:
                data.provenance["timings"] = timer.rows()  # a report knows of the steps before it
                self._finalize(operator, data, timer, hooks)
        data.provenance["timings"] = timer.rows()
        hooks.zonda_pipeline_end(pipeline=self, data=data)
        return data

    def _parts(self) -> set[str]:
        """Runs from which others are derived."""
        return {"", *(p for parts in self.derived.values() for p in parts)} if self.derived else set()

    def _packed(self, run: str, data: Data) -> Packed:
        """A copy of the partial products of the run in progress, of the operators that can subtract them."""
        found = {}
        for operator in self._selected(run):
            if type(operator).subtract is not Operator.subtract and (packed := operator.pack(data, True)) is not None:
                operator.merge(data, packed)
                found[operator.label] = packed
        return found

    def _derive(self, run: str, data: Data, kept: Mapping[str, Packed], kept_out: frozenset[str]) -> bool:
        """Make the partial products of a run from those of others; False where it must be simulated.

        ``kept_out``: labels of the steps that left out single samples of the main run. One that cannot tell what others did with
        them (no `Operator.subtract`) is not linear.
        """
        if run not in self.derived:
            return False
        parts = self.derived[run]
        unlike = [o for o in self._selected(run) if o.label in kept_out and type(o).subtract is Operator.subtract]
        found = None if unlike else subtract(self, run, kept[""], [kept[p] for p in parts])
        if found is None:
            data.tally.state(run, "simulated", f"{derivation(parts)} would not do: their samples differ")
            return False
        for operator in self._selected(run):
            if operator.label in found:
                operator.merge(data, found[operator.label])
        data.tally.state(run, "derived as", derivation(parts))
        return True

    def pack(self, data: Data, first: bool) -> dict[str, dict[str, Mapping[str, Any]]]:
        """The partial products in ``data``, by run and label."""
        part = Part(first=first)
        for run in self.order:
            data.run = run
            for operator in self._selected(run):
                part.take(operator, data)
        data.run = ""
        return part.packed

    def merge(self, data: Data, packed: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
        """Add the partial products of a part to ``data``."""
        for run in self.order:
            data.run = run
            for operator in self._selected(run):
                if (found := packed.get(run, {}).get(operator.label)) is not None:
                    operator.merge(data, found)
        data.run = ""

    def finish(self, data: Data) -> Data:
        """Finish merged products, and let the operators act that act at the end."""
        from .hooks import manager

        hooks, timer = manager().hook, Timer()
        hooks.zonda_pipeline_start(pipeline=self, data=data)
        for run in self.order:
            data.run = run
            for operator in self._selected(run):
                self._finalize(operator, data, timer, hooks)
            self._meanwhile(data, "run")
        data.run = ""
        self._meanwhile(data, "runs")
        for operator in self.operators:
            if operator.at_end:
                self._finalize(operator, data, timer, hooks)
        hooks.zonda_pipeline_end(pipeline=self, data=data)
        return data

    def _keep_to(self, ceiling: int | None, memory: int | None, data: Data, settings: Settings, ahead: Ahead) -> None:
        """Divide what the process may hold; refuse what does not fit."""
        if ceiling is None and memory is not None:
            return
        budget = ceiling or resident_memory() + available_memory() // 2
        left, products = room(self._selected(""), data.observations, settings, budget, self.name)
        settings.memory = min(left, memory or left)
        if parts := self._parts():  # what runs are derived from is kept until then
            longest = max(data.observations, key=lambda o: o.n_detectors * o.n_samples)
            summed = [o for o in self._selected("") if type(o).subtract is not Operator.subtract]
            kept = min(len(parts) * sum(o.memory(longest) for o in summed), left // 2)
            settings.memory, products = settings.memory - kept, products + kept
        if ahead.on and len(data.observations) > 1:
            size = preparation.affordable(self._selected(""), data.observations, settings)
            ahead.on = size is not None
            settings.memory, products = settings.memory - (size or 0), products + (size or 0)
        settings.ceiling = budget - products

    def _meanwhile(self, data: Data, done: Literal["pointing", "scan", "run", "runs"]) -> None:
        for operator in self.operators:
            if operator.at_end:
                operator.meanwhile(data, done)

    def _finalize(self, operator: Operator, data: Data, timer: Timer, hooks: Any) -> None:
        hooks.zonda_before_operator(operator=operator, observation=None, stage="finalize")
        start = time.thread_time()
        operator.finalize(data)
        used = time.thread_time() - start
        timer.add(operator.label, "finalize", used)
        hooks.zonda_after_operator(operator=operator, observation=None, stage="finalize", seconds=used)

    def _provenance(self, scene: Scene) -> dict[str, Any]:
        return {
            "name": self.name,
            "description": self.description,
            "seed": scene.seed,
            "precision": self.precision,
            "runs": {k: self.runs[k].model_dump(exclude_none=True, exclude_defaults=True) for k in self.order[1:]},
            "versions": versions(),
            "operators": [
                (o.label, type(o).__name__, {k: str(v) for k, v in o.model_dump(mode="json", exclude_none=True).items()})
                for o in self.operators
            ],
        }

    def __repr__(self) -> str:
        return f"<Pipeline {self.name}: {' > '.join(o.label for o in self.operators)}>"

    def _repr_html_(self) -> str:
        return html_table(f"Pipeline {self.name}", [(o.label, repr(o)) for o in self.operators])


class _Runs:
    """Simulates runs, one after the other, over all observations: `Pipeline.run`."""

    def __init__(
        self,
        pipeline: Pipeline,
        data: Data,
        keep: Sequence[str],
        hooks: Any,
        settings: Settings,
        timer: Timer,
        ahead: Ahead,
        whole: bool,
    ) -> None:
        self._pipeline, self._data, self._keep, self._hooks = pipeline, data, keep, hooks
        self._settings, self._timer, self._ahead, self._whole = settings, timer, ahead, whole
        self._pristine = [(o.focalplane, o.flags, o.detector_flags) for o in data.observations]
        freeze = any(run.modes == "full" for run in pipeline.runs.values())
        self._frozen = [Frozen() if freeze else None for _ in data.observations]
        self._main = list(self._pristine)
        self._following: Execution | None = None
        """What is begun of the next scan, or of the first scan of the next run."""

    def __call__(self, run: str) -> None:
        """One run; what comes next is prepared meanwhile."""
        data, hooks = self._data, self._hooks
        for number, observation in enumerate(data.observations, 1):
            execution = self._following or self._begin(run, number - 1, observation)
            observation = data.observations[number - 1] = execution.observation
            last = number == len(data.observations)
            self._following = self._next_run(run) if last else self._begin(run, number, data.observations[number])
            execution.run(data, hooks.zonda_before_operator, hooks.zonda_after_operator, self._ahead, self._following)
            data.tally.update(observation.tally, prefix=f"{run}/" if run else "")
            if not run:
                self._main[number - 1] = observation.focalplane, observation.flags, observation.detector_flags
            if self._whole:
                self._pipeline._meanwhile(data, "scan")

    @property
    def kept_out(self) -> frozenset[str]:
        """Labels of the steps that left out single samples of the main run."""
        return frozenset().union(*(found.kept_out for found in self._frozen if found))

    def leave_main(self) -> None:
        """Let observations carry what the main run left of detectors and flags."""
        for observation, found in zip(self._data.observations, self._main, strict=True):
            observation.focalplane, observation.flags, observation.detector_flags = found

    def _next_run(self, run: str) -> Execution | None:
        """The first scan of the run after this one, unless it is the scan that is being executed, or is probably derived.

        A copy of it: until this run is finished, operators find there what this run left.
        """
        order = self._pipeline.order
        later = order[order.index(run) + 1 :]
        if len(self._data.observations) < 2 or not later or later[0] in self._pipeline.derived:
            return None
        return self._begin(later[0], 0, copy.copy(self._data.observations[0]))

    def _begin(self, run: str, number: int, observation: Observation) -> Execution:
        focalplane, flags, detector_flags = self._pristine[number]
        before, observation.tally = observation.tally, Tally()
        if not run:
            observation.tally.update(before)  # what pointing steps said belongs to the scan, and to its files
        observation.focalplane, observation.smooth = focalplane.copy(), {}
        observation.output = self._data.output
        observation.flags, observation.detector_flags = flags.copy(), detector_flags.copy()
        kept = self._frozen[number] if not run or self._pipeline.runs[run].modes == "full" else None
        steps, keep = self._pipeline._selected(run), self._keep if not run else ()
        return Execution(steps, observation, self._settings, self._timer, keep, kept)


def versions() -> dict[str, str]:
    """Versions of everything that can change a number."""
    import platform

    found = {"python": platform.python_version(), "machine": platform.machine()}
    for package in ("zonda", "numpy", "scipy", "astropy", "astropy-iers-data", "numba", "healpy", "h5py"):
        installed = _version(package)
        if installed is not None:
            found[package] = installed
    return found


@cache
def _version(package: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None
