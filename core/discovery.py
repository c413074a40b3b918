"""Plugins that are installed: entry points of every distribution, and the instruments, sites and
bands that YAML files of a package describe.

Entry points are read as metadata only. One broken distribution never hides the rest.

A YAML file holds components by their names, each the mapping of keys that its class takes. ``{like:
NAME}`` is another name for a component. Keys that begin with ``x-`` are no components: they hold
what several share, by YAML's anchors. Relative paths are looked for beside the file.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from .errors import InputError

HOST = "zonda"
"""The distribution of the built-in plugins, which `ZONDA_PLUGINS` never shuts out."""

API_VERSION = 2
"""Version of the contract of plugins (`core.operator`); a plugin written for another one is
refused.
"""

REMOVED = {
    "zonda.ground_weather": "weather comes from zonda.weather_sources",
    "zonda.kernels": "kernels are compiled at their first use, or by `zonda compile`",
    "zonda.processes": "pictures are drawn in the run's own process",
    "zonda.products": "the class of a product is found in the module of the operator that makes it",
    "zonda.sections": "keys of pipeline files are zonda's own",
}
"""Entry-point groups of earlier versions, and what replaces them."""

RAISED = (Exception, SystemExit, GeneratorExit)
"""Exceptions that a plugin may raise when it is imported or called; Ctrl-C is the user's."""


class PluginWarning(UserWarning):
    """A plugin, or a part of it, was left out; the rest goes on."""


class Found(NamedTuple):
    """One entry point and the distribution that declares it."""

    name: str
    reference: str
    """``module:attribute``, or a package of YAML files."""
    distribution: str
    version: str
    file: str = ""
    """Path of the YAML file that describes it, if that is not Python."""

    @property
    def qualified(self) -> str:
        """``distribution:name``, which is unique."""
        return f"{self.distribution}:{self.name}"

    @property
    def origin(self) -> str:
        """``distribution version``, for messages."""
        return f"{self.distribution} {self.version}".strip()

    def load(self) -> Any:
        """Import the object. Raises whatever the plugin raises."""
        from importlib.metadata import EntryPoint

        return EntryPoint(self.name, self.reference, "").load()

    def described(self) -> list[Found]:
        """The components in the files of the package that the entry point names, found without an
        import; itself if it names an object.
        """
        if ":" in self.reference:
            return [self]

        return [
            self._replace(name=name, reference=f"{self.reference}/{path.name}", file=str(path))
            for path in yaml_files_of(self.reference)
            for name in names_in(path)
        ] or [self]


