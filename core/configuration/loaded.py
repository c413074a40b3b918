"""A pipeline file after it was checked."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from zonda import __version__

from ..assembly.checks import looks, run_checks, warn_of_nothing_saved
from ..discovery import is_yaml_file
from ..errors import ZondaError
from ..operator import Operator
from ..pipeline import Pipeline
from ..scene import Scene
from ..signal import Signal
from ..variants import is_variant, written
from . import yaml_places
from .diagnostics import ConfigurationError, Diagnostic, refused
from .input_paths import paths_in
from .parameters import Parameters, quantity
from .units import Fraction, Kelvin
from .yaml_places import Document
from .yaml_places import Path as Place


class Accuracy(Parameters):
    """Metric for which the knobs are chosen."""

    target: Fraction = Field(gt=0, le=1, examples=["1 %"])
    """Largest error of the metric."""
    metric: str = "map_rms"
    """A metric of `zonda accuracy`."""

    @model_validator(mode="before")
    @classmethod
    def _target_alone(cls, value: Any) -> Any:
        return value if isinstance(value, dict | Accuracy) else {"target": value}


class Limits(Parameters):
    """Largest errors that the plan may add, in the products' own units."""

    map_rms: Kelvin | None = Field(None, ge=0, examples=["50 uK"])
    """rms per map pixel, e.g. 3 uK; where absent, a tenth of the noise."""
    peak: Kelvin | None = Field(None, ge=0, examples=["50 uK"])
    """Of the sky's brightness in the map; where absent, as `map_rms`."""
    transfer: Fraction | None = Field(None, ge=0, le=1, examples=["1 %"])
    """Of the transfer function; where absent, 1 %."""
    tod: Kelvin | None = Field(None, ge=0, examples=["1 mK"])
    """rms of one sample of the calibrated time stream; where absent, a tenth of its white noise."""

    psd: Fraction | None = Field(None, ge=0, le=1, examples=["1 %"])
    """Of the time stream's power spectrum, relative; where absent, 10 %."""

    @model_validator(mode="after")
    def _something(self) -> Limits:
        if not self.model_fields_set:
            raise ValueError(
                "state at least one of map_rms, peak, transfer, tod, psd; or a share of the noise,"
                " e.g. 10 %"
            )
        return self


class Header(Parameters):
    """Top level of a pipeline file, without its scene and its operators."""

    version: Literal[1] = 1
    """Version of this file format."""
    name: str = Field("", pattern=r"^$|^[A-Za-z0-9][\w .+-]*$")
    """Shown in products; where absent, the file's name without suffix."""
    description: str = ""
    """One line for `zonda pipelines`."""
    requires: list[str] = Field(default_factory=list)
    """Packages and versions this file needs, as pip writes them, e.g. zonda-toltec>=1.2."""
    runs: dict[str, Signal] = Field(default_factory=dict)
    """Further signals, e.g. noiseless: {only: [sky]} or source_free: {without: [sky]}: what a
    subset of the components makes.
    """
    only: list[str] = Field(default_factory=list)
    """Components that the complete signal is narrowed to (`--only`), at the levels of the whole
    scene; where absent, all.
    """
    precision: Literal["float32", "float64"] = "float32"
    """Type of the time streams."""
    accuracy: Accuracy | None = None
    """Error that the result may have from its approximations, e.g. 1 %, or {target: 1 %, metric:
    peak}: `zonda run` then takes the cheapest setting of the knobs that a stored Pareto front of
    `zonda accuracy` shows to meet it, else the tightest."""
    budget: Annotated[Fraction, Field(ge=0, le=1)] | Limits = quantity("10 %")
    """Errors that the plan may add: a share of the noise (0: simulate everything in full), or e.g.
    {map_rms: 3 uK}.
    """
    campaign: Any = None
    """None; a file with a campaign has the header of its `Section`."""
    sweep: Any = None
    """None; see `Section`."""
    outputs: Path | None = None
    """Folder for products, relative to the working directory; where absent, out/<name>."""

    @field_validator("outputs")
    @classmethod
    def _a_path(cls, value: Path | None) -> Path | None:
        if value is not None and "\0" in str(value):
            raise ValueError("a folder's name cannot hold a null character")
        return value


SCENE_KEYS = tuple(Scene.model_fields)
KEYS = [
    "version",
    "name",
    "description",
    "requires",
    "seed",
    "site",
    "instrument",
    "time",
    "target",
    "weather",
]
KEYS += [key for key in (*SCENE_KEYS, *Header.model_fields) if key not in KEYS] + ["operators"]


@dataclass(frozen=True)
class Step:
    """One operator, the name it goes by in the file, and where it stands there."""

    key: str
    operator: Operator
    at: Place = ()


