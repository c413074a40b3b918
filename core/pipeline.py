"""An ordered list of operators: checked before it runs, then run over every observation."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .assembly import arguments
from .assembly.order import check_order
from .assembly.signals import Chain, Signals, acting_steps, note_signals, remainder
from .configuration.input_paths import paths_in
from .data import Data
from .errors import PipelineError
from .faults import faults_named
from .hooks import manager
from .machine import (
    available_memory,
    available_threads,
    give_back_memory,
    resident_memory,
    versions,
)
from .mapmaker import MapMaker, joins
from .observation import Observation
from .operator import Operator, labels
from .output import Output
from .run.budget import check_end, files_of, least_memory
from .run.execution import execute
from .run.settings import Settings, Timer
from .run.views import Band, View
from .scene import Scene, WithScene
from .signal import Signal, stream_of
from .storage.files import check_output_folder
from .storage.output_folder import recording
from .tables import html_table


@dataclass
class Part:
    """Some of the scans of a run, whose products stay unfinished, to be combined with those of
    other parts (`core.campaign`).

    Attributes
    ----------
    scans
        Positions of the scans; None: all.
    layouts
        By label: what all scans of all parts have in common (`Data.layouts`).
    prefix
        Of the names of the scans: what makes them unique among all parts.
    """

    scans: Sequence[int] | None = None
    layouts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    prefix: str = ""


class Pipeline:
    """Operators in the order in which they act.

    Parameters
    ----------
    operators
        The steps. Namesakes are numbered (``WhiteNoise``, ``WhiteNoise.2``).
    runs
        Further signals by name, e.g. ``{"noiseless": {"only": ["sky"]}, "source_free": {"without":
        ["sky"]}}``: what a subset of the components makes, filtered and mapped beside the complete
        signal.
    only
        Components that the complete signal is narrowed to; empty: all. Levels, flags and random
        numbers stay those of the scene.
    name, description
        Shown in products.
    precision
        Type of the time streams. float32 carries fluctuations of some kelvin to 1e-7 K (the mean
        emission is kept apart in float64); float64 is for common modes 1e6 times the signal.

    Raises
    ------
    PipelineError
        When a step's inputs are missing or come too late; the message names every such step.
    """

    def __init__(
        self,
        operators: Iterable[Operator],
        *,
        runs: Mapping[str, Signal | Mapping[str, Any]] | None = None,
        only: Sequence[str] = (),
        name: str = "pipeline",
        description: str = "",
        precision: Literal["float32", "float64"] = "float32",
    ) -> None:
        self.operators = arguments.steps(operators, name)  # copies: labels are this pipeline's own
        self.name = name
        self.description = description
        self.precision = arguments.precision(precision, name)
        self.only = tuple(arguments.components(only, name))
        for operator, label in zip(self.operators, labels(self.operators), strict=True):
            operator._label = label
        if problems := check_order(self.operators):
            lines = [f"step {p.index + 1}: {p.message} ({p.label})" for p in problems]
            cures = dict.fromkeys(p.cure for p in problems if p.cure)
            raise PipelineError("\n".join(lines), place=self.name, cure="\n".join(cures))
        self._pointed: list[Band] = []
        self.asked = arguments.runs(runs, name)
        """The signals beside the complete one that were asked for, by name."""
        self.signals = Signals(self.operators, self.asked, self.only, self.name)

    @property
    def runs(self) -> dict[str, Signal]:
        """The signals beside the complete one, by name; those that outputs need among them."""
        return self.signals.runs

    @property
    def chain(self) -> Chain:
        """The steps that act on every observation, with the signals that they make."""
        return self._chain(self.operators)

    def _chain(self, operators: Sequence[Operator], keep: Sequence[str] = ()) -> Chain:
        steps = acting_steps(operators, keep)
        return Chain(steps, self.signals.formed, self.signals.components, tuple(keep))

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
            Bytes for streams and blocks; default: what the ceiling leaves. Results do not depend on
            it.
        ceiling
            Bytes that the process may hold (``--memory``); default, where no ``memory`` is given:
            what it holds now and half of the free memory. A run that would not fit is refused
            before it starts.
        keep
            Streams to keep for `Data.tod`, as they stand after the last step: 4 bytes for each
            sample of each scan, which count in the budget.
        provenance
            Entries added to ``data.provenance``.
        """
        data, settings = self._begin(
            scene,
            output,
            {"threads": threads, "memory": memory, "ceiling": ceiling},
            keep,
            provenance,
        )
        self.signals.check_kept(keep)
        with contextlib.ExitStack() as stack:
            if data.output is not None:
                check_output_folder(data.output)
                inputs = paths_in([scene, *self.operators])
                stack.enter_context(recording(data.output, anew=True, inputs=inputs))
            hooks = manager().hook
            timer = Timer()
            hooks.zonda_pipeline_start(pipeline=self, data=data)
            for operator in self.operators:
                timer.add(operator.label, "observe", 0.0)  # rows in the order of the steps
            bands = self._bands(data, keep)
            self._observe(data, bands, timer)
            self._execute(bands, settings, timer)
            self._finish(data, bands, timer)
        data.pipeline = self
        return data

    def _bands(self, data: Data, keep: Sequence[str] = ()) -> list[Band]:
        """The steps and data of each band; all of them where the camera has one.

        A step that acts on a band's data is a copy: it may keep what it lays out for them.
        """
        for operator in self.operators:
            if isinstance(operator, WithScene):
                data.use_recorded(operator.label, operator.own_scene(data.scene.instrument))
        bands = []
        for own in data.split():
            copies = [operator.model_copy() for operator in self.operators]
            acting = [
                o for o in copies if (o.one_band if isinstance(o, Output) else of_one_band(o))
            ]
            bands.append(Band(acting, self._chain(copies, keep), own))
        return bands or [Band(self.operators, self._chain(self.operators, keep), data)]

    def _observe(
        self,
        data: Data,
        bands: Sequence[Band],
        timer: Timer,
        *,
        outputs: bool = True,
        prefix: str = "",
    ) -> None:
        """Let all steps observe, outputs first: they may refuse at once. Bands share the pointing.
        ``prefix``: of scans.
        """
        several = bool(data.bands)
        whole = [
            o
            for o in self.operators
            if not several or (not o.one_band if isinstance(o, Output) else points(o))
        ]
        for own, operators in ((data, whole), *((b.data, b.operators) for b in bands if several)):
            for operator in sorted(operators, key=lambda o: not isinstance(o, Output)):
                if isinstance(operator, Output) and not outputs:
                    continue
                before = len(own.observations)
                self._timed(timer, operator, "observe", own)
                for observation in own.observations[before:]:  # before other steps see them
                    observation.name = prefix + observation.name
            if several and own is data:
                data.hand_out()

    @faults_named(exceptions=False)
    def run_part(
        self,
        scene: Scene,
        part: Part,
        *,
        output: str | Path | None = None,
        threads: int | None = None,
        memory: int | None = None,
        ceiling: int | None = None,
        provenance: Mapping[str, Any] | None = None,
    ) -> Data:
        """Observe some of the scans only; their partial products stay in ``data.partial``, nothing
        is finished.
        """
        data, settings = self._begin(
            scene,
            output,
            {"threads": threads, "memory": memory, "ceiling": ceiling},
            (),
            provenance,
        )
        timer = Timer()
        data.layouts, data.laid_out = dict(part.layouts), True
        manager().hook.zonda_pipeline_start(pipeline=self, data=data)
        bands = self._bands(data)
        self._observe(data, bands, timer, outputs=False, prefix=part.prefix)
        if part.scans is not None:
            data.pointed = (
                [data.pointed[k] for k in part.scans] if data.pointed else []
            )  # the log counts these alone
            for band in bands:
                band.data.observations = [band.data.observations[k] for k in part.scans]
        self._execute(bands, replace(settings, fresh=False), timer)
        data.gather()
        data.provenance["timings"] = timer.rows()
        manager().hook.zonda_pipeline_end(pipeline=self, data=data)
        return data

    @faults_named(exceptions=False)
    def finish(self, data: Data) -> Data:
        """Finish partial products that were combined, with the layouts that they have in common,
        and let the outputs act.
        """
        bands = self._bands(data)
        data.hand_out(data.observations)
        for band in bands:
            for operator in band.operators:
                if operator.label in band.data.layouts:
                    operator.observe(band.data)
        manager().hook.zonda_pipeline_start(pipeline=self, data=data)
        self._finish(data, bands, Timer())
        return data

    @faults_named(exceptions=False)
    def point(
        self,
        scene: Scene,
        layouts: Mapping[str, Any],
        output: Path,
        *,
        laid_out: bool = False,
    ) -> Data:
        """The observations of a scene, and ``layouts`` extended to them, or taken as they are where
        all is ``laid_out``.
        """
        data = Data(scene, output=output, layouts=dict(layouts), laid_out=laid_out)
        self._pointed = self._bands(data)
        self._observe(data, self._pointed, Timer(), outputs=False)
        data.gather()
        return data

    def least_memory(self, observations: Sequence[Observation]) -> int:
        """Bytes with which a process runs the pipeline over these observations on one thread,
        libraries included.
        """
        views = []
        for band in self._pointed:
            camera = band.data.scene.instrument
            scans = [o for o in observations if not band.data.band or o.instrument == camera]
            longest = max(scans, key=lambda o: o.n_detectors * o.n_samples)
            note_signals([longest], self.signals.components, self.signals.formed)
            views.append(View(band.chain, longest))
        return least_memory(views, Settings(dtype=self._dtype), self.operators)

    @property
    def _dtype(self) -> type[np.floating[Any]]:
        return np.float64 if self.precision == "float64" else np.float32

    def _begin(
        self,
        scene: Scene,
        output: str | Path | None,
        numbers: Mapping[str, Any],
        keep: Sequence[str],
        provenance: Any,
    ) -> tuple[Data, Settings]:
        threads, memory, ceiling = arguments.check_run(scene, output, numbers, keep, self.name)
        data = Data(scene=scene, output=None if output is None else Path(output))
        data.provenance = {**self.provenance(scene), **(provenance or {})}
        for what, text in scene.instrument.notes.items():
            data.log.state(scene.instrument.name, what, text)
        hooks = manager().hook
        settings = Settings(
            threads=threads or available_threads(),
            memory=memory
            or available_memory() // 2,  # less, once the operators have said what they hold
            dtype=self._dtype,
            progress=lambda done, total, what: hooks.zonda_progress(
                done=done,
                total=total,
                what=what,
            ),
            process=ceiling,
            asked=memory is not None,
            place=self.name,
        )
        data.threads, data.progress = settings.threads, settings.progress
        budget = settings.process or resident_memory() + available_memory() // 2
        data.files = files_of(budget)
        return data, settings

    def _execute(self, bands: Sequence[Band], settings: Settings, timer: Timer) -> None:
        """Run all observations with all bands."""
        for band in bands:
            self._make_ready(band)
        give_back_memory()  # of pointing
        check_end(bands, self.operators, settings)
        execute(bands, settings, timer)

    def _make_ready(self, band: Band) -> None:
        """Note in the observations what is made of them, and let outputs see them."""
        data = band.data
        if not data.observations:
            raise PipelineError(
                "the pointing steps made no observation",
                place=self.name,
                cure="ask for at least one scan",
            )
        for observation in data.observations:
            observation.output, observation.focalplane = data.output, observation.focalplane.copy()
        note_signals(data.observations, self.signals.components, self.signals.formed)
        band.watch("pointing")
        for name, signal in self.signals.runs.items():
            if self.signals.not_linear and signal.modes == "full":
                text = (
                    f"its own from {self.signals.not_linear} on, which is not linear, instead of"
                    " those of the complete signal"
                )
                data.log.state(name, "modes", text)

    def _finish(self, data: Data, bands: Sequence[Band], timer: Timer) -> None:
        """Finish the products of all bands, and let the outputs act."""
        for band in bands:
            self._subtract_remainders(band.data)
        for band in bands:
            self._make_products(band, bands, timer)
            if data.bands:
                self._let_outputs_act(band.operators, band.data, timer)
        data.gather()
        Band(self.operators, bands[0].chain, data).watch("maps")
        every = [
            o for o in self.operators if not (data.bands and isinstance(o, Output) and o.one_band)
        ]
        self._let_outputs_act(every, data, timer)
        data.provenance["timings"] = timer.rows()
        manager().hook.zonda_pipeline_end(pipeline=self, data=data)

    def _subtract_remainders(self, data: Data) -> None:
        """Make partial products of remainders, which are not simulated."""
        for name, parts in self.signals.remainders.items():
            for product in data.partial.values():
                if product.signals and stream_of(name) not in product.signals:
                    product.subtract(stream_of(name), [stream_of(part) for part in parts])
            data.log.state(name, "remainder", remainder(parts))

    def _make_products(self, band: Band, bands: Sequence[Band], timer: Timer) -> None:
        """Finish all products of a band; those of a map maker that joins bands with the first."""
        for operator in band.chain.steps:
            if len(bands) == 1 or not (isinstance(operator, MapMaker) and joins(operator)):
                self._timed(timer, operator, "finalize", band.data)
            elif band is bands[0]:
                self._timed(timer, operator, "finalize_bands", [one.data for one in bands])

    def _let_outputs_act(self, operators: Iterable[Operator], data: Data, timer: Timer) -> None:
        """Finish the outputs."""
        for operator in operators:
            if isinstance(operator, Output):
                data.provenance["timings"] = timer.rows()  # a report knows of the steps before it
                self._timed(timer, operator, "finalize", data)

    def _timed(
        self,
        timer: Timer,
        operator: Operator,
        method: Literal["observe", "finalize", "finalize_bands"],
        data: Data | list[Data],
    ) -> None:
        """Call an operator with all data and time it; hooks are called around ``finalize``."""
        hooks = manager().hook
        stage = method.removesuffix("_bands")
        if stage == "finalize":
            hooks.zonda_before_operator(operator=operator, observation=None, stage=stage)
        start = time.thread_time()
        getattr(operator, method)(data)
        used = time.thread_time() - start
        timer.add(operator.label, stage, used)
        if stage == "finalize":
            hooks.zonda_after_operator(
                operator=operator,
                observation=None,
                stage=stage,
                seconds=used,
            )

    def provenance(self, scene: Scene) -> dict[str, Any]:
        """Provenance of the products: name, seed, versions, signals, operators with their
        parameters.
        """
        return {
            "name": self.name,
            "description": self.description,
            "seed": scene.seed,
            "precision": self.precision,
            "runs": {
                k: s.model_dump(exclude_none=True, exclude_defaults=True)
                for k, s in self.signals.runs.items()
            },
            "versions": versions(),
            "operators": [
                (
                    o.label,
                    type(o).__name__,
                    {k: str(v) for k, v in o.model_dump(mode="json", exclude_none=True).items()},
                )
                for o in self.operators
            ],
        }

    def __repr__(self) -> str:
        return f"<Pipeline {self.name}: {' > '.join(o.label for o in self.operators)}>"

    def _repr_html_(self) -> str:
        return html_table(f"Pipeline {self.name}", [(o.label, repr(o)) for o in self.operators])


def points(operator: Operator) -> bool:
    """Tell whether a step points the telescope, which is done once for all bands."""
    return "boresight" in operator.provides


def of_one_band(operator: Operator) -> bool:
    """Tell whether a step acts on each band's data: all do but those that only point, which is
    done once for all bands.

    A step that points and reads streams too observes the scans of all bands first, and then each
    band's data (`Data.band`); so does one that reads recorded pointing, whose flags differ from
    band to band.
    """
    return operator.provides != {"boresight"} or isinstance(operator, WithScene)
