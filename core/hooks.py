"""Behaviour hooks (pluggy): what a plugin may *do*, as against what it *provides* (`registry`).

A plugin declares a module or an object in the entry-point group ``zonda.hooks``; its functions
marked with `hookimpl` are called at the places that `Hooks` describes. They may take fewer
arguments than offered.

pluggy's own loader stops at the first plugin that fails to import and skips a second entry point of
a name already taken, so plugins are loaded one by one here; a hook that fails later is reported
once and then left alone.
"""

from __future__ import annotations

import difflib
import inspect
import warnings
from collections.abc import Callable
from functools import lru_cache, wraps
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol

import pluggy

from .discovery import RAISED, Found, PluginWarning, discover
from .errors import ZondaError

if TYPE_CHECKING:
    import click

    from .data import Data, Observation
    from .operator import Operator

__all__ = ["Hooks", "PluginWarning", "hookimpl", "manager"]

GROUP = "zonda.hooks"
hookspec = pluggy.HookspecMarker("zonda")
hookimpl = pluggy.HookimplMarker("zonda")


class Steps(Protocol):
    """View of the running `zonda.Pipeline` for hooks."""

    name: str
    operators: list[Operator]


class Hooks:
    """The hooks. They must not change what they are given; hook wrappers are not supported."""

    @hookspec
    def zonda_pipeline_start(self, pipeline: Steps, data: Data) -> None:
        """Before the first operator of a run."""

    @hookspec
    def zonda_pipeline_end(self, pipeline: Steps, data: Data) -> None:
        """After the last operator of a run."""

    @hookspec
    def zonda_before_operator(
        self,
        operator: Operator,
        observation: Observation | None,
        stage: str,
    ) -> None:
        """Before a stage of an operator (``observe``, ``prepare``, ``exec``, ``collect``,
        ``finalize`` ...).
        """

    @hookspec
    def zonda_after_operator(
        self,
        operator: Operator,
        observation: Observation | None,
        stage: str,
        seconds: float,
    ) -> None:
        """After a stage of an operator, which took so many seconds."""

    @hookspec
    def zonda_progress(self, done: int, total: int, what: str) -> None:
        """``done`` of ``total`` steps of ``what`` are finished; may come from any thread. ``total``
        0: it has ended.
        """

    @hookspec
    def zonda_campaign_progress(
        self,
        done: int,
        total: int,
        failed: int,
        samples: int,
        all_samples: int,
        seconds: float,
    ) -> None:
        """``done`` of ``total`` tasks of a campaign are finished, with ``samples`` of
        ``all_samples``, after ``seconds``; and ``failed`` attempts have failed."""

    @hookspec
    def zonda_campaign_end(self) -> None:
        """No task of the campaign is at work any more."""

    @hookspec
    def zonda_commands(self, group: click.Group) -> None:
        """Add commands to ``zonda``: ``@group.command() def mine(): ...``."""


@lru_cache(maxsize=1)
def manager() -> pluggy.PluginManager:
    """The plugin manager, with every plugin that could be loaded. Cached; `manager.cache_clear()`
    reads anew.
    """
    plugins = pluggy.PluginManager("zonda")
    plugins.add_hookspecs(Hooks)
    for found in discover(GROUP):
        try:
            load(plugins, found)
        except RAISED as err:
            _leave_out(found, f"left out: {type(err).__name__}: {err}")
    return plugins


def load(plugins: pluggy.PluginManager, found: Found) -> None:
    """Import one plugin and register its hooks; misspelt and unmarked ones are left out with a
    warning.

    Raises whatever the plugin raises at import, or pluggy where a hook's arguments are unknown.
    """
    plugin = found.load()
    specified = [name for name in vars(Hooks) if name.startswith("zonda_")]
    hooks = SimpleNamespace()
    for name in [n for n in dir(plugin) if n.startswith("zonda_")]:
        function = getattr(plugin, name)
        if not inspect.isroutine(function):
            continue
        if plugins.parse_hookimpl_opts(plugin, name) is None:
            _leave_out(found, f"'{name}' is not called, for it lacks the decorator @zonda.hookimpl")
        elif name not in specified:
            near = difflib.get_close_matches(name, specified, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(specified)}"
            _leave_out(found, f"there is no hook '{name}'; {hint}")
        else:
            setattr(hooks, name, _isolated(function, found))
    try:
        plugins.register(hooks, name=found.qualified)
    except BaseException:
        if plugins.has_plugin(found.qualified):
            plugins.unregister(name=found.qualified)
        raise


def _isolated(function: Callable[..., Any], found: Found) -> Callable[..., Any]:
    """``function``, which after its first failure is reported and then left alone. A `ZondaError`
    stops the run.
    """
    failed = False

    @wraps(function)
    def call(*arguments: Any) -> Any:
        nonlocal failed
        if failed:
            return None
        try:
            return function(*arguments)
        except ZondaError:
            raise
        except RAISED as err:
            failed = True
            _leave_out(
                found,
                f"{function.__name__} failed and is left out from now on: {type(err).__name__}:"
                f" {err}",
            )
            return None

    call.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
    return call


def _leave_out(found: Found, why: str) -> None:
    warnings.warn(f"plugin {found.origin} ({found.reference}): {why}", PluginWarning, stacklevel=4)
