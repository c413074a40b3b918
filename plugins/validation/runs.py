"""Runs of pipelines for claims: each (pipeline, seed) is run once for all metrics that are measured
on it, and kept.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zonda.core.campaign.entries import separate, setting
from zonda.core.configuration.files import paths_in
from zonda.core.errors import InputError, ZondaError
from zonda.core.figures import Choice
from zonda.core.storage.files import write_text

from .claims import FOLDER, Claim, Experiment
from .verdict import Values

if TYPE_CHECKING:
    from zonda.core.configuration.pipeline_file import PipelineFile
    from zonda.core.data import Data

SECONDS = "seconds"
"""The metric that is the wall time of the run itself, s."""

DRAWN = "drawn.txt"
"""File in a folder with pictures that holds the key of their simulation."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Simulation:
    """A pipeline with changed values."""

    path: Path
    settings: tuple[str, ...] = ()

    @cached_property
    def file(self) -> PipelineFile:
        """The checked pipeline. Raises `ConfigurationError`."""
        from zonda.core.configuration.pipeline_file import load

        return load(self.path, self.settings)

    @cached_property
    def key(self) -> str:
        """Hash of what its values depend on: every parameter, input files, zonda's version."""
        from zonda import __version__

        found = hashlib.blake2b(__version__.encode(), digest_size=12)
        found.update(self.file.resolved_yaml().encode())
        for path in paths_in([self.file.scene(), *self.file.operators]):
            found.update(path.read_bytes() if path.is_file() else b"")
        return found.hexdigest()

    def run(self, number: int, choices: Mapping[str, Choice], output: Path | None = None) -> Data:
        """Realization ``number``, counted from 0, with the signals that metrics need. Outputs act,
        and pictures are drawn, where there is ``output``; else only those act that make what
        metrics read."""
        from zonda.core.output import Output
        from zonda.core.pipeline import Pipeline
        from zonda.core.registry import operators

        file, runs = self.file, dict(self.file.runs)
        for k, choice in enumerate(choices.values()):
            runs |= {f"{name}_{k}": signal for name, signal in choice.metric.signals(runs).items()}
        read = {
            product
            for choice in choices.values()
            for product in getattr(choice.metric, "reads", ())
        }
        steps = [
            o
            for o in file.operators
            if output is not None or not isinstance(o, Output) or o.provides & read
        ]
        if output is not None and not any("pictures" in o.provides for o in steps):
            steps.append(operators.get("Plots")())
        pipeline = Pipeline(
            steps,
            runs=runs,
            only=file.header.only,
            name=file.header.name,
            precision=file.header.precision,
        )
        scene = file.scene()
        return pipeline.run(
            scene.model_copy(update={"seed": separate(scene.seed, number)}), output=output
        )


@dataclass
class Stored:
    """What was measured on a simulation: by realization, then by metric (value, standard error)."""

    path: Path
    about: dict[str, Any]
    values: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, simulation: Simulation) -> Stored:
        """What the folder holds; a damaged file counts as none."""
        about = {"pipeline": simulation.path.name, "settings": list(simulation.settings)}
        found = cls(folder / "runs" / f"{simulation.key}.json", about)
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            values = json.loads(found.path.read_text(encoding="utf-8"))["values"]
            found.values = {
                str(n): {str(m): (float(v), float(e)) for m, (v, e) in row.items()}
                for n, row in values.items()
            }
        return found

    def lacks(self, number: int, metrics: Mapping[str, int]) -> list[str]:
        """Metrics wanted of this realization (``metrics``: of how many) that are not there."""
        return [
            m
            for m, seeds in metrics.items()
            if number < seeds and m not in self.values.get(str(number), {})
        ]

    def add(self, number: int, values: Mapping[str, tuple[float, float]]) -> None:
        """Keep values, on disk at once."""
        self.values[str(number)] = {**self.values.get(str(number), {}), **values}
        write_text(self.path, json.dumps({**self.about, "values": self.values}, indent=1) + "\n")

    def of_metric(self, metric: str, seeds: int) -> list[tuple[float, float]]:
        """Values and errors over realizations."""
        return [self.values[str(n)][metric] for n in range(seeds)]


