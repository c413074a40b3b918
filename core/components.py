"""Registries of components over entry points: lazy and conflict-aware.

Metadata is read once; nothing is imported until a component is used. A plugin that is broken,
outdated or doubles another is reported, by the name of its distribution, when it is used; the rest
works.

`core.registry` has one of each kind.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, overload

from .discovery import API_VERSION, RAISED, Found, component_in, discover, is_yaml_file, names_in
from .errors import ZondaError

T = TypeVar("T")

MANY = 24
"""A list of more names than these is not printed beside the one that is meant."""

SESSION = "this session"
"""Stands for the distribution of what `Registry.register` was given."""


class RegistryError(ZondaError):
    """A component that cannot be had. ``label`` is a short hint to print under a caret."""

    def __init__(self, message: str, *, label: str = "", place: str = "", cure: str = "") -> None:
        super().__init__(message, place=place, cure=cure)
        self.label = label

    def __str__(self) -> str:
        text = f"{self.place}: {self.message}" if self.place else self.message
        return "\n  = ".join(
            [f"{text}; {self.label}" if self.label else text, *self.cure.splitlines()]
        )


class Registry:
    """Components of one kind, by name.

    Parameters
    ----------
    kind
        Noun for messages: ``operator``.
    groups
        Entry-point groups: ``zonda.operators``; more than one separated by spaces.
    base
        ``module:class`` that what is provided must be: a subclass where ``classes``, else an
        instance. Empty: anything.
    classes
        Whether the components are classes (operators) or objects (sites).
    exact
        Whether a name must be written as it is registered, as that of a class; else capitals,
        hyphens, underscores and spaces make no difference (GBT, MUSTANG-2, Green Bank).

    Attributes
    ----------
    hint
        (label, cure) for a name that is not there, empty where there is nothing to say beyond the
        nearest name.
    """

    def __init__(
        self,
        kind: str,
        groups: str,
        base: str = "",
        *,
        classes: bool = False,
        exact: bool = False,
    ) -> None:
        self.kind = kind
        self.groups = groups.split()
        self.base = base
        self.classes = classes
        self.exact = exact
        self._found: dict[str, list[Found]] | None = None
        self._loaded: dict[Found, Any] = {}
        self._session: dict[str, Found] = {}
        self.hint: Callable[[str], tuple[str, str]] = lambda name: ("", "")

    @property
    def _index(self) -> dict[str, list[Found]]:
        """Everything on offer, by name."""
        if self._found is None:
            self._found = {}
            points = (point for group in self.groups for point in discover(group))
            found = (found for point in points for found in point.described())
            for one in dict.fromkeys((*found, *self._session.values())):
                self._found.setdefault(one.name, []).append(one)
        return self._found

    @property
    def _class(self) -> Any:
        """The class that `base` names, imported now."""
        module, _, attribute = self.base.partition(":")
        return getattr(import_module(module), attribute)

    def refresh(self) -> None:
        """Read the entry points anew (call `zonda.core.discovery.refresh` first); what was
        registered by hand stays.
        """
        self._found = None

    @overload
    def register(self, component: None = None, *, name: str | None = None) -> Callable[[T], T]: ...
    @overload
    def register(self, component: T, *, name: str | None = None) -> T: ...
    def register(self, component: Any = None, *, name: str | None = None) -> Any:
        """Add a component from a script or notebook; a decorator, or a plain call. Packages use
        entry points instead.

        Its name is ``name``, or the component's own ``name``, or its ``__name__``. Registering a
        name again replaces the component (cells are run twice). Raises `RegistryError` if a plugin
        provides that name, or the component is of another kind.
        """
        if component is None:
            return lambda c: self.register(c, name=name)
        own = getattr(component, "name", None)
        key = (
            name or (own if isinstance(own, str) else None) or getattr(component, "__name__", None)
        )
        found = Found(key or repr(component), _reference(component), SESSION, "")
        if self.classes or key:
            self._check(component, found)
        if not key:
            raise RegistryError(
                f"this {self.kind} has no name",
                cure="give one: register(component, name='...')",
            )
        taken = self._index.get(key)
        if taken and taken[0].distribution != SESSION:
            raise RegistryError(
                f"{self.kind} '{key}' is already provided by {taken[0].origin}",
                cure="choose another name",
            )
        self._session[key], self._loaded[found], self._index[key] = found, component, [found]
        return component

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and bool(self._named(name))

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._index))

    def __len__(self) -> int:
        return len(self._index)

    def candidates(self) -> list[Found]:
        """Everything on offer, by name; what was registered by hand comes from "this session".
        Imports nothing.
        """
        return sorted(found for alike in self._index.values() for found in alike)

    def suggest(self, name: str) -> str | None:
        """The nearest name on offer."""
        folded = {fold(known): known for known in self}
        near = difflib.get_close_matches(fold(name.rpartition(":")[2]), folded, n=1, cutoff=0.6)
        return folded[near[0]] if near else None

    def registered(self, name: str) -> str:
        """The registered name that ``name`` means: itself, or the one that differs from it by what
        `exact` tells; else ``name``.

        Raises `RegistryError` where several do.
        """
        if self.exact or not isinstance(name, str) or self._named(name):
            return name
        distribution, colon, short = name.rpartition(":")
        alike = [known for known in self if fold(known) == fold(short)]
        if len(alike) > 1 and not self._same(alike):
            named = " and ".join(f"'{known}'" for known in alike)
            raise RegistryError(
                f"{self.kind} '{name}' may be {named}",
                label="write one of them as it is spelled here",
            )
        return f"{distribution}{colon}{alike[0]}" if alike else name

    def get(self, name: str) -> Any:
        """The component called ``name`` or ``distribution:name``, imported now.

        Raises `RegistryError` for a name that is unknown, doubly provided, broken or written for
        another plugin API.
        """
        return self.load(self._only(name))

    def _only(self, name: str) -> Found:
        """The one candidate of a name. Raises `RegistryError` if there is none, or several."""
        found = self._named(self.registered(name))
        if not found:
            raise self._unknown(name)
        if len(found) > 1:
            raise RegistryError(
                f"{self.kind} '{name}' is provided by {' and '.join(f.origin for f in found)}",
                label="write " + " or ".join(f"'{f.qualified}'" for f in found),
                cure="or uninstall one of them",
            )
        return found[0]

    def create(self, name: str, folder: str | Path | None = None) -> Any:
        """The object called ``name``: what the entry point names, or what it returns when called
        without arguments; or the object that the YAML file at the path ``name`` describes, which is
        looked for in ``folder`` first.

        Raises `RegistryError` as `get`, and if the call fails or returns another kind of thing;
        `ConfigurationError` for mistakes in the file.
        """
        if is_yaml_file(name) and self.base and not self.classes:
            return self._of_file(name, folder)
        found = self._only(name)
        component = self.load(found)
        if not callable(component):
            return component
        try:
            made = component()
        except RAISED as err:
            if isinstance(err, ZondaError) and not isinstance(
                err,
                ValueError,
            ):  # a ParameterError is the plugin's fault
                raise
            raise _broken(self.kind, found, err) from err
        return self._check(made, found, made=True)

    def _of_file(self, name: str, folder: str | Path | None) -> Any:
        """The component of a file that holds one."""
        from pydantic_core import PydanticCustomError

        from .configuration.input_paths import find_in

        try:
            path = find_in(folder, name)
        except PydanticCustomError as err:
            told = err.context or {}
            raise RegistryError(told["message"], label=told["label"], cure=told["help"]) from None
        inside = names_in(path)
        if len(inside) != 1:
            raise RegistryError(
                f"describes {len(inside)} {self.kind}s: {', '.join(inside)}",
                place=str(path),
                cure=f"keep one {self.kind} in the file",
            )
        return component_in(path, inside[0], self._class, self.create)

    def load(self, found: Found) -> Any:
        """Import one candidate. Raises `RegistryError` where that fails or it is written for
        another plugin API.
        """
        if found not in self._loaded:
            try:
                component = self._described(found) if found.file else found.load()
                if isinstance(component, Mapping) and self.base and not self.classes:
                    component = self._class(**{"name": found.name, **component})
            except RegistryError:
                raise
            except RAISED as err:
                raise _broken(self.kind, found, err) from err
            self._loaded[found] = self._check(component, found)
        return self._loaded[found]

    def _described(self, found: Found) -> Any:
        """The component that a YAML file describes. Raises `RegistryError` at the first mistake."""
        from .configuration.diagnostics import ConfigurationError

        try:
            return component_in(Path(found.file), found.name, self._class, self.create)
        except ConfigurationError as err:
            first, *others = err.diagnostics
            cures = [first.help, *(f"{other.place}: {other.message}" for other in others)]
            raise RegistryError(
                f"{self.kind} '{found.name}' of {found.origin}: {first.message}",
                label=first.label,
                place=first.place,
                cure="\n".join(filter(None, cures)),
            ) from None

    def _same(self, names: list[str]) -> bool:
        """True if all ``names`` stand for equal things, as a site and its alias do."""
        make = self.get if self.classes else self.create
        try:
            first, *others = (make(name) for name in names)
        except ZondaError:
            return False
        return all(type(other) is type(first) and other == first for other in others)

    def _unknown(self, name: str) -> RegistryError:
        label, cure = self.hint(name)
        near = None if label else self.suggest(name)
        names = (
            f"installed: {', '.join(self) or 'none'}; `zonda plugins` lists where each comes from"
        )
        if (label or near) and len(self) > MANY:
            names = f"`zonda plugins` lists all {len(self)} {self.kind}s"
        label = label or (f"did you mean '{near}'?" if near else "not installed")
        return RegistryError(
            f"unknown {self.kind} '{name}'",
            label=label,
            cure="\n".join(filter(None, (cure, names))),
        )

    def _named(self, name: str) -> list[Found]:
        distribution, _, short = name.rpartition(":")
        return [
            f
            for f in self._index.get(short, [])
            if not distribution or f.distribution == distribution
        ]

    def _check(self, component: Any, found: Found, *, made: bool = False) -> Any:
        who = f"{self.kind} '{found.name}' from {found.origin}"
        api = getattr(component, "zonda_api", API_VERSION)
        if api != API_VERSION:
            older = not isinstance(api, int) or api < API_VERSION
            raise RegistryError(
                f"{who} is written for plugin API {api}; this is API {API_VERSION}",
                label="outdated plugin" if older else "zonda is outdated",
                cure=f"pip install -U {found.distribution if older else 'zonda'}",
            )
        if self.base and (made or self.classes or not callable(component)):
            base = self._class
            attribute = self._class.__name__
            if not (
                isinstance(component, type) and issubclass(component, base)
                if self.classes
                else isinstance(component, base)
            ):
                noun = (
                    f"a subclass of {attribute}"
                    if self.classes
                    else f"a{'n' * (attribute[0] in 'AEIOU')} {attribute}"
                )
                raise RegistryError(
                    f"{who} is not {noun}",
                    label=(
                        f"the package {component.__name__} has no *.yaml files"
                        if isinstance(component, ModuleType)
                        else f"it is {component!r:.60}"
                    ),
                    cure=f"mend {found.reference}",
                )
        return component


def fold(name: str) -> str:
    """``name`` without capitals, hyphens, underscores and spaces."""
    return re.sub(r"[\s_-]+", "", name).lower()


def _reference(component: Any) -> str:
    thing = component if hasattr(component, "__qualname__") else type(component)
    return f"{thing.__module__}:{thing.__qualname__}"


def _broken(kind: str, found: Found, err: BaseException) -> RegistryError:
    return RegistryError(
        f"{kind} '{found.name}' could not be loaded from the plugin {found.origin}",
        label=_first_words(err),
        cure=f"this is a fault in {found.distribution} ({found.reference}), not in your pipeline; "
        "`zonda plugins --check` shows the traceback",
    )


def _first_words(err: BaseException) -> str:
    """The first line of what an exception says; of pydantic's, which has none to the point, all
    fields with their mistakes.
    """
    from pydantic import ValidationError

    from .configuration.diagnostics import ConfigurationError

    if isinstance(err, ConfigurationError):
        return "; ".join(diagnostic.message for diagnostic in err.diagnostics)
    if isinstance(err, ValidationError):
        return "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in err.errors())
    return f"{type(err).__name__}: {err}".splitlines()[0]
