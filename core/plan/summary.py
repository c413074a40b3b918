"""What a run takes from a plan. A run whose plan is remembered imports this module, not the
planner.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..configuration.pipeline_file import PipelineFile, Step
from ..label import labels
from .figures import duration


@dataclass(frozen=True)
class Prediction:
    """CPU seconds by operator, memory, and the operators of unknown cost."""

    seconds: Mapping[str, float]
    bytes: float
    unknown: tuple[str, ...] = ()
    startup: float = 0.0
    times: Mapping[str, float] = field(default_factory=dict)
    """How often each operator does its work, by label (`context.Work`)."""
    factors: Mapping[str, float] = field(default_factory=dict)
    products: float = 0.0
    """Bytes that are held while another band of the camera acts: what steps add up over all scans,
    and all where bands are executed together."""

    @property
    def total(self) -> float:
        """CPU seconds of the whole run."""
        return self.startup + sum(self.seconds.values())


@dataclass(frozen=True)
class PlanSummary:
    """What a run takes from a plan (`result.Plan.summary`).

    Attributes
    ----------
    operators, runs
        Labels of the operators, and names of the signals beside the complete one, that act.
    settings
        Changed parameters by operator.
    short
        Rows for headers and the report (`result.short`).
    """

    operators: tuple[str, ...]
    runs: tuple[str, ...]
    settings: Mapping[str, Mapping[str, Any]]
    short: list[tuple[str, str, str, str]]
    prediction: Prediction
    unpruned: Prediction

    def omitted(self, file: PipelineFile) -> list[str]:
        """The steps and signals of a pipeline file that do not act."""
        steps = [o.label for o in file.pipeline().operators if o.label not in self.operators]
        return steps + [f"signal {name}" for name in file.runs if name not in self.runs]

    def apply(self, file: PipelineFile) -> PipelineFile:
        """The pipeline that is run: an ordinary one, with parameters changed and operators
        omitted.
        """
        steps, kept = [], []
        for label, step in zip(
            (o.label for o in file.pipeline().operators), file.steps, strict=True
        ):
            if label in self.operators:
                update = self.settings.get(label, {})
                steps.append(
                    Step(
                        step.key,
                        step.operator.model_copy(update=dict(update)) if update else step.operator,
                    )
                )
                kept.append(label)
        runs = {name: run for name, run in file.runs.items() if name in self.runs}
        header = file.header.model_copy(
            update={"runs": runs, "budget": 0.0, **self.settings.get("pipeline", {})}
        )
        return dataclasses.replace(file, header=header, steps=tuple(same_labels(steps, kept)))

    def __str__(self) -> str:
        p, u = self.prediction, self.unpruned
        words = f"about {duration(p.total)} of CPU time and {p.bytes / 1e9:.2g} GB"
        if u.total - p.total > 0.01 * u.total:
            words += f" (everything on: {duration(u.total)}, {u.bytes / 1e9:.2g} GB)"
        return words + (f", not counting {', '.join(p.unknown)}" if p.unknown else "")


def same_labels(steps: list[Step], wanted: list[str]) -> list[Step]:
    """The steps, named where need be: each keeps its label, which its random numbers depend on,
    though a namesake is left out.
    """
    named = []
    for step, label, new in zip(steps, wanted, labels(s.operator for s in steps), strict=True):
        same = new == label
        named.append(
            step if same else Step(step.key, step.operator.model_copy(update={"name": label}))
        )
    return named