class Runs:
    """All runs that a list of experiments needs.

    Parameters
    ----------
    folder
        Where values are kept, in ``runs/``: what is there already is not run again.
    base
        Folder of the claims file, in which pipelines are looked for first.
    say
        Called with a line for each run.
    """

    def __init__(self, folder: Path, base: Path, say: Say = lambda text: None) -> None:
        self.folder, self.base, self.say = folder, base, say
        self.made = 0
        self._wanted: dict[Simulation, dict[str, int]] = {}
        self._choices: dict[str, Choice] = {}
        self._stored: dict[Simulation, Stored] = {}

    def want(self, experiment: Experiment) -> None:
        """Note what an experiment needs. Raises `ZondaError` for a pipeline, key or metric that
        there is not.
        """
        if experiment.calculate is not None:
            return
        name = self._metric(experiment)
        for simulation in self._simulations(experiment):
            metrics = self._wanted.setdefault(simulation, {})
            metrics[name] = max(metrics.get(name, 0), experiment.seeds or 1)
            if name != SECONDS:
                self._choices[name].metric.check(simulation.file.operators, simulation.file.runs)

    def execute(self) -> None:
        """Run what is missing."""
        todo = [(s, n) for s, metrics in self._wanted.items() for n in range(max(metrics.values()))]
        for done, (simulation, number) in enumerate(todo):
            stored = self._stored.setdefault(simulation, Stored.of(self.folder, simulation))
            missing = stored.lacks(number, self._wanted[simulation])
            if missing:
                about = " ".join([simulation.path.stem, *simulation.settings])
                self.say(f"run {done + 1} of {len(todo)}: {about}, realization {number + 1}")
                stored.add(number, self._measure(simulation, number, missing))
                self.made += 1

    def values(self, experiment: Experiment) -> Values:
        """What an experiment found. Its runs have been executed."""
        if experiment.calculate is not None:
            return Values((experiment.calculate.value,))
        name, seeds = self._metric(experiment), experiment.seeds or 1
        columns = [self._stored[s].of_metric(name, seeds) for s in self._simulations(experiment)]
        single = [[value for value, _ in column] for column in columns]
        error = columns[0][0][1] if seeds == 1 and experiment.statistic is None else 0.0
        return Values(*combined(experiment.statistic, single, error if error == error else 0.0))

    def pictured(self, claim: Claim) -> Simulation:
        """What a claim's pictures are of: its own first run, or the pipeline that `pictures` names.
        Raises `ZondaError`.
        """
        named = (
            {"pipeline": claim.pictures, "versus": None} if isinstance(claim.pictures, str) else {}
        )
        return self._simulations(claim.model_copy(update=named))[0]

    def draw(self, simulation: Simulation, folder: Path) -> None:
        """The PNG files of a simulation's first realization in a folder, unless they are there;
        those of one run are copied.
        """
        drawn = {_text_of(mark): mark.parent for mark in sorted(self.folder.glob(f"*/{DRAWN}"))}
        if _text_of(folder / DRAWN) == simulation.key:
            return
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.folder, prefix="pictures-") as made:
            if simulation.key not in drawn:
                self.say(f"pictures of {simulation.path.stem} in {folder.name}")
                simulation.run(0, {}, Path(made))
            for old in _pictures(folder):
                old.unlink()
            for picture in _pictures(drawn.get(simulation.key, Path(made))):
                shutil.copyfile(picture, folder / picture.name)
        write_text(folder / DRAWN, simulation.key)

    def draw_atmosphere(self, experiment: Experiment, folder: Path) -> None:
        """The atmosphere above the site of an experiment's pipeline: ``atmosphere.png``."""
        from zonda.core.storage.files import atomic_path

        from .atmosphere_figure import atmosphere_figure

        folder.mkdir(parents=True, exist_ok=True)
        figure = atmosphere_figure(self._simulations(experiment)[0].file.scene())
        with atomic_path(folder / "atmosphere.png") as temporary:
            figure.savefig(temporary)

    def _measure(
        self, simulation: Simulation, number: int, metrics: list[str]
    ) -> dict[str, tuple[float, float]]:
        choices = {m: self._choices[m] for m in metrics if m != SECONDS}
        begin = time.perf_counter()
        data = simulation.run(number, choices)
        found = {SECONDS: (time.perf_counter() - begin, 0.0)}
        for name, choice in choices.items():
            figure = choice.figure(data)
            found[name] = (figure.value, figure.error)
        return {m: found[m] for m in metrics}

    def _metric(self, experiment: Experiment) -> str:
        if experiment.metric == SECONDS:
            return SECONDS
        from pydantic_core import PydanticCustomError

        try:
            choice = Choice.parse(experiment.metric)
        except PydanticCustomError as err:
            raise InputError(
                err.message(), place="metric", cure=str((err.context or {}).get("help", ""))
            ) from None
        self._choices.setdefault(choice.name, choice)
        return choice.name

    def _simulations(self, experiment: Experiment) -> list[Simulation]:
        assert experiment.pipeline is not None
        path = self._path(experiment.pipeline)
        changes = [
            experiment.change,
            *(
                [{**experiment.change, **experiment.versus}]
                if experiment.versus is not None
                else []
            ),
        ]
        made = [
            Simulation(path, tuple(setting(key, value) for key, value in change.items()))
            for change in changes
        ]
        return [
            next((s for s in self._wanted if s == new), new) for new in made
        ]  # the one whose file is read already

    def _path(self, name: str) -> Path:
        from zonda.core.configuration.locate import locate

        for candidate in (self.base / name, self.base / f"{name}.yaml", FOLDER / f"{name}.yaml"):
            if candidate.is_file():
                return candidate
        return locate(name)


