"""From claims to verdicts: run the pipelines whose values are missing, compare with the paper, draw
the pictures of runs.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from zonda.core.campaign.settings import setting
from zonda.core.configuration.locate import locate
from zonda.core.errors import ZondaError, within
from zonda.core.experiment.experiment import SECONDS, Values
from zonda.core.experiment.experiment import Experiment as Tasks
from zonda.core.experiment.variant import FileVariant
from zonda.core.figures import Choice
from zonda.core.registry import operators
from zonda.core.scene import Scene
from zonda.core.storage.files import atomic_path, check_output_folder, write_text
from zonda.operators.atmosphere.weather.sources import profile_of
from zonda.plugins.commands.weather_plots import plot_spectrum

from .calculations import Amount
from .claims import FOLDER, Claim, Comparison, Experiment, Verdict, compare, contradicted, decide

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def atmosphere_figure(scene: Scene) -> Figure:
    """A figure of the climatology's profile at the zenith of the scene's site and time, with the
    instrument's band.
    """
    from matplotlib.figure import Figure

    air = profile_of(None, scene.site, scene.time, 0)
    figure = Figure(figsize=(9, 8.5), dpi=110, layout="constrained")
    axes = figure.subplots(2)
    for ax, which in zip(axes, ("brightness", "transmission"), strict=True):
        plot_spectrum(ax, air, math.pi / 2, [scene.instrument.band], which)
    figure.legend(
        *axes[1].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=6,
        fontsize=8,
        frameon=False,
    )
    return figure


DRAWN = "drawn.txt"
"""File in a folder with pictures that holds the key of their simulation."""

Say = Callable[[str], None]


class Runs:
    """Runs that a list of experiments needs.

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
        self.folder = folder
        self.base = base
        self.say = say
        self.experiment = Tasks(folder=folder, say=say)

    def want(self, experiment: Experiment) -> None:
        """Note what an experiment needs. Raises `ZondaError` for a pipeline, key or metric that
        there is not.
        """
        if experiment.calculate is None:
            choice = self._choice(experiment)
            for variant in self._variants(experiment):
                self.experiment.want(variant, choice, experiment.seeds or 1)

    def values(self, experiment: Experiment) -> Values:
        """Values of an experiment, whose runs have been executed."""
        if experiment.calculate is not None:
            return Values((experiment.calculate.value,))
        choice = self._choice(experiment)
        seeds = experiment.seeds or 1
        name = choice.name if choice else SECONDS
        columns = [self.experiment.figures(v, name)[:seeds] for v in self._variants(experiment)]
        single = [[figure.value for figure in column] for column in columns]
        error = columns[0][0].error if seeds == 1 and experiment.statistic is None else 0.0
        return Values(*combined(experiment.statistic, single, error if error == error else 0.0))

    def pictured(self, claim: Claim) -> FileVariant:
        """The variant that a claim's pictures show: its own first run, or the pipeline that
        `pictures` names. Raises `ZondaError`.
        """
        named = (
            {"pipeline": claim.pictures, "versus": None} if isinstance(claim.pictures, str) else {}
        )
        return self._variants(claim.model_copy(update=named))[0]

    def draw(self, variant: FileVariant, folder: Path) -> None:
        """Write the PNG files of a variant's first realization to a folder, unless they are there;
        those of one run are copied.
        """
        drawn = {_text_of(mark): mark.parent for mark in sorted(self.folder.glob(f"*/{DRAWN}"))}
        if _text_of(folder / DRAWN) == variant.key:
            return
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.folder, prefix="pictures-") as made:
            if variant.key not in drawn:
                self.say(f"pictures of {Path(variant.pipeline).stem} in {folder.name}")
                steps = variant.file.operators
                if not any("pictures" in o.provides for o in steps):
                    steps = [*steps, operators.get("Plots")()]
                variant.run(operators=steps, output=Path(made))
            for old in _pictures(folder):
                old.unlink()
            for picture in _pictures(drawn.get(variant.key, Path(made))):
                shutil.copyfile(picture, folder / picture.name)
        write_text(folder / DRAWN, variant.key)

    def draw_atmosphere(self, experiment: Experiment, folder: Path) -> None:
        """The atmosphere above the site of an experiment's pipeline: ``atmosphere.png``."""
        folder.mkdir(parents=True, exist_ok=True)
        figure = atmosphere_figure(self._variants(experiment)[0].file.scene())
        with atomic_path(folder / "atmosphere.png") as temporary:
            figure.savefig(temporary)

    def _choice(self, experiment: Experiment) -> Choice | None:
        """The metric of an experiment; None: the seconds of a run."""
        return None if experiment.metric == SECONDS else Choice.of(experiment.metric)

    def _variants(self, experiment: Experiment) -> list[FileVariant]:
        assert experiment.pipeline is not None
        path = self._path(experiment.pipeline)
        changes = [experiment.change]
        if experiment.versus is not None:
            changes.append({**experiment.change, **experiment.versus})
        return [
            FileVariant(path, tuple(setting(key, value) for key, value in change.items()))
            for change in changes
        ]

    def _path(self, name: str) -> Path:
        for candidate in (self.base / name, self.base / f"{name}.yaml", FOLDER / f"{name}.yaml"):
            if candidate.is_file():
                return candidate
        return locate(name)


