"""Pipeline files: from YAML text to a scene and checked operators, with every mistake reported at its place."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, ValidationError, field_validator, model_validator

from .. import registry
from ..components import Registry
from ..errors import PipelineError, ZondaError
from ..operator import Operator
from ..pipeline import Pipeline
from ..plan.budget import Limits
from ..run.companion import Companion
from ..run.order import check_order
from ..scene import Scene
from ..weather import WeatherSource, resolve
from . import overrides as settings
from . import yaml_places
from .diagnostics import ConfigurationError, Diagnostic, nearest
from .explain import explain, glued, without_meant
from .locate import locate, read
from .parameters import Parameters, quantity
from .units import Fraction
from .yaml_places import Document, Source, Span

P = TypeVar("P", bound=Parameters)

EXAMPLE = "write at least: site, instrument, time, and operators (a list of steps); `zonda pipelines` lists examples"


MOST_STEPS = 1000
"""Longer pipelines are refused before they are looked at."""


class Accuracy(Parameters):
    """What the knobs are chosen for."""

    target: Fraction = Field(gt=0, le=1)
    """Largest error of the metric."""
    metric: str = "map_rms"
    """A metric of `zonda accuracy`."""

    @model_validator(mode="before")
    @classmethod
    def _target_alone(cls, value: Any) -> Any:
        return value if isinstance(value, dict | Accuracy) else {"target": value}


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
    runs: dict[str, Companion] = Field(default_factory=dict)
    """Companion runs, e.g. noiseless: {only: [sky]} or source_free: {without: [sky]}."""
    precision: Literal["float32", "float64"] = "float32"
    """Type of the time streams."""
    accuracy: Accuracy | None = None
    """Error that the result may have from its approximations, e.g. 1 %, or {target: 1 %, metric: peak}: `zonda run` then takes
    the cheapest setting of the knobs that a stored front of `zonda accuracy` shows to meet it, else the tightest."""
    budget: Annotated[Fraction, Field(ge=0, le=1)] | Limits = quantity("10 %")
    """Errors that the plan may add: a share of the noise (0: simulate everything in full), or e.g. {map_rms: 3 uK}."""
    campaign: Any = None
    """None; a file with a campaign has the header of its `Section`."""
    outputs: Path | None = None
    """Folder for products, relative to the working directory; where absent, out/<name>."""

    @field_validator("outputs")
    @classmethod
    def _a_path(cls, value: Path | None) -> Path | None:
        if value is not None and "\0" in str(value):
            raise ValueError("a folder's name cannot hold a null character")
        return value


SCENE_KEYS = tuple(Scene.model_fields)
KEYS = ["version", "name", "description", "requires", "seed", "site", "instrument", "time", "target", "weather"]
KEYS += [key for key in (*SCENE_KEYS, *Header.model_fields) if key not in KEYS] + ["operators"]


@dataclass(frozen=True)
class Step:
    """One operator and the name it goes by in the file."""

    key: str
    operator: Operator


@dataclass(frozen=True)
class PipelineFile:
    """A checked pipeline file.

    Attributes
    ----------
    header
        Name, description, companion runs, precision, folder for products.
    parameters
        The scene's parameters as the file gives them: names of site and instrument, or their definitions.
    steps
        The operators, in order.
    place
        The file's path, or what else the text was called.
    """

    header: Header
    parameters: dict[str, Any]
    steps: tuple[Step, ...]
    place: str
    _scene: Scene

    @property
    def operators(self) -> list[Operator]:
        """The operators, in order."""
        return [step.operator for step in self.steps]

    @property
    def runs(self) -> dict[str, Companion]:
        """Companion runs by name."""
        return self.header.runs

    @property
    def output(self) -> Path:
        """Folder for products."""
        assert self.header.outputs is not None  # filled in by `parse`
        return self.header.outputs

    def scene(self) -> Scene:
        """What exists: site, instrument, time, target, seed."""
        return self._scene

    def pipeline(self) -> Pipeline:
        """What is done: a new `Pipeline` of the operators."""
        header = self.header
        return Pipeline(
            self.operators, runs=header.runs, name=header.name, description=header.description, precision=header.precision
        )

    def resolved_yaml(self) -> str:
        """The file with every default filled in, which loads again to the same thing.

        Site and instrument stay names where they were names; what the names stand for is written under ``x-resolved``.
        """
        header = self.header.model_dump(mode="json")
        header["runs"] = {name: run.model_dump(mode="json", exclude_none=True) for name, run in self.runs.items()}
        if self.header.campaign is None:
            del header["campaign"]
        else:
            header["campaign"] = self.header.campaign.model_dump(mode="json", exclude_none=True)
        scene = self._scene.model_dump(mode="json")
        for kind in ("site", "instrument"):  # each as its own class, with all its fields
            scene[kind] = getattr(self._scene, kind).model_dump(mode="json")
        named = {kind: scene[kind] for kind in ("site", "instrument") if isinstance(self.parameters[kind], str)}
        values = header | scene | {kind: self.parameters[kind] for kind in named}
        tree = {key: values[key] for key in KEYS if key in values}
        tree["operators"] = [{step.key: _filled(step.operator)} for step in self.steps]
        if named:
            tree["x-resolved"] = named
        from zonda import __version__

        return f"# zonda {__version__}: every default filled in\n{yaml_places.dump(tree)}"

    def __repr__(self) -> str:
        return f"<PipelineFile {self.place}: {' > '.join(step.key for step in self.steps)}>"


def load(path_or_name: str | Path, overrides: Iterable[str] = ()) -> PipelineFile:
    """Read a pipeline file, or a shipped pipeline by its name.

    Parameters
    ----------
    path_or_name
        Path of a YAML file, or a name that `zonda pipelines` lists.
    overrides
        Changes such as ``PinkNoise.knee=0.5 Hz`` or ``seed=8``, as ``zonda run --set`` takes them.

    Raises
    ------
    ConfigurationError
        With every mistake in the file and the overrides, each with its place.
    InputError
        When there is no such file, or it is not text.
    """
    path = locate(path_or_name)
    return parse(read(path), name=str(path), folder=path.parent, overrides=overrides)


def parse(text: str, *, name: str = "<text>", folder: str | Path | None = None, overrides: Iterable[str] = ()) -> PipelineFile:
    """As `load`, from text; relative paths in it are looked for in ``folder`` first."""
    source = Source(name, text)
    document = yaml_places.load(source, longest={"operators": MOST_STEPS})
    mistakes = [Diagnostic(fault.message, fault.span, fault.label) for fault in document.faults]
    if not isinstance(document.value, dict):
        if document.value is None and not mistakes:
            mistakes = [Diagnostic("this pipeline file is empty", Span(source), "", EXAMPLE)]
        elif not mistakes:
            message = f"a pipeline file is a mapping of keys, not {_noun(document.value)}"
            mistakes = [Diagnostic(message, Span(source), "", EXAMPLE)]
        raise ConfigurationError(mistakes, name)
    for setting in [overrides] if isinstance(overrides, str) else overrides:
        mistakes += settings.apply(document, setting, KEYS)
    return _Check(document, name, folder, mistakes).run()


class _Check:
    """Turns a document into a `PipelineFile`, gathering mistakes on the way."""

    def __init__(self, document: Document, name: str, folder: str | Path | None, mistakes: list[Diagnostic]) -> None:
        self.document, self.name, self.mistakes = document, name, mistakes
        self.tree: dict[Any, Any] = document.value
        self.context = {"folder": folder}

    def run(self) -> PipelineFile:
        head = {k: v for k, v in self.tree.items() if k not in (*SCENE_KEYS, "operators") and not str(k).startswith("x-")}
        header = self.validate(self.kind_of_header(), head, (), "the pipeline", KEYS)
        self.sizes()
        self.requirements()
        scene = self.scene()
        steps = self.steps()
        if header is not None:
            self.runs(header, steps)
        if header is not None and header.campaign is not None:
            section = registry.sections.get("campaign")
            self.mistakes = section.mistakes(self.document, header.campaign, self.mistakes, self.without_campaign)
        if scene is not None and not self.mistakes and self.target_of_map:
            scene = self.targeted(scene, [s.operator for s in steps if s is not None])
        if self.mistakes:
            raise ConfigurationError(without_meant(self.mistakes), self.name)
        assert header is not None
        assert scene is not None
        stem = re.sub(r"[^\w.+-]", "_", Path(self.name).stem).lstrip("_.+-") or "pipeline"
        name = header.name or stem
        header = header.model_copy(update={"name": name, "outputs": header.outputs or Path("out") / name})
        parameters = {k: self.tree[k] for k in SCENE_KEYS if k in self.tree}
        return PipelineFile(header, parameters, tuple(s for s in steps if s is not None), self.name, scene)

    def sizes(self) -> None:
        """Raise `ConfigurationError` for more steps (of an alias; those written are counted before) or entries than allowed."""
        items, campaign = self.tree.get("operators"), self.tree.get("campaign")
        many = isinstance(items, list) and len(items) > MOST_STEPS
        if many:
            at = self.document.mark(("operators",)).start
            self.wrong(f"a pipeline of {len(items or [])} steps", at, "", f"write at most {MOST_STEPS}")
        if isinstance(campaign, dict) and not many:
            many = registry.sections.get("campaign").too_large(campaign)  # the header's own check has said so
        if many:
            raise ConfigurationError(without_meant(self.mistakes), self.name)

    @property
    def target_of_map(self) -> bool:
        """Whether the file says ``target: map``."""
        return isinstance(text := self.tree.get("target"), str) and text.strip().lower() == "map"

    def targeted(self, scene: Scene, operators: Iterable[Operator]) -> Scene:
        """The scene with the centre of the first step's input map as its target."""
        at = self.document.mark(("target",)).value
        centres = [found for o in operators if (found := getattr(o, "map_centre", None)) is not None]
        if not centres:
            self.wrong(
                "target: map takes the centre of an input map, and no step has one", at, "", "add SkyMap, or give a position"
            )
            return scene
        try:
            return scene.model_copy(update={"target": centres[0]()})
        except ZondaError as err:
            self.refused(err, at)
            return scene

    def kind_of_header(self) -> type[Header]:
        """The class that the header is checked against."""
        if self.tree.get("campaign") is None:
            return Header
        header: type[Header] = registry.sections.get("campaign").header
        return header

    def without_campaign(self, document: Document) -> list[Diagnostic]:
        """What is wrong with a document but for its campaign."""
        del document.value["campaign"]
        try:
            _Check(document, self.name, self.context["folder"], []).run()
        except ConfigurationError as err:
            return err.diagnostics
        return []

    def wrong(self, message: str, span: Span, label: str = "", help: str = "") -> None:
        self.mistakes.append(Diagnostic(message, span, label, help))

    def validate(self, model: type[P], value: Any, at: yaml_places.Path, who: str, keys: Iterable[str] = ()) -> P | None:
        try:
            return model.model_validate(value, context=self.context)
        except ValidationError as err:
            self.mistakes += explain(err, model, self.document, at, who, keys)
        except ZondaError as err:
            self.refused(err, self.document.mark(at).start)
        return None

    def refused(self, err: ZondaError, span: Span) -> None:
        message = f"{err.place}: {err.message}" if err.place else err.message
        self.wrong(message, span, getattr(err, "label", ""), err.cure)

    def requirements(self) -> None:
        wanted = self.tree.get("requires")
        if not isinstance(wanted, list):
            return
        from importlib.metadata import PackageNotFoundError, version

        from packaging.requirements import InvalidRequirement, Requirement

        from zonda import __version__

        for i, text in enumerate(wanted):
            at = self.document.mark(("requires", i)).value
            if not isinstance(text, str):
                continue  # the header's own check has said so
            try:
                requirement = Requirement(text)
                have = __version__ if requirement.name == "zonda" else version(requirement.name)
            except InvalidRequirement:
                self.wrong(f"'{text}' is not a requirement", at, "write it as pip does, e.g. zonda-toltec>=1.2")
            except PackageNotFoundError:
                self.wrong(f"this pipeline needs the package {requirement.name}", at, "not installed", f"pip install '{text}'")
            else:
                if not requirement.specifier.contains(have, prereleases=True):
                    self.wrong(f"this pipeline needs {text}", at, f"{have} is installed", f"pip install '{text}'")

    def scene(self) -> Scene | None:
        """The scene; names are looked up one by one, so that each is reported at its own place."""
        given = {key: self.tree[key] for key in SCENE_KEYS if key in self.tree and not (key == "target" and self.target_of_map)}
        lost = set()
        for kind, names in (("site", registry.sites), ("instrument", registry.instruments)):
            if kind in given and not self.named(given, kind, names, (kind,)):
                lost.add(kind)
        if isinstance(given.get("instrument"), dict):
            given["instrument"] = dict(given["instrument"])
            if not self.named(given["instrument"], "band", registry.bands, ("instrument", "band")):
                given["instrument"]["band"] = {"name": "", "low": "1 Hz", "high": "2 Hz"}  # goes on to find the other mistakes
        if given.get("weather") is not None:
            given["weather"] = self.weather(given["weather"])
        before = len(self.mistakes)
        stand_in = {kind: self.tree[kind] for kind in lost}
        given = {key: value for key, value in given.items() if key not in lost}
        scene = self.validate(Scene, given, (), "the pipeline", KEYS)
        missing = tuple(f"the pipeline needs '{kind}'" for kind in stand_in)
        self.mistakes[before:] = [m for m in self.mistakes[before:] if m.message not in missing]
        return scene

    def weather(self, value: Any) -> WeatherSource | None:
        """The weather, checked as the source that it names."""
        try:
            source, given = resolve(value)
        except ZondaError as err:
            self.refused(err, self.document.mark(("weather",)).value)
            return None
        return self.validate(source, given, ("weather",), "weather")

    def named(self, given: dict[str, Any], key: str, names: Registry, at: yaml_places.Path) -> bool:
        """Put what the name stands for in its place; False where there is no such thing."""
        if not isinstance(given.get(key), str):
            return True
        try:
            given[key] = names.create(given[key])
        except ZondaError as err:
            self.refused(err, self.document.mark(at).value)
            return False
        return True

    def steps(self) -> list[Step | None]:
        """The steps; None stands for one that could not be made."""
        items = self.tree.get("operators")
        if not isinstance(items, list) or not items:
            there = ("operators",) in self.document.marks
            span = self.document.mark(("operators",)).start if there else Span(self.document.mark(()).value.source)
            empty = items is None or items == []
            have = "'operators' is empty: it must be a list of steps" if empty else "'operators' must be a list of steps"
            message = have if there else "the pipeline needs 'operators', a list of steps"
            self.wrong(message, span, "" if there else "add 'operators:'", "write one '- Name: {parameter: value}' per step")
            return []
        steps: list[Step | None] = []
        standing: list[tuple[int, Operator]] = []  # what takes part in the check of the order
        unknown = len(items)
        for i, item in enumerate(items):
            step, stand_in = self.step(item, ("operators", i))
            steps.append(step)
            if stand_in is None:
                unknown = min(unknown, i)
            else:
                standing.append((i, stand_in))
        for problem in check_order([operator for _, operator in standing]):
            i = standing[problem.index][0]
            if i < unknown:  # an unknown step may provide anything
                mark = self.document.mark(("operators", i))
                name = next(iter(items[i])) if isinstance(items[i], dict) else None
                span = self.document.mark(("operators", i, name)).start if name is not None else mark.value
                self.wrong(problem.message, span, problem.label, problem.cure)
        return steps

    def step(self, item: Any, at: yaml_places.Path) -> tuple[Step | None, Operator | None]:
        """A step, and what stands for it in the check of the order: both None where the operator is not known."""
        name: Any
        parameters: Any
        if isinstance(item, str):  # - BinMap
            name, parameters, span, inner = item, {}, self.document.mark(at).value, at
        elif isinstance(item, dict) and len(item) == 1:  # - BinMap: {pixel: 2 arcsec}
            name, parameters = next(iter(item.items()))
            inner = (*at, name)
            span = self.document.mark(inner).start
            parameters = {} if parameters is None else parameters
        else:
            message, span, label = "each step is one operator: '- Name: {...}'", self.document.mark(at).value, ""
            if isinstance(item, dict) and item:
                second = list(item)[1]
                span, label = self.document.mark((*at, second)).start, "indent this under the operator"
                message += f"; '{second}' may be indented too little"
            self.wrong(message, span, label)
            return None, None
        name = str(name)
        try:
            operator = registry.steps.get(name)
        except ZondaError as err:
            first = re.split(r"[\s{:]", name)[0]
            if first != name and first in registry.steps:
                missing = "a space is missing behind the colon" if name[len(first)] == ":" else "a colon is missing"
                self.wrong(f"cannot read the step '{name}'", span, missing, f"write '- {first}: {{...}}'")
            else:
                self.refused(err, span)
            return None, None
        if not isinstance(parameters, dict):
            message = f"{name} takes a mapping of parameters, not {_noun(parameters)}"
            known = list(operator.model_fields)
            label = (isinstance(parameters, str) and glued(parameters, known)) or f"write '- {name}: {{...}}'"
            self.wrong(message, self.document.mark(inner).value, label, f"{name} takes: {', '.join(known)}")
            return None, operator.model_construct()
        made = self.validate(operator, parameters, inner, name)
        if made is None:
            return None, operator.model_construct()
        return Step(name, made), made

    def runs(self, header: Header, steps: list[Step | None]) -> None:
        """Companion runs may name only components that the operators provide."""
        operators = [step.operator for step in steps if step is not None]
        if len(operators) != len(steps) or check_order(operators):
            return
        components = sorted(set().union(*(operator.provides for operator in operators)))
        for name, run in header.runs.items():
            for which in ("only", "without"):
                for i, component in enumerate(getattr(run, which) or ()):
                    try:
                        Pipeline(operators, runs={name: Companion.model_validate({which: [component]})})
                    except PipelineError as err:
                        span = self.document.mark(("runs", name, which, i)).value
                        self.wrong(err.message, span, nearest(component, components), err.cure)
        if self.mistakes:
            return
        for name in [*header.runs, ""]:  # the last: runs that steps ask for themselves
            try:
                Pipeline(operators, runs={name: header.runs[name]} if name else {})
            except PipelineError as err:
                self.wrong(err.message, self.document.mark(("runs", name) if name else ("operators",)).start, "", err.cure)


def _noun(value: Any) -> str:
    return "a list" if isinstance(value, list) else "text" if isinstance(value, str) else "one value"


def _filled(operator: Operator) -> dict[str, Any]:
    """All parameters of an operator, but for those that do not apply beside the others.

    Left out are parameters that are absent (None) by default and in fact, and defaults that the operator refuses when they
    are written down (e.g. the ordering of HEALPix pixels for a map that is not HEALPix).
    """
    model, fields = type(operator), type(operator).model_fields
    values = operator.model_dump(mode="json")
    values = {k: v for k, v in values.items() if v is not None or (k in fields and fields[k].get_default() is not None)}
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
