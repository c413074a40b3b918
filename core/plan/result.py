"""A plan: its decisions as text, as JSON, in short for headers; and what a run takes from it."""

from __future__ import annotations

import dataclasses
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..configuration.pipeline_file import PipelineFile, Step
from ..maps.beams import expected_fwhm
from ..operator import labels
from ..tables import aligned
from .bounds import Context, figure, kelvin
from .decide import Decided
from .planning import planning_of
from .prediction import Timing
from .structure import Structure

WIDTH = 120
"""Columns after which lines of text are broken."""

Row = tuple[str, str, str, str]
"""(effect, decision, bound, formula or reason), for headers and the report."""


@dataclass(frozen=True)
class PlanSummary:
    """Summary of a plan, or of the structure of a scene that is not planned, for a run.

    Attributes
    ----------
    operators, runs
        Labels of the operators, and names of the signals beside the complete one, that act.
    settings
        Changed parameters by operator.
    short
        Rows for headers and the report.
    memory
        None: not planned.
    words
        The line that the run prints.
    """

    operators: tuple[str, ...]
    runs: tuple[str, ...]
    settings: Mapping[str, Mapping[str, Any]]
    short: list[Row]
    memory: float | None = None
    words: str = ""

    def omitted(self, file: PipelineFile) -> list[str]:
        """The steps and signals of a pipeline file that do not act."""
        steps = [o.label for o in file.pipeline().operators if o.label not in self.operators]
        return steps + [f"signal {name}" for name in file.runs if name not in self.runs]

    def apply(self, file: PipelineFile) -> PipelineFile:
        """The pipeline that is run: an ordinary one, with parameters changed and operators
        omitted. Each step keeps its label, which its random numbers depend on.
        """
        steps = []
        kept = []
        for o, step in zip(file.pipeline().operators, file.steps, strict=True):
            if o.label in self.operators:
                update = dict(self.settings.get(o.label, {}))
                changed = step.operator.model_copy(update=update) if update else step.operator
                steps.append(Step(step.key, changed))
                kept.append(o.label)
        new = labels(s.operator for s in steps)
        named = [
            step
            if label == now
            else Step(step.key, step.operator.model_copy(update={"name": label}))
            for step, label, now in zip(steps, kept, new, strict=True)
        ]
        runs = {name: run for name, run in file.runs.items() if name in self.runs}
        header = file.header.model_copy(update={"runs": runs, "budget": 0.0})
        return dataclasses.replace(file, header=header, steps=tuple(named))

    def __str__(self) -> str:
        return self.words


def unplanned(structure: Structure, why: str) -> PlanSummary:
    """A run that is not planned: its structure, and why nothing is coarsened."""
    rows = [("plan", "not made", "", why), *omissions(structure)]
    words = f"simulated in full ({why})"
    return PlanSummary(structure.operators, structure.runs, {}, rows, words=words)


