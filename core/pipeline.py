"""An ordered list of operators: checked before it runs, then run over every observation."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from .data import Data, Observation
from .errors import PipelineError
from .faults import faults_named
from .machine import available_memory, available_threads
from .notebook import html_table
from .operator import Operator
from .run import arguments
from .run.ahead import Ahead
from .run.companion import Companion
from .run.derived import Derivation, derivable, parts_of
from .run.memory_budget import divide
from .run.order import check_order
from .run.selection import Selection
from .run.settings import Settings, Timer
from .run.simulation import Simulation
from .versions import versions

if TYPE_CHECKING:
    from .scene import Scene


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
    prefix
        Of the names of the scans: what makes them unique among all parts.
    packed
        By run and label: what `Operator.pack` took out. Filled by `Pipeline.run`.
    """

    scans: Sequence[int] | None = None
    layouts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    first: bool = True
    prefix: str = ""
    packed: dict[str, dict[str, Mapping[str, Any]]] = field(default_factory=dict)

    def name(self, observations: Sequence[Observation]) -> None:
        """Give scans that a pointing step has just made their unique names, before other steps see them."""
        for observation in observations:
            observation.name = self.prefix + observation.name

    def take(self, operator: Operator, data: Data) -> None:
        """Pack one operator's products of the run in progress."""
        found = operator.pack(data, self.first)
        if found is not None:
            self.packed.setdefault(data.run, {})[operator.label] = found


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
        self.operators = arguments.steps(operators, name)  # copies: labels are this pipeline's own
        self.runs = arguments.runs(runs, name)
        self.name, self.description, self.precision = name, description, arguments.precision(precision, name)
        self._name_steps()
        if problems := check_order(self.operators):
            lines = [f"step {p.index + 1}: {p.message} ({p.label})" for p in problems]
            cures = dict.fromkeys(p.cure for p in problems if p.cure)
            raise PipelineError("\n".join(lines), place=self.name, cure="\n".join(cures))
        self.selection = Selection(self.operators, self.runs, self.name)
        self.derived = derivable(self.selection, tuple(self.runs))
        """Companion runs that are derived from the main run and these others, if the operators find nothing against it."""

    def _name_steps(self) -> None:
        seen: dict[str, int] = {}
        for operator in self.operators:
            base = operator.name or type(operator).__name__
            seen[base] = seen.get(base, 0) + 1
            operator._label = base if seen[base] == 1 else f"{base}.{seen[base]}"

    @property
    def order(self) -> list[str]:
        """The runs in the order in which they are made: the main run (empty), what is simulated, what is derived."""
        return ["", *(r for r in self.runs if r not in self.derived), *self.derived]

    @faults_named(exceptions=False)
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
        from .hooks import manager
        from .storage.files import check_output_folder

        numbers = {"threads": threads, "memory": memory, "ceiling": ceiling}
        threads, memory, ceiling = arguments.check_run(scene, output, numbers, keep, self.name)
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
                before = len(data.observations)
                operator.observe(data)  # pointing steps append observations; map makers lay out the grid of all of them
                if part is not None:
                    part.name(data.observations[before:])
            elif operator.label in part.layouts:
                operator.lay_out(part.layouts[operator.label])
            timer.add(operator.label, "observe", time.thread_time() - start)
        if not data.observations:
            raise PipelineError("the pointing steps made no observation", place=self.name, cure="ask for at least one scan")
        if part is not None and part.scans is not None:
            data.observations = [data.observations[k] for k in part.scans]
        if part is None:
            self._meanwhile(data, "pointing")
        if ceiling is not None or memory is None:
            steps, parts = self.selection.steps(""), len(parts_of(self.derived))
            divide(steps, data.observations, settings, ahead, ceiling, memory, parts, self.name, part is None)
            if settings.threads < data.threads and part is None:
                text = f"{settings.threads} of {data.threads} threads work: more do not fit in the memory budget"
                warnings.warn(f"{self.name}: {text}", stacklevel=2)
            data.threads = settings.threads
        simulation = Simulation(self.selection, self.order, self.derived, data, keep, hooks, settings, timer, ahead)
        derivation = Derivation(self.selection, self.derived)
        try:
            for run in self.order:
                data.run = run
                if not derivation.derive(run, data, simulation.kept_out):
                    simulation.make(run, lambda: self._meanwhile(data, "scan") if part is None else None)
                derivation.keep(run, data)
                for operator in self.selection.steps(run):
                    if part is None:
                        self._finalize(operator, data, timer, hooks)
                    else:
                        part.take(operator, data)
                if part is None:
                    self._meanwhile(data, "run")
        finally:
            ahead.close()
        data.run = ""
        simulation.leave_main()
        if part is None:
            self._meanwhile(data, "runs")
        for operator in self.operators:
            if operator.at_end and part is None:
                data.provenance["timings"] = timer.rows()  # a report knows of the steps before it
                self._finalize(operator, data, timer, hooks)
        data.provenance["timings"] = timer.rows()
        hooks.zonda_pipeline_end(pipeline=self, data=data)
        return data

    @faults_named(exceptions=False)
    def pack(self, data: Data, first: bool) -> dict[str, dict[str, Mapping[str, Any]]]:
        """The partial products in ``data``, by run and label."""
        part = Part(first=first)
        for run in self.order:
            data.run = run
            for operator in self.selection.steps(run):
                part.take(operator, data)
        data.run = ""
        return part.packed

    @faults_named(exceptions=False)
    def merge(self, data: Data, packed: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
        """Add the partial products of a part to ``data``."""
        for run in self.order:
            data.run = run
            for operator in self.selection.steps(run):
                if (found := packed.get(run, {}).get(operator.label)) is not None:
                    operator.merge(data, found)
        data.run = ""

    @faults_named(exceptions=False)
    def finish(self, data: Data) -> Data:
        """Finish merged products, and let the operators act that act at the end."""
        from .hooks import manager

        hooks, timer = manager().hook, Timer()
        hooks.zonda_pipeline_start(pipeline=self, data=data)
        for run in self.order:
            data.run = run
            for operator in self.selection.steps(run):
                self._finalize(operator, data, timer, hooks)
            self._meanwhile(data, "run")
        data.run = ""
        self._meanwhile(data, "runs")
        for operator in self.operators:
            if operator.at_end:
                self._finalize(operator, data, timer, hooks)
        hooks.zonda_pipeline_end(pipeline=self, data=data)
        return data

    def _meanwhile(self, data: Data, done: Literal["pointing", "scan", "run", "runs"]) -> None:
        for operator in self.operators:
            if operator.at_end:
                operator.watch(data, done)

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