def _pictures(folder: Path) -> list[Path]:
    """The pictures of a run, without the claim's own."""
    own = ("values.png", "atmosphere.png")
    return [path for path in sorted(folder.glob("*.png")) if path.name not in own]


def _text_of(path: Path) -> str:
    """Content of a file; empty if there is none."""
    with suppress(OSError, ValueError):
        return path.read_text(encoding="utf-8")
    return ""


def combined(
    statistic: str | None,
    columns: list[list[float]],
    error: float,
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


@dataclass(frozen=True)
class CounterResult:
    """A counter-experiment: its name, what it shows, its values, whether its criterion is
    satisfied; the unit that its values are stated in (of its criterion, which need not be that of
    the claim), and whether they are of the claim's quantity."""

    name: str
    shows: str
    experiment: Experiment
    values: Values
    satisfied: bool
    unit: Amount
    comparable: bool


@dataclass(frozen=True)
class Row:
    """A claim and what was found of it."""

    claim: Claim
    values: Values
    comparison: Comparison | None
    counters: tuple[CounterResult, ...]
    verdict: Verdict

    @classmethod
    def of(cls, claim: Claim, runs: Runs) -> Row:
        """The verdict on a claim whose runs have been made.

        A counter-experiment is of the claim's quantity if it agrees with the claim's value, or has
        its unit and is as the claim's a value, a ratio, a difference or a significance.
        """
        experiments = dict(claim.experiments())
        found = {name: runs.values(experiment) for name, experiment in experiments.items()}
        comparison = compare(claim.stated, found[""]) if "" in found else None
        counters = []
        for counter in claim.counter:
            expect = counter.expect
            experiment = experiments[counter.name]
            unit = expect.above or expect.below or claim.paper
            alike = unit.unit == claim.paper.unit and experiment.kind == claim.kind
            counters.append(
                CounterResult(
                    counter.name,
                    counter.shows,
                    experiment,
                    found[counter.name],
                    expect.is_met(found[counter.name], claim.stated),
                    unit,
                    expect.agrees or alike,
                )
            )
        other = claim.contradiction
        verdict = decide(
            comparison.holds if comparison else None,
            [counter.satisfied for counter in counters] if claim.because else [],
            contradicted=other is not None
            and contradicted(claim.stated, other.calculate.value, other.relation),
            needs_data=bool(claim.needs),
        )
        return cls(claim, found.get("", Values(())), comparison, tuple(counters), verdict)


def measured(
    claims: Sequence[Claim],
    folder: Path,
    base: Path,
    say: Say = lambda text: None,
) -> list[Row]:
    """Measure claims, and draw their pictures in a folder for each.

    What ``folder`` holds of the same runs is not run again. ``base``: folder of the claims file.
    Raises `ZondaError` with the claim in its place for a run that cannot be made.
    """
    check_output_folder(folder)
    runs = Runs(folder, base, say)
    for claim in claims:
        with within(f"claim {claim.id}"):
            for _, experiment in claim.experiments():
                runs.want(experiment)
            if claim.pictures:
                # its mistakes are found before anything is run
                runs.pictured(claim).file  # noqa: B018
    runs.experiment.run()
    rows = [Row.of(claim, runs) for claim in claims]
    for claim in claims:
        with within(f"claim {claim.id}"):
            if claim.pictures:
                runs.draw(runs.pictured(claim), folder / claim.id)
            if claim.atmosphere:
                runs.draw_atmosphere(claim, folder / claim.id)
    return rows