@dataclass(frozen=True)
class PlanOfBand:
    """Decisions of a plan with their errors in one band. All bands have the same forms.

    Attributes
    ----------
    decided
        One for each effect.
    limits
        The budget by metric.
    context
        Scans, noise and coverage, without the operators that are dropped as a whole.
    joined
        Steps that join the bands (`Context.joined`), dropped ones too: the bounds hold for this
        band alone.
    """

    decided: tuple[Decided, ...]
    limits: Mapping[str, float]
    context: Context
    joined: str = ""

    @property
    def spent(self) -> dict[str, float]:
        """Sum of the bounds of what was dropped or coarsened, by metric."""
        chosen = [d.choice.bound for d in self.decided if d.chosen]
        return {m: sum(bound.get(m, 0.0) for bound in chosen) for m in self.limits}

    @property
    def noise(self) -> tuple[float, float, float]:
        """White noise that the run will have, under the load of the atmosphere: rms of one sample
        and of a map pixel (0: no map), K; samples per pixel in the deep part of the map.
        """
        own = self.context
        return own.depth.sample, own.map_noise, own.coverage.hits if own.coverage else 0.0

    @property
    def states(self) -> dict[str, list[str]]:
        """Statements of steps about their work, by label."""
        scans = self.context.observations
        every = {o.label: planning_of(o).states(scans) for o in self.context.operators}
        return {label: lines for label, lines in every.items() if lines}

    def short(self) -> list[Row]:
        """Rows for headers."""
        found = []
        for d in self.decided:
            bound = d.choice.bound if d.adds_error else {}
            errors = ", ".join(f"{m} {figure(m, bound[m])}" for m in self.limits if m in bound)
            found.append((d.name, f"{d.choice.decision}: {d.choice.what}", errors, d.formula))
        return found

    def as_dict(self) -> dict[str, Any]:
        """Everything, for JSON."""
        sample, pixel, hits = self.noise
        return {
            "noise": {"sample": sample, "map_pixel": pixel, "samples_per_pixel": hits},
            "budget": {m: {"limit": v, "spent": self.spent[m]} for m, v in self.limits.items()},
            "joins_bands": self.joined,
            "states": self.states,
            "effects": [self._effect(d) for d in self.decided],
        }

    def _effect(self, d: Decided) -> dict[str, Any]:
        metrics = self.limits
        saves = d.choice.saves
        return {
            "operator": d.operator,
            "effect": d.effect.name,
            "decision": d.choice.decision,
            "what": d.choice.what,
            "settings": {k: _plain(v) for k, v in d.choice.settings.items()},
            "bound": {k: float(v) for k, v in d.choice.bound.items() if k in metrics},
            "formula": d.formula,
            "size": {k: float(v) for k, v in d.effect.size.items() if k in metrics},
            "saves": None if saves is None else dataclasses.asdict(saves),
            "reason": d.reason,
        }

    def text(self, omitted: Sequence[Row]) -> str:
        """Noise, budget and effects. ``omitted``: what is left out by structure."""
        said = [f"noise: {self._noise()}"]
        if joined := self.joined:
            said.append(
                f"{joined} joins the bands: the bounds are of this band alone and need not hold, so"
                " that nothing is coarsened"
            )
        said += [f"{name} {what}: {why}" for name, what, _, why in omitted]
        said += [f"{label}: {line}" for label, lines in self.states.items() for line in lines]
        sums = [
            (name, *(figure(m, values[m]) for m in self.limits))
            for name, values in (("added by this plan", self.spent), ("budget", self.limits))
        ]
        changed = [d for d in self.decided if d.chosen]
        absent = [d for d in self.decided if not d.simulated]
        kept = [d for d in self.decided if not d.adds_error]
        parts = [
            map(wrapped, said),
            aligned(sums, ["errors, at most", *self.limits], "<>"),
            self._table("Left out or coarser, with the error that this adds at most:", changed),
            self._table("In full, with what each effect contributes at most:", kept),
            self._table("Not simulated by zonda, with the error of that at most:", absent),
            [wrapped(f"{d.effect.name}: {d.formula}") for d in kept if not d.effect.size],
        ]
        return "\n\n".join(filter(None, map("\n".join, parts)))

    def _noise(self) -> str:
        sample, pixel, hits = self.noise
        coverage = self.context.coverage
        plane = self.context.first.focalplane
        if not (pixel and coverage):
            return f"{kelvin(sample)} per sample; no map" if sample else "none"
        words = (
            f"{kelvin(pixel)} per map pixel ({hits:.0f} samples in the deep part),"
            f" {kelvin(sample)} per sample"
        )
        fwhm = expected_fwhm(plane.fwhm, plane.net)
        # sqrt(pixel area / (4 pi sigma^2)), where pixels are small
        smoothing = coverage.pixel / fwhm * math.sqrt(2 * math.log(2) / math.pi)
        if smoothing >= 0.5:
            return words
        beam, both = (f"{math.degrees(f) * 3600:.3g} arcsec" for f in (fwhm, math.sqrt(2) * fwhm))
        return (
            f"{words}; {kelvin(pixel * smoothing)} in the map smoothed with the beam ({beam};"
            f" resolution {both}), the white noise alone"
        )

    def _table(self, title: str, decided: Sequence[Decided]) -> list[str]:
        """Effects under their operators: form, bound in each metric, and why."""
        bounds = [d.choice.bound if d.adds_error else d.effect.size for d in decided]
        metrics = [m for m in self.limits if any(m in bound for bound in bounds)]
        rows: list[Sequence[str]] = []
        before = ""
        for d, bound in zip(decided, bounds, strict=True):
            if not bound:
                continue  # a statement
            if d.operator != before:
                rows.append([d.operator])
            before = d.operator
            saves = d.choice.saves
            why = f"; saved {100 * saves.share:.2g} % of {saves.scene}" if saves else ""
            figures = (figure(m, bound[m]) if m in bound else "" for m in metrics)
            rows.append([f"  {d.effect.name}", d.choice.what, *figures, d.reason + why])
        head = ["", "", *metrics]
        align = "<<" + ">" * len(metrics) + "<"
        return [title, *aligned(rows, head, align)] if rows else []


