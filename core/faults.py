"""Errors of plugins: code of a plugin that raised, or left an invalid stream, is named.

What a plugin raises is neither a user's mistake nor a fault of zonda: it is reported as one error
that names the step, the function and the distribution. The traceback shows whose code it was, so
that no call of a plugin needs to be guarded: neither the methods of an operator, nor a noise model,
a validator or a metric, in whatever thread it ran. ``sys.exit`` in a plugin is such a fault, too:
it would end the command as if all had gone well. Ctrl-C, signals and lack of memory are not.
"""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections.abc import Iterator
from types import FrameType
from typing import TYPE_CHECKING

from .discovery import HOST, plugin_of
from .errors import PluginError, ZondaError

if TYPE_CHECKING:
    from .operator import Operator


def whose(operator: Operator) -> str:
    """A step, its class and the distribution that the class comes from, for messages."""
    mine = type(operator)
    return f"{operator.label} ({_from(mine.__module__, mine.__qualname__)})"


@contextlib.contextmanager
def faults_named(*, exceptions: bool = True) -> Iterator[None]:
    """Turn what plugin code raises into a `PluginError`; a decorator, too.

    ``exceptions``: False leaves an `Exception` what it is, with a note; only what would end the
    program is turned (``sys.exit``).
    """
    try:
        yield
    except (ZondaError, KeyboardInterrupt, MemoryError):
        raise
    except BaseException as err:
        found = fault(err)
        if found is None:
            raise
        if exceptions or not isinstance(err, Exception):
            raise found from err
        if str(found) not in getattr(err, "__notes__", ()):
            err.add_note(str(found))
        raise


def fault(err: BaseException) -> PluginError | None:
    """The error to report for an exception that came through plugin code; None where it did not.

    A plugin's own command is not zonda's to judge: it is called by click, not by zonda.
    """
    step = None
    called = None
    last = None
    innermost = None
    zonda = False
    for frame, line in traceback.walk_tb(err.__traceback__):
        root = _root(frame)
        step = _step(frame) or step
        if root == HOST:
            zonda = True
            innermost = None
        elif called is None and root == "click":
            zonda = False
        elif zonda and _is_plugin(frame):
            called = called or frame
            last = (frame, line)
        elif zonda and root not in sys.stdlib_module_names:
            innermost = (frame, line)
    if called is None and innermost is not None and not isinstance(err, Exception):
        called, last = innermost[0], innermost  # whoever ends the program, in a notebook, too
    if called is None or last is None:
        return None
    module = str(called.f_globals.get("__name__", ""))
    name = called.f_code.co_qualname
    where = f"{last[0].f_code.co_filename}, line {last[1]}"
    words = str(err).strip().splitlines()[:1]
    what = ": ".join([type(err).__name__, *words])
    raised = (
        f"raised {what}"
        if isinstance(err, Exception)
        else f"asked for the end of the program ({what})"
    )
    return PluginError(
        f"{_from(module, name)} {raised}",
        place=step.label if step is not None else "",
        cure=f"this is a fault in {plugin_of(module) or module}, not in your pipeline: {where}",
    )


def _root(frame: FrameType) -> str:
    """The package whose code this is."""
    return str(frame.f_globals.get("__package__") or frame.f_globals.get("__name__", "")).partition(
        "."
    )[0]


def _step(frame: FrameType) -> Operator | None:
    """The step whose method, or whose planning's, this is."""
    if "zonda.core.operator" not in sys.modules:  # nor is there any step
        return None
    from .operator import Operator

    owner = frame.f_locals.get("self")
    planned = getattr(owner, "__dict__", {}).get("operator")
    return next((step for step in (owner, planned) if isinstance(step, Operator)), None)


def _is_plugin(frame: FrameType) -> bool:
    """True for code of a plugin, or of a step that is not zonda's own."""
    owner = _step(frame)
    foreign = owner is not None and type(owner).__module__.partition(".")[0] != HOST
    return foreign or bool(plugin_of(str(frame.f_globals.get("__name__", ""))))


def _from(module: str, name: str) -> str:
    origin = plugin_of(module)
    return f"{module}.{name}{f' of {origin}' if origin else ''}"