@dataclass(frozen=True)
class PipelineFile:
    """A checked pipeline file.

    Attributes
    ----------
    header
        Name, description, further signals, precision, folder for products.
    parameters
        The scene's parameters as the file gives them: names of site and instrument, or their
        definitions.
    steps
        The operators, in order.
    place
        The file's path, or what else the text was called.
    document
        The text with its places; None for what was never a file.
    """

    header: Header
    parameters: dict[str, Any]
    steps: tuple[Step, ...]
    place: str
    _scene: Scene
    document: Document | None = field(default=None, repr=False, compare=False)

    @property
    def operators(self) -> list[Operator]:
        """The operators, in order."""
        return [step.operator for step in self.steps]

    @property
    def runs(self) -> dict[str, Signal]:
        """Further signals by name."""
        return self.header.runs

    @property
    def output(self) -> Path:
        """Folder for products."""
        assert self.header.outputs is not None  # filled in by `parse`
        return self.header.outputs

    @property
    def inputs(self) -> list[Path]:
        """Input files that it names, those that are there."""
        return [p for p in paths_in([self.scene(), *self.operators]) if p.is_file()]

    def scene(self) -> Scene:
        """Scene of the file: site, instrument, time, target, seed."""
        return self._scene

    def pipeline(self) -> Pipeline:
        """New `Pipeline` of the operators."""
        header = self.header
        return Pipeline(
            self.operators,
            runs=header.runs,
            only=header.only,
            name=header.name,
            description=header.description,
            precision=header.precision,
        )

    def look(
        self,
        *,
        saved: bool = True,
        scene: Scene | None = None,
        say: Callable[[str], None] | None = None,
    ) -> list[list[str]]:
        """Let each step check itself, as `run_checks` does. Raises `ConfigurationError` with all
        mistakes of the steps, each at its place in the file.

        ``say`` is told each step before it is looked at.
        """
        pipeline = self.pipeline()
        scene = scene or self.scene()
        if self.document is None:
            return run_checks(pipeline, scene, saved=saved)
        found, refused = looks(pipeline.operators, scene, say)
        if refused:
            mistakes = [refusal(self.document, self.steps[number], err) for number, err in refused]
            raise ConfigurationError(mistakes, self.place)
        if saved:
            warn_of_nothing_saved(pipeline)
        return found

    def resolved_yaml(self, folder: Path | None = None) -> str:
        """The file with every default filled in, which loads again to the same thing.

        Paths of files in ``folder`` are written from there on: it may move.
        Site and instrument stay names where they were names, and a variant stays one; what they
        stand for is written under ``x-resolved``.
        """
        header = self.header.model_dump(mode="json")
        header["runs"] = {
            name: run.model_dump(mode="json", exclude_none=True) for name, run in self.runs.items()
        }
        del header["sweep"]  # it is a campaign now
        if self.header.campaign is None:
            del header["campaign"]
        else:
            header["campaign"] = self.header.campaign.model_dump(mode="json", exclude_none=True)
        scene = self._scene.model_dump(mode="json")
        for kind in ("site", "instrument"):  # each as its own class, with all its fields
            scene[kind] = getattr(self._scene, kind).model_dump(mode="json")
        given = {
            kind: self.parameters.get(kind) for kind in ("site", "instrument")
        }  # None: recorded data bring it
        named = {
            kind: scene[kind]
            for kind, value in given.items()
            if value is None
            or is_variant(value)
            or (isinstance(value, str) and not is_yaml_file(value))
        }
        values = header | scene | {kind: given[kind] for kind in named}
        values = {
            key: value for key, value in values.items() if key not in given or value is not None
        }
        if is_variant(given["instrument"]):
            values["instrument"] = written(self.parameters["instrument"], self._scene.instrument)
        tree = {key: values[key] for key in KEYS if key in values}
        tree["operators"] = [{step.key: _filled(step.operator)} for step in self.steps]
        if named:
            tree["x-resolved"] = named
        if folder is not None:
            tree["operators"] = _from_there(tree["operators"], f"{folder.resolve()}{os.sep}")
        return f"# zonda {__version__}: every default filled in\n{yaml_places.dump(tree)}"

    def __repr__(self) -> str:
        return f"<PipelineFile {self.place}: {' > '.join(step.key for step in self.steps)}>"


def refusal(document: Document, step: Step, err: ZondaError) -> Diagnostic:
    """An error of a step at the parameter whose file it names, or at the step."""
    at = document.mark(step.at)
    for name in type(step.operator).model_fields:
        value = getattr(step.operator, name)
        if (
            isinstance(value, os.PathLike)
            and str(value) in f"{err.place} {err.message}"
            and (*step.at, name) in document.marks
        ):
            return refused(err, document.mark((*step.at, name)).value)
    return refused(err, at.start)


def _from_there(value: Any, folder: str) -> Any:
    """A tree in which texts that begin with ``folder`` are without it."""
    if isinstance(value, dict):
        return {key: _from_there(inner, folder) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_from_there(inner, folder) for inner in value]
    return value.removeprefix(folder) if isinstance(value, str) else value


def _filled(operator: Operator) -> dict[str, Any]:
    """Parameters of an operator, without those that do not apply beside the others.

    Left out are parameters that are absent (None) by default and in fact, and defaults that the
    operator refuses when they are written down (e.g. the ordering of HEALPix pixels for a map that
    is not HEALPix).
    """
    model = type(operator)
    fields = type(operator).model_fields
    values = operator.model_dump(mode="json")
    values = {
        k: v
        for k, v in values.items()
        if v is not None or (k in fields and fields[k].get_default() is not None)
    }
    if _accepts(model, values):
        return values
    kept = set(operator.model_fields_set)
    for name in values:
        if _accepts(model, {k: v for k, v in values.items() if k in kept or k == name}):
            kept.add(name)
    return {k: v for k, v in values.items() if k in kept}


def _accepts(model: type[Operator], values: dict[str, Any]) -> bool:
    try:
        model.model_validate(values)
    except (ValidationError, ZondaError):
        return False
    return True