def _pictures(folder: Path) -> list[Path]:
    """The pictures of a run, without the claim's own."""
    return [
        path
        for path in sorted(folder.glob("*.png"))
        if path.name not in ("values.png", "atmosphere.png")
    ]


def _text_of(path: Path) -> str:
    """What a file holds; empty where there is none."""
    with suppress(OSError, ValueError):
        return path.read_text(encoding="utf-8")
    return ""


def combined(
    statistic: str | None, columns: list[list[float]], error: float
) -> tuple[tuple[float, ...], float]:
    """Values and the error of a single one; that of a paired significance S of n pairs is ((1 + S^2
    / 2) / n)^(1/2).
    """
    if statistic is None:
        return tuple(columns[0]), error
    pairs = list(zip(*columns, strict=True))
    if statistic == "ratio":
        return tuple(a / b if b else float("nan") for a, b in pairs), 0.0
    differences = Values(tuple(a - b for a, b in pairs))
    if statistic == "difference":
        return differences.values, 0.0
    apart = sum(Values(tuple(column)).scatter ** 2 for column in columns) ** 0.5
    paired = statistic.startswith("paired")
    scatter = differences.scatter if paired else apart
    if not scatter:
        raise ZondaError(
            "a significance needs seeds that scatter",
            place="statistic",
            cure="set seeds to 3 or more",
        )
    found = differences.mean / scatter
    error = (
        math.hypot(1.0, found / math.sqrt(2)) / math.sqrt(len(pairs))
        if paired
        else differences.standard_error / scatter
    )
    root = math.sqrt(len(pairs)) if statistic == "paired_mean" else 1.0
    return (root * found,), root * error


def described(experiment: Experiment) -> Iterator[str]:
    """An experiment in words: pipeline, changes, metric, seeds; or the calculation."""
    if experiment.calculate is not None:
        yield str(experiment.calculate)
        return
    yield f"{experiment.pipeline}"
    yield from (f"{key}={value}" for key, value in experiment.change.items())
    if experiment.versus is not None:
        yield (
            f"{experiment.statistic} to"
            f" {', '.join(f'{k}={v}' for k, v in experiment.versus.items())}"
        )
    metric = experiment.metric
    yield (
        metric
        if isinstance(metric, str)
        else ", ".join(f"{name}({given or ''})" for name, given in metric.items())
    )
    yield f"{experiment.seeds or 1} seed{'s' if (experiment.seeds or 1) > 1 else ''}"
