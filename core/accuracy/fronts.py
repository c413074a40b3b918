"""Pareto fronts as files, which `accuracy: 1 %` in a pipeline chooses from; the errors of a stored
front, or of a run, measured again.

The front of ``pipelines/my.yaml`` for the metric ``peak`` is ``pipelines/fronts/my.peak.json``. It
holds for the pipeline it was made of: a fingerprint of scene and steps, without seed, knobs and the
length of the scans, is compared.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from ..configuration.pipeline_file import PipelineFile
from ..data import Data
from ..errors import InputError
from ..experiment.variant import FileVariant
from ..operator import Operator
from ..output import Output
from ..plan.planning import planning_of
from ..storage.files import write_text
from .metrics import get, metric_of
from .pareto import Point, Study, cheapest
from .settings import LENGTH, Setting, knobs_of, overrides
from .sweep import tightest

FORMAT = 2
"""1: ``reference_error`` without the knobs that stay as in the file."""


@dataclass(frozen=True)
class StoredFront:
    """A stored Pareto front: its points, what the reference is itself wrong by, and what it was
    measured on. ``staying``: values of the knobs that redraw, which are those of the file in all
    points."""

    metric: str
    fingerprint: str
    reference_error: float
    points: tuple[Point, ...]
    shorter: Setting
    reference: Setting
    seed: int
    staying: Setting


@dataclass(frozen=True)
class Choice:
    """Overrides to run with, the error they were measured to have (None: not known), and why they
    were chosen.
    """

    overrides: tuple[str, ...]
    error: float | None
    reason: str


def fingerprint(file: PipelineFile) -> str:
    """Fingerprint of the subject of a Pareto front: the scene without its seed, the steps without
    their knobs, the length of the scans and the outputs. Files count by name and size, parameters
    at their defaults not at all.
    """
    scene = file.scene()
    described: list[Any] = [
        {k: _plain(getattr(scene, k)) for k in type(scene).model_fields if k != "seed"},
        [
            (step.key, _described(step.operator))
            for step in file.steps
            if not isinstance(step.operator, Output)
        ],
    ]
    return hashlib.blake2b(
        json.dumps(described, sort_keys=True).encode(),
        digest_size=8,
    ).hexdigest()


def as_json(study: Study, file: PipelineFile) -> dict[str, Any]:
    """The whole study as plain values: the stored file, and what ``--json`` prints."""
    from ..machine import versions

    setup = study.setup
    return {
        "format": FORMAT,
        "pipeline": file.header.name,
        "fingerprint": fingerprint(file),
        "metric": setup.metric,
        "says": study.says,
        "seed": file.scene().seed,
        **{key: getattr(setup, key) for key in ("target", "shorter", "settings")},
        **{key: getattr(setup, key) for key in ("repeats", "threads")},
        "versions": versions(),
        "noise_floor": study.floor,
        "realization_scatter": study.scatter,
        "reference": study.sweep.reference,
        "reference_error": study.sweep.left,
        "staying": {a.knob.key: a.knob.present for a in study.sweep.alone if a.knob.redraws},
        "first_run_seconds": study.first,
        "alone": [
            {
                "knob": a.knob.key,
                **{key: getattr(a.knob, key) for key in ("approximates", "redraws")},
                **{key: getattr(a, key) for key in ("left", "how")},
                "rungs": list(map(asdict, a.rungs)),
            }
            for a in study.sweep.alone
        ],
        "points": [asdict(p) for p in study.points],
        "front": [asdict(p) for p in study.front],
        "present": asdict(study.present),
        "chosen": asdict(study.chosen) if study.chosen else None,
    }


def path_for(file: PipelineFile, metric: str) -> Path:
    """Path of the front of this pipeline file, stored or not."""
    place = Path(file.place)
    return place.parent / "fronts" / f"{place.stem}.{metric}.json"


def save(study: Study, file: PipelineFile, path: Path | None = None) -> Path:
    """Write the study where `settings_for` looks for it, or to ``path``; its path."""
    path = path or path_for(file, study.setup.metric)
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_text(path, json.dumps(_rounded(as_json(study, file)), indent=1) + "\n")


def read(path: Path) -> StoredFront:
    """A stored Pareto front. Raises InputError where it cannot be read or is of another format."""
    cure = "make it anew: zonda accuracy PIPELINE --store"
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if values["format"] != FORMAT:
            raise InputError(
                f"is a Pareto front of format {values['format']}, not {FORMAT}",
                place=str(path),
                cure=cure,
            )
        return TypeAdapter(StoredFront).validate_python(values)
    except ValidationError as err:
        first = err.errors()[0]
        reason = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as err:
        reason = f"{type(err).__name__}: {err}"
    raise InputError(f"is not a stored Pareto front ({reason})", place=str(path), cure=cure)


def settings_for(file: PipelineFile, target: float, metric: str = "map_rms") -> Choice:
    """The knobs with which this pipeline meets ``target`` at least cost, by its stored Pareto
    front; else all at their tightest.

    Knobs that the file states are left as they are. The errors of a front are measured on the scans
    it was made with; what this run has is measured by ``zonda run --verify``. Raises
    `RegistryError` for a metric that is not there.
    """
    get(metric)
    knobs = knobs_of(file)
    known = {k.key for k in knobs}
    given = [k.key for k in knobs if k.given]
    path = path_for(file, metric)
    why = f"no stored Pareto front of {metric} for this pipeline ({path})"
    point = None
    front = None
    if path.is_file():
        front = read(path)
        changed = [
            f"{k.key}={front.staying[k.key]}"
            for k in knobs
            if front.staying.get(k.key, k.present) != k.present
        ]
        of = f"the stored Pareto front of {metric}"
        if front.fingerprint != fingerprint(file) or not front.reference.keys() <= known:
            why = f"{of} ({path}) is of other steps or another scene"
        elif changed:
            why = f"{of} ({path}) was made with {' '.join(changed)}"
        elif (point := cheapest(front.points, target, front.reference_error)) is None:
            why = f"no point of {of} meets {100 * target:g} %"
    chosen = tightest(knobs) if point is None else point.setting
    setting = {k: v for k, v in chosen.items() if k not in given}
    error = None
    if point is not None and front is not None:
        error = point.error + front.reference_error
        knobs_then = " ".join(overrides(setting)) or "the knobs as they are"
        reason = f"stored Pareto front of {metric}: {100 * error:.2g} % with {knobs_then}"
    else:
        reason = (
            f"{why}: the knobs are at their tightest; `zonda accuracy {file.header.name} --store`"
            " makes one"
        )
    if kept := [f"{k.key}={k.present}" for k in knobs if k.given and not k.redraws]:
        reason += f"; as the file states: {' '.join(kept)}"
        error = None
    return Choice(overrides(setting), error, reason)


def _plain(value: Any) -> str:
    """Text of the fields in SI, without those that are no part of a resolved file: they change no
    result.
    """
    if not isinstance(value, BaseModel):
        return repr(value)
    fields = [
        (name, getattr(value, name))
        for name, field in type(value).model_fields.items()
        if not field.exclude
    ]
    return (
        f"{type(value).__name__}({', '.join(f'{name}={_plain(inner)}' for name, inner in fields)})"
    )


def _described(operator: Operator) -> dict[str, Any]:
    length = LENGTH if "boresight" in operator.provides else ()
    fields = operator.model_dump(
        exclude_defaults=True,
        exclude={*length, *(k.parameter for k in planning_of(operator).knobs)},
    )
    return {
        k: [v.name, v.stat().st_size] if isinstance(v, Path) else repr(v) for k, v in fields.items()
    }


def _rounded(value: Any) -> Any:
    """Figures to 6 digits: more would only make every stored file differ."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, list | tuple) else value


