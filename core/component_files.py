"""Components that YAML files describe: instruments, sites and bands of a package.

A file holds components by their names, each the mapping of keys that its class takes. ``{like:
NAME}`` is another name for a component. Keys that begin with ``x-`` are no components: they hold
what several share, by YAML's anchors. Relative paths are looked for beside the file.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml

from .errors import InputError

SUFFIXES = (".yaml", ".yml")


def is_file(name: str) -> bool:
    """True for the path of a YAML file, which a name is not."""
    return name.endswith(SUFFIXES)


def files_of(package: str) -> list[Path]:
    """The YAML files in the folder of a package, which is not imported; empty if there are none."""
    root, *rest = package.split(".")
    try:
        spec = find_spec(root)
    except (ImportError, ValueError):
        return []
    folders = [] if spec is None else spec.submodule_search_locations or []
    found = (path for folder in folders for path in Path(folder, *rest).glob("*"))
    return sorted(path for path in found if is_file(path.name))


def names_in(path: Path) -> list[str]:
    """Names of the components of a file; its own name if it cannot be read, for `described`."""
    try:
        root = yaml.compose(_text(path), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (InputError, yaml.YAMLError):
        return [path.stem]
    if not isinstance(root, yaml.MappingNode):
        return [path.stem]
    return [str(key.value) for key, _ in root.value if not str(key.value).startswith("x-")]


def described(path: Path, name: str, base: type[Any], create: Callable[[str], Any]) -> Any:
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
