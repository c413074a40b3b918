"""Pipeline files: from YAML text to a scene and checked operators, with every mistake reported at
its place.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from zonda import __version__

from .. import registry
from ..assembly.checks import looks
from ..assembly.order import check_order
from ..campaign import section
from ..errors import PipelineError, ZondaError
from ..mapmaker import made_by
from ..operator import Operator
from ..output import Output
from ..pipeline import Pipeline
from ..scene import Scene, WithScene
from ..signal import Signal, can_be_named
from ..site import Site
from ..variants import LIKE
from ..weather import WeatherSource, resolve
from . import overrides as settings
from . import yaml_places
from .diagnostics import ConfigurationError, Diagnostic, nearest
from .explain import without_meant
from .loaded import KEYS, SCENE_KEYS, Header, refusal
from .loaded import PipelineFile as PipelineFile
from .loaded import Step as Step
from .locate import locate, read
from .steps import Mistakes, noun, read_steps
from .target import WithMap
from .yaml_places import Document, Source, Span

EXAMPLE = (
    "write at least: site, instrument, time, and operators (a list of steps); `zonda pipelines`"
    " lists examples"
)

MOST_STEPS = 1000
"""Longer pipelines are refused before they are looked at."""

OWN = frozenset({"site", "instrument"})
"""Keys of the scene that a step with recorded data brings (`scene.WithScene`)."""

UNKNOWN = {"site": Site(name="", latitude="0 deg", longitude="0 deg"), "time": "2000-01-01"}
"""Placeholders in the scene until recorded data replace them."""


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


def parse(
    text: str,
    *,
    name: str = "<text>",
    folder: str | Path | None = None,
    overrides: Iterable[str] = (),
) -> PipelineFile:
    """Load a pipeline from text; relative paths in it are looked for in ``folder`` first."""
    source = Source(name, text)
    document = yaml_places.load(source, longest={"operators": MOST_STEPS})
    mistakes = [Diagnostic(fault.message, fault.span, fault.label) for fault in document.faults]
    if not isinstance(document.value, dict):
        if document.value is None and not mistakes:
            mistakes = [Diagnostic("this pipeline file is empty", Span(source), "", EXAMPLE)]
        elif not mistakes:
            message = f"a pipeline file is a mapping of keys, not {noun(document.value)}"
            mistakes = [Diagnostic(message, Span(source), "", EXAMPLE)]
        raise ConfigurationError(mistakes, name)
    for setting in [overrides] if isinstance(overrides, str) else overrides:
        mistakes += settings.apply(document, setting, KEYS)
    return _Check(document, name, folder, mistakes).run()


class _Check(Mistakes):
    """Turns a document into a `PipelineFile`, gathering mistakes on the way."""

    def __init__(
        self,
        document: Document,
        name: str,
        folder: str | Path | None,
        found: list[Diagnostic],
    ) -> None:
        super().__init__(document, folder, found)
        self.name = name
        self.band_unknown = False
        self.recorded_at: tuple[str, int] = (
            "operators",
            0,
        )  # the step that brings its own site and instrument
        self.tree: dict[Any, Any] = document.value

    def run(self) -> PipelineFile:
        for key, rewrite in (
            ("sweep", section.rewrite_sweep),
            ("campaign", section.rewrite_campaign),
        ):
            if self.tree.get(key) is not None:
                self.found += rewrite(self.document)
        kind = Header if self.tree.get("campaign") is None else section.CampaignHeader
        head = {
            k: v
            for k, v in self.tree.items()
            if k not in (*SCENE_KEYS, "operators") and not str(k).startswith("x-")
        }
        header = self.validate(kind, head, (), "the pipeline", KEYS)
        self.sizes()
        self.requirements()
        steps = read_steps(self)
        number = next(
            (i for i, s in enumerate(steps) if s is not None and isinstance(s.operator, WithScene)),
            None,
        )
        recorded = None if number is None else steps[number]
        self.recorded_at = "operators", number or 0
        before = len(self.found)
        scene = self.scene(None if recorded is None else recorded.operator)
        if self.recorded_lost(steps):
            self.found[before:] = [
                m for m in self.found[before:] if not m.message.startswith("the pipeline needs '")
            ]
        if header is not None:
            self.runs(header, steps)
        if header is not None and header.campaign is not None:
            self.found = section.mistakes(
                self.document,
                header.campaign,
                self.found,
                self.without_campaign,
            )
        if scene is not None and not self.found and self.target_of_map:
            scene = self.targeted(scene, [s.operator for s in steps if s is not None])
        if self.found:
            if scene is not None and not (self.target_of_map or self.band_unknown):
                self.look(steps, scene)
            raise ConfigurationError(without_meant(self.found), self.name)
        assert header is not None
        assert scene is not None
        stem = re.sub(r"[^\w.+-]", "_", Path(self.name).stem).lstrip("_.+-") or "pipeline"
        name = header.name or stem
        header = header.model_copy(
            update={"name": name, "outputs": header.outputs or Path("out") / name}
        )
        own = OWN if recorded is not None else frozenset[str]()
        parameters = {k: self.tree[k] for k in SCENE_KEYS if k in self.tree and k not in own}
        made = tuple(s for s in steps if s is not None)
        return PipelineFile(header, parameters, made, self.name, scene, self.document)

    def recorded_lost(self, steps: list[Step | None]) -> bool:
        """True if a step that brings its own site, instrument and time could not be made."""
        written = (
            [item for item, step in zip(self.tree["operators"], steps, strict=True) if step is None]
            if steps
            else []
        )
        names = {
            next(iter(item), None) if isinstance(item, dict) else item
            for item in written
            if isinstance(item, dict | str)
        }
        return bool(names) and not names.isdisjoint(
            registry.operators_that(lambda step: issubclass(step, WithScene))
        )

    def look(self, steps: list[Step | None], scene: Scene) -> None:
        """Add what the steps that could be made would refuse: targets that are not up, files that
        are wrong.
        """
        with (
            warnings.catch_warnings(),
            suppress(Exception),
        ):  # the mistakes that are known come first
            warnings.simplefilter("ignore")
            for number, err in looks(
                [None if step is None else step.operator for step in steps],
                scene,
            )[1]:
                step = steps[number]
                if step is not None:
                    self.found.append(refusal(self.document, step, err))

    def sizes(self) -> None:
        """Raise `ConfigurationError` for more steps (of an alias; those written are counted before)
        or entries than allowed.
        """
        items = self.tree.get("operators")
        campaign = self.tree.get("campaign")
        many = isinstance(items, list) and len(items) > MOST_STEPS
        if many:
            at = self.document.mark(("operators",)).start
            self.wrong(
                f"a pipeline of {len(items or [])} steps",
                at,
                "",
                f"write at most {MOST_STEPS}",
            )
        if isinstance(campaign, dict) and not many:
            many = section.too_large(campaign)  # the header's own check has said so
        if many:
            raise ConfigurationError(without_meant(self.found), self.name)

    @property
    def target_of_map(self) -> bool:
        """True if the file says ``target: map``."""
        return isinstance(text := self.tree.get("target"), str) and text.strip().lower() == "map"

    def targeted(self, scene: Scene, operators: Iterable[Operator]) -> Scene:
        """The scene with the centre of the first step's input map as its target."""
        at = self.document.mark(("target",)).value
        with_map = next((o for o in operators if isinstance(o, WithMap)), None)
        if with_map is None:
            have = " or ".join(registry.operators_that(lambda step: issubclass(step, WithMap)))
            cure = f"add {have}, or give a position" if have else "give a position"
            self.wrong(
                "target: map takes the centre of an input map, and no step has one",
                at,
                "",
                cure,
            )
            return scene
        try:
            return scene.model_copy(update={"target": with_map.map_centre()})
        except ZondaError as err:
            self.refused(err, at)
            return scene

    def without_campaign(self, document: Document) -> list[Diagnostic]:
        """Mistakes of a document, without those of its campaign."""
        del document.value["campaign"]
        try:
            _Check(document, self.name, self.context["folder"], []).run()
        except ConfigurationError as err:
            return err.diagnostics
        return []

    def requirements(self) -> None:
        wanted = self.tree.get("requires")
        if not isinstance(wanted, list):
            return
        from importlib.metadata import PackageNotFoundError, version

        from packaging.requirements import InvalidRequirement, Requirement

        for i, text in enumerate(wanted):
            at = self.document.mark(("requires", i)).value
            if not isinstance(text, str):
                continue  # the header's own check has said so
            try:
                requirement = Requirement(text)
                have = __version__ if requirement.name == "zonda" else version(requirement.name)
            except InvalidRequirement:
                self.wrong(
                    f"'{text}' is not a requirement",
                    at,
                    "write it as pip does, e.g. zonda-toltec>=1.2",
                )
            except PackageNotFoundError:
                self.wrong(
                    f"this pipeline needs the package {requirement.name}",
                    at,
                    "not installed",
                    f"pip install '{text}'",
                )
            else:
                if not requirement.specifier.contains(have, prereleases=True):
                    self.wrong(
                        f"this pipeline needs {text}",
                        at,
                        f"{have} is installed",
                        f"pip install '{text}'",
                    )

    def scene(self, recorded: Any = None) -> Scene | None:
        """The scene; names are looked up one by one, so that each is reported at its own place.

        ``recorded``: a step that brings its own site and instrument, which stand above those of the
        file.
        """
        given = {
            key: self.tree[key]
            for key in SCENE_KEYS
            if key in self.tree and not (key == "target" and self.target_of_map)
        }
        lost = set()
        for kind, names in (("site", registry.sites), ("instrument", registry.instruments)):
            if kind in given and not self.named(given, kind, names, (kind,)):
                lost.add(kind)
        if isinstance(given.get("instrument"), dict):
            given["instrument"] = dict(given["instrument"])
            if not self.named(
                given["instrument"],
                LIKE,
                registry.instruments,
                ("instrument", LIKE),
            ):
                lost.add("instrument")
            own = LIKE in given["instrument"] or given["instrument"].get(
                "bands"
            )  # which say more of an unknown band
            if not own and not self.named(
                given["instrument"],
                "band",
                registry.bands,
                ("instrument", "band"),
            ):
                given["instrument"]["band"] = {
                    "name": "",
                    "low": "1 Hz",
                    "high": "2 Hz",
                }  # goes on to find the other mistakes
                self.band_unknown = True
        if given.get("weather") is not None:
            given["weather"] = self.weather(given["weather"])
        if recorded is not None and not lost:
            return self.recorded(recorded, given)
        before = len(self.found)
        stand_in = {kind: self.tree[kind] for kind in lost}
        given = {key: value for key, value in given.items() if key not in lost}
        scene = self.validate(Scene, given, (), "the pipeline", KEYS)
        missing = tuple(f"the pipeline needs '{kind}'" for kind in stand_in)
        self.found[before:] = [m for m in self.found[before:] if m.message not in missing]
        return scene

    def recorded(self, step: Any, given: dict[str, Any]) -> Scene | None:
        """The scene with the instrument and the site that a step brings; its time, where none is
        given.
        """
        told = (
            self.validate(Scene, {**UNKNOWN, **given}, (), "the pipeline", KEYS)
            if "instrument" in given
            else None
        )
        if told is None and "instrument" in given:
            return None
        try:
            own = dict(step.own_scene(None if told is None else told.instrument))
        except ZondaError as err:
            self.refused(err, self.document.mark(self.recorded_at).value)
            return None
        scene = self.validate(Scene, {**own, **given}, (), "the pipeline", KEYS)
        if scene is None:
            return None
        above = {key: own[key] for key in OWN}
        for key in sorted(OWN & given.keys()):
            if getattr(scene, key).name != above[key].name:
                text = f"{step.label}: {key} is that of the recorded data, {above[key].name}"
                use = "is not used" if key == "site" else "gives what they do not state"
                warnings.warn(
                    f"{text}; {getattr(scene, key).name} of this file {use}",
                    stacklevel=2,
                )
        return scene.model_copy(update=above)

    def weather(self, value: Any) -> WeatherSource | None:
        """The weather, checked as the source that it names."""
        try:
            source, given = resolve(value)
        except ZondaError as err:
            self.refused(err, self.document.mark(("weather",)).value)
            return None
        return self.validate(source, given, ("weather",), "weather")

    def runs(self, header: Header, steps: list[Step | None]) -> None:
        """Signals may name only components that the operators provide."""
        operators = [step.operator for step in steps if step is not None]
        if len(operators) != len(steps) or check_order(operators):
            return
        making = [operator for operator in operators if not isinstance(operator, Output)]
        components = sorted(set().union(*map(made_by, operators)))
        for name, run in header.runs.items():
            if not can_be_named(name):
                continue  # said below, at the name
            for which in ("only", "without"):
                for i, component in enumerate(getattr(run, which) or ()):
                    try:
                        Pipeline(making, runs={name: Signal.model_validate({which: [component]})})
                    except PipelineError as err:
                        span = self.document.mark(("runs", name, which, i)).value
                        near = nearest(component, components)
                        self.wrong(err.message, span, near, err.cure if err.cure != near else "")
        if self.found:
            return
        for name, run in header.runs.items():
            try:
                Pipeline(making, runs={name: run})
            except PipelineError as err:
                self.wrong(err.message, self.document.mark(("runs", name)).start, "", err.cure)
        if self.found:
            return
        try:
            Pipeline(operators, runs=header.runs)  # signals that outputs read
        except PipelineError as err:
            self.wrong(err.message, self.document.mark(("operators",)).start, "", err.cure)