@dataclass(frozen=True)
class Plan:
    """Decisions on each effect, the same for all bands of the camera; the errors that they add in
    each band; memory and time of the run.

    Attributes
    ----------
    structure
        What takes part at all.
    bands
        Errors by name of the band; the name of a camera's only band is empty.
    memory
        Bytes of the run.
    timing
        CPU time, where it was measured.
    """

    structure: Structure
    bands: Mapping[str, PlanOfBand]
    memory: float
    timing: Timing | None = None

    @property
    def _first(self) -> PlanOfBand:
        return next(iter(self.bands.values()))

    @property
    def decided(self) -> tuple[Decided, ...]:
        """Decisions with the bounds of the first band."""
        return self._first.decided

    @property
    def context(self) -> Context:
        """Scans of the first band."""
        return self._first.context

    @property
    def joined(self) -> str:
        """Steps that join the bands."""
        return self._first.joined

    @property
    def noise(self) -> tuple[float, float, float]:
        """`PlanOfBand.noise` of the first band."""
        return self._first.noise

    @property
    def operators(self) -> tuple[str, ...]:
        """Labels of the operators that act."""
        left_out = {d.operator for d in self.decided if d.choice.leave_out}
        return tuple(label for label in self.structure.operators if label not in left_out)

    @property
    def summary(self) -> PlanSummary:
        """Summary for a run."""
        return PlanSummary(
            self.operators,
            self.structure.runs,
            self.settings(),
            self.short(),
            self.memory,
            foreseen(self.memory, self.timing),
        )

    def apply(self, file: PipelineFile) -> PipelineFile:
        """The pipeline that is run: an ordinary one, with parameters changed and operators
        omitted.
        """
        return self.summary.apply(file)

    def deciding(self, *decided: Decided, structure: Structure | None = None) -> Plan:
        """The plan with other decisions, of its first band alone."""
        band = dataclasses.replace(self._first, decided=decided)
        return dataclasses.replace(self, bands={"": band}, structure=structure or self.structure)

    def settings(self) -> dict[str, dict[str, Any]]:
        """Changed parameters by operator. Lists that several effects set are joined."""
        found: dict[str, dict[str, Any]] = {}
        for d in self.decided:
            for key, value in d.choice.settings.items():
                mine = found.setdefault(d.operator, {})
                mine[key] = [*mine.get(key, []), *value] if isinstance(value, list) else value
        return found

    def short(self) -> list[Row]:
        """Rows for headers: steps that are omitted by structure first."""
        every = [(name, row) for name, own in self.bands.items() for row in own.short()]
        return [*omissions(self.structure), *((_of(n) + row[0], *row[1:]) for n, row in every)]

    def as_dict(self) -> dict[str, Any]:
        """Everything, for JSON."""
        each = {name: own.as_dict() for name, own in self.bands.items()}
        return {
            **each.get("", {"bands": each}),
            "left_out": [dataclasses.asdict(row) for row in self.structure.rows],
            "derived": dict(self.structure.derived),
            "prediction": as_dict_of(self.memory, self.timing),
        }

    def _repr_html_(self) -> str:
        from ..tables import html_table

        return html_table("Plan", [row[:2] for row in self.short()])

    def __str__(self) -> str:
        omitted = omissions(self.structure)
        parts = [_of(name, "band ") + own.text(omitted) for name, own in self.bands.items()]
        last = ["docs/plan.md and --json have the formulas"]
        if self.timing is not None:
            each = {label: self.timing.of(label) for label in self.timing.growing}
            used = ", ".join(f"{label} {duration(s)}" for label, s in each.items() if s > 0)
            last.append(wrapped(f"CPU time: {used}"))
            last += [wrapped(f"{label}: {words}") for label, words in self.timing.basis.items()]
        last.append(("" if "" in self.bands else "all bands: ") + str(self.summary))
        return "\n\n".join([*parts, "\n".join(last)])


def _of(band: str, what: str = "") -> str:
    """The beginning of a line about a band; empty for a camera's only one."""
    return f"{what}{band}: " if band else ""


def wrapped(text: str) -> str:
    """Lines of text, indented from the second on."""
    return textwrap.fill(text, WIDTH, subsequent_indent="  ")


def omissions(structure: Structure) -> list[Row]:
    """Rows of the steps and signals that are left out by structure, and of remainders."""
    found = []
    for row in structure.rows:
        signal = f"signal {row.run}" if row.run else ""
        found.append((": ".join(filter(None, (signal, row.operator))), "left out", "", row.reason))
    derived = structure.derived.items()
    return found + [(f"signal {run}", "remainder", "", how) for run, how in derived]


def foreseen(memory: float, timing: Timing | None) -> str:
    """Memory, and time where it was measured, as one line."""
    size = f"{memory / 1e9:.2g} GB"
    if timing is None:
        return f"about {size}"
    setup = duration(sum(timing.setup.values()))
    return (
        f"about {duration(timing.total)} of CPU time ({setup} of it set-up) and {size}; measured"
        f" on {timing.slice}"
    )


def as_dict_of(memory: float, timing: Timing | None) -> dict[str, Any]:
    """Memory and time, for JSON."""
    times = timing and {
        "cpu_seconds": timing.total,
        "set_up": dict(timing.setup),
        "with_samples": dict(timing.growing),
        "slice": timing.slice,
        "basis": dict(timing.basis),
    }
    return {"bytes": memory, **(times or {})}


def duration(seconds: float) -> str:
    """A duration as text, in s, min or h."""
    if seconds < 120:
        return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _plain(value: Any) -> Any:
    return value if isinstance(value, (int, float, str, bool, list, type(None))) else str(value)