def normalized(distribution: str) -> str:
    """Name of a distribution as pip compares it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


@lru_cache(maxsize=1)
def _all() -> dict[str, list[Found]]:
    """Every entry point of the groups ``zonda.*``, by group. The first distribution of a name on
    sys.path counts.
    """
    from importlib.metadata import distributions

    groups: dict[str, list[Found]] = {}
    gone: dict[tuple[str, str], str] = {}
    seen: set[str] = set()
    for distribution in distributions():
        who = "?"
        try:
            text = distribution.read_text("entry_points.txt")
            if not text or "zonda." not in text:
                continue
            who = distribution.metadata["Name"] or "unnamed"
            if normalized(who) in seen:
                continue
            seen.add(normalized(who))
            version = distribution.metadata["Version"] or ""
            for point in distribution.entry_points:
                if point.group in REMOVED and normalized(who) != HOST:
                    gone.setdefault((who, point.group), REMOVED[point.group])
                elif point.group.startswith("zonda."):
                    found = Found(point.name, point.value, who, version)
                    if found not in groups.setdefault(point.group, []):
                        groups[point.group].append(found)
        except Exception as err:  # metadata may be broken in any way
            where = f" ({path})" if (path := getattr(distribution, "_path", None)) else ""
            message = (
                f"the metadata of plugin {who}{where} cannot be read, it was left out:"
                f" {type(err).__name__}: {err}"
            )
            warnings.warn(message, PluginWarning, stacklevel=3)
    for (who, group), instead in gone.items():
        message = f"plugin {who} has entry points in {group}, a group that is gone: {instead}"
        warnings.warn(message, PluginWarning, stacklevel=3)
    return groups


def discover(group: str) -> list[Found]:
    """Entry points of ``group``.

    The environment variable ``ZONDA_PLUGINS`` (names separated by commas) admits only the named
    distributions beside zonda's own, to isolate a fault; set but empty, it admits none.
    """
    only = os.environ.get("ZONDA_PLUGINS")
    found = _all().get(group, [])
    if only is None:
        return list(found)
    allowed = {HOST, *(normalized(name.strip()) for name in only.split(",") if name.strip())}
    return [f for f in found if normalized(f.distribution) in allowed]


def plugin_of(module: str) -> str:
    """``distribution version`` of the plugin to whose package a module belongs; empty where it is
    none's, or zonda's own.
    """
    root = module.partition(".")[0]
    for found in (f for group in _all().values() for f in group):
        if (
            normalized(found.distribution) != HOST
            and found.reference.partition(":")[0].partition(".")[0] == root
        ):
            return found.origin
    return ""


def refresh() -> None:
    """Forget what was read, e.g. after ``pip install`` in a notebook."""
    _all.cache_clear()


SUFFIXES = (".yaml", ".yml")


def is_yaml_file(name: str) -> bool:
    """True if a text is the path of a YAML file, by its ending, and not the name of a component."""
    return name.endswith(SUFFIXES)


def yaml_files_of(package: str) -> list[Path]:
    """The YAML files in the folder of a package, which is not imported; empty if there are none."""
    root, *rest = package.split(".")
    try:
        spec = find_spec(root)
    except (ImportError, ValueError):
        return []
    folders = [] if spec is None else spec.submodule_search_locations or []
    found = (path for folder in folders for path in Path(folder, *rest).glob("*"))
    return sorted(path for path in found if is_yaml_file(path.name))


def names_in(path: Path) -> list[str]:
    """Names of the components of a file; its own name if it cannot be read, for `component_in`."""
    try:
        root = yaml.compose(_text(path), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (InputError, yaml.YAMLError):
        return [path.stem]
    if not isinstance(root, yaml.MappingNode):
        return [path.stem]
    return [str(key.value) for key, _ in root.value if not str(key.value).startswith("x-")]


def component_in(path: Path, name: str, base: type[Any], create: Callable[[str], Any]) -> Any:
    """The component ``name`` of a file, an instance of ``base``.

    ``create`` makes the component that ``like`` names. Raises `ConfigurationError` with every
    mistake at its place, and InputError if the file cannot be read or has no such component.
    """
    from pydantic import ValidationError

    from .configuration import yaml_places
    from .configuration.diagnostics import ConfigurationError, Diagnostic
    from .configuration.explain import explain

    document = yaml_places.load(yaml_places.Source(str(path), _text(path)))
    faults = [Diagnostic(fault.message, fault.span, fault.label) for fault in document.faults]
    if faults:
        raise ConfigurationError(faults, str(path))
    if not isinstance(document.value, dict) or name not in document.value:
        cure = f"write {name}: and its keys below, indented by two spaces"
        raise InputError(f"describes no {name}", place=str(path), cure=cure)
    value = document.value[name]
    if isinstance(value, dict) and set(value) == {"like"}:
        return create(value["like"])
    keys = {"name": name, **value} if isinstance(value, dict) else value
    try:
        return base.model_validate(keys, context={"folder": path.parent})
    except ValidationError as err:
        mistakes = explain(err, base, document, (name,), name)
        raise ConfigurationError(mistakes, str(path)) from None


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8-sig")
    except OSError as err:
        cure = "check its permissions"
        raise InputError(f"cannot be read: {err.strerror}", place=str(path), cure=cure) from None
    except UnicodeDecodeError:
        raise InputError("is not UTF-8 text", place=str(path), cure="save it as UTF-8") from None