SLACK = 0.2
"""By how much an error may exceed the stored one, relative: bits differ between CPUs, and the small
errors with them.
"""
SMALLEST = 1e-5
"""Errors below this are not told apart."""


@dataclass(frozen=True)
class Retest:
    """A point of a stored Pareto front and its error now."""

    setting: dict[str, str]
    stored: float
    now: float

    @property
    def good(self) -> bool:
        return self.now <= self.stored * (1 + SLACK) + SMALLEST


def achieved(
    file: PipelineFile,
    pipeline: str,
    settings: Sequence[str],
    metric: str,
    threads: int | None = None,
    data: Data | None = None,
) -> tuple[float, dict[str, float]]:
    """Error of this pipeline's own setting against its knobs at their tightest, same scans and
    seed; and that of each band by its name, of which it is the largest (empty where the camera has
    one band).

    ``data``: of a run of it, which saves one of the two runs where the metric needs no step and no
    signal of its own.
    """
    measures = metric_of(file, metric)
    measures.check(file.operators, file.runs)

    def found(given: Sequence[str]) -> Any:
        return measures.measure(
            FileVariant(pipeline, tuple(given)).run([measures], threads=threads)
        )

    added = len(measures.steps(list(file.operators))) > len(file.operators)
    enough = data is not None and not added and not measures.signals(file.runs)
    own = measures.measure(data) if enough and data is not None else found(settings)
    tightened = found((*settings, *overrides(tightest(knobs_of(file)))))
    return measures.error(own, tightened), dict(measures.errors(own, tightened))


def retest(
    front: StoredFront,
    file: PipelineFile,
    pipeline: str,
    points: int | None = None,
) -> list[Retest]:
    """Measure the errors of a stored Pareto front again (of the ``points`` with the largest
    errors): errors only, never times, and therefore in this process.

    Raises InputError where the front is of another pipeline.
    """
    if front.fingerprint != fingerprint(file):
        cure = "make it anew: zonda accuracy PIPELINE --store"
        raise InputError(
            "the stored Pareto front is of other steps or another scene",
            place=file.place,
            cure=cure,
        )
    metric = metric_of(file, front.metric)
    base = (*overrides(front.shorter), f"seed={front.seed}")

    def found(setting: dict[str, str]) -> Any:
        variant = FileVariant(pipeline, (*base, *overrides(setting)))
        return metric.measure(variant.run([metric], threads=1))

    reference = found(front.reference)
    chosen = sorted((p for p in front.points if p.error > 0), key=lambda p: -p.error)[:points]
    return [Retest(p.setting, p.error, metric.error(found(p.setting), reference)) for p in chosen]
