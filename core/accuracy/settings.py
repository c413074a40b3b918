"""The knobs of a pipeline file, their settings, and shorter scans."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ..configuration import yaml_places
from ..configuration.diagnostics import nearest
from ..configuration.pipeline_file import PipelineFile
from ..errors import InputError
from ..operator import Operator
from ..plan.planning import PRECISION, Knob, planning_of

Setting = dict[str, str]
"""Values by key, both as ``--set`` takes them: {"PinkNoise.poles": "8"}."""

QUICK_SECONDS = 30.0
QUICK_SCANS = 2
QUICK_SAMPLES, QUICK_SHORTEST = 6e6, 5.0
"""Samples of all detectors in all scans above which ``--quick`` makes scans shorter still, down to
so many seconds.
"""
LENGTH = ("scan_duration", "scans")
"""Parameters of pointing steps that say how long is observed: what `shortened` changes."""


@dataclass(frozen=True)
class PipelineKnob:
    """A knob of one step of a pipeline, or of the pipeline.

    Attributes
    ----------
    key
        As ``--set`` takes it: ``WhiteNoise.2.poles``.
    step
        Label of the step in timings; empty for a knob of the pipeline.
    ladder
        Values as YAML text, coarse to fine.
    present
        The file's value, as YAML text.
    given
        Whether the file states it.
    """

    key: str
    step: str
    ladder: tuple[str, ...]
    approximates: str
    redraws: bool
    present: str
    given: bool

    @property
    def tightest(self) -> str:
        return self.ladder[-1]


def overrides(setting: Mapping[str, str]) -> tuple[str, ...]:
    """The setting as ``--set`` takes it."""
    return tuple(f"{key}={value}" for key, value in setting.items())


def knobs_of(file: PipelineFile, only: Iterable[str] = ()) -> list[PipelineKnob]:
    """The knobs of a pipeline's steps, in order; ``only``: those of these keys, operators or
    parameters.

    Raises
    ------
    InputError
        Where there are none, or ``only`` names one that is not there (the nearest is named).
    """
    found = []
    labels = [operator.label for operator in file.pipeline().operators]
    names = _names(file)
    for step, label, name in zip(file.steps, labels, names, strict=True):
        values = step.operator.model_dump(mode="json")
        for knob in planning_of(step.operator).knobs:
            given = knob.parameter in step.operator.model_fields_set
            present = _on_ladder(knob, step.operator) or text(values[knob.parameter])
            found.append(_knob(knob, f"{name}.{knob.parameter}", label, present, given))
    header = file.header
    found.append(
        _knob(
            PRECISION,
            PRECISION.parameter,
            "",
            text(header.precision),
            "precision" in header.model_fields_set,
        )
    )
    chosen = []
    keys = [knob.key for knob in found]
    for word in only:
        those = [
            k
            for k in found
            if word == k.key or word in (k.key.rpartition(".")[0], k.key.rpartition(".")[2])
        ]
        if not those:
            hint = nearest(word, [*keys, *{k.rpartition(".")[2] for k in keys}])
            raise InputError(
                f"no knob is called '{word}'{'; ' + hint if hint else ''}",
                place="--knob",
                cure=_list(keys),
            )
        chosen += [k for k in those if k not in chosen]
    return chosen if only else found


def shortened(file: PipelineFile, duration: str | None, quick: bool) -> Setting:
    """Overrides of the pointing steps' `scan_duration` (and `scans`); ``quick``: at most two scans
    of 30 s, of less where they would hold more than `QUICK_SAMPLES` samples, but not of less than
    `QUICK_SHORTEST` seconds.

    Raises InputError where no pointing step has a `scan_duration`.
    """
    if not duration and not quick:
        return {}
    setting: Setting = {}
    for step, name in zip(file.steps, _names(file), strict=True):
        operator: Any = step.operator
        if "boresight" not in operator.provides or not hasattr(operator, "scan_duration"):
            continue
        if duration:
            setting[f"{name}.scan_duration"] = duration
        elif operator.scan_duration > (most := _quick_seconds(file, operator)):
            setting[f"{name}.scan_duration"] = f"{most:g} s"
        if quick and getattr(operator, "scans", 0) > QUICK_SCANS:
            setting[f"{name}.scans"] = str(QUICK_SCANS)
    if not setting and duration:
        raise InputError(
            "no pointing step has a scan_duration",
            place="--duration",
            cure="leave --duration out",
        )
    return setting


def _quick_seconds(file: PipelineFile, pointing: Any) -> float:
    instrument = file.scene().instrument
    rate = len(instrument.focalplane()) * (
        getattr(pointing, "sample_rate", None) or instrument.sample_rate
    )
    scans = min(max(getattr(pointing, "scans", 1), 1), QUICK_SCANS)
    return min(max(float(round(QUICK_SAMPLES / (rate * scans))), QUICK_SHORTEST), QUICK_SECONDS)


def text(value: Any) -> str:
    """A value as YAML on one line."""
    return yaml_places.dump([value]).removeprefix("- ").strip()


def _knob(knob: Knob, key: str, step: str, present: str, given: bool) -> PipelineKnob:
    ladder = tuple(text(value) for value in knob.ladder)
    return PipelineKnob(key, step, ladder, knob.approximates, knob.redraws, present, given)


def _on_ladder(knob: Knob, operator: Operator) -> str:
    """The rung that the operator stands on, as text; empty where it stands between two."""
    present = getattr(operator, knob.parameter)
    values = knob.values(type(operator))
    return next(
        (text(rung) for rung, value in zip(knob.ladder, values, strict=True) if value == present),
        "",
    )


def _names(file: PipelineFile) -> list[str]:
    """Names of the steps for ``--set``: the step's own name or its operator's, numbered if several
    answer to it.
    """
    answers = [
        {s.key, s.key.rpartition(":")[2], *([s.operator.name] if s.operator.name else [])}
        for s in file.steps
    ]
    names = []
    for number, step in enumerate(file.steps):
        name = step.operator.name or step.key
        same = [i for i, labels in enumerate(answers) if name in labels]
        names.append(name if len(same) == 1 else f"{name}.{same.index(number) + 1}")
    return names


def _list(keys: list[str]) -> str:
    return (
        f"this pipeline has {', '.join(keys)}"
        if keys
        else "no step of this pipeline declares a knob"
    )
