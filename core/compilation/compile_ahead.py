"""The first run on a machine: a second process compiles the kernels that come last, while this one
compiles as it needs them.

Packages with kernels list them in the entry-point group ``zonda.kernels``: rows of text with the
order of first use in the shipped pipelines, the seconds [s] that one takes to compile with what it
calls, its module, its name and its types (`text_of`). The child begins with the second half, the
dearest first; each process finds in the cache what the other has made, and waits for what the other
is making (`kernel_cache.share`). Whatever goes wrong there only means that this process compiles
it. Later runs load the kernels in a thread while they point the telescope.
"""

from __future__ import annotations

import gc
import json
import os
import re
import subprocess
import sys
from bisect import bisect_right
from contextlib import suppress
from importlib import import_module
from itertools import accumulate
from threading import Event, Thread
from typing import Any

from .. import children
from ..discovery import RAISED, discover
from ..machine import available_threads
from ..storage import user_cache
from ..versions import fingerprint, versions
from .compiled import cache_folder

GROUP = "zonda.kernels"
KIND = "compiled"
COMPILING = (100_000, 20, 100)
"""Thresholds of garbage collection while kernels are compiled: by Python's own it takes 7 % of the
time.
"""


class Helper:
    """The second process of a first run, the thread of a later one; nothing where there is one
    processor only.

    `prepare` starts the process at once, before this one has imported anything heavy; `begin`, when
    the operators are imported, tells it their modules, whose kernels it compiles, or starts the
    thread. `close` it in any case; after `succeeded` there is no first run any more.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._key = {
            "program": fingerprint(),
            "versions": versions(),
            "processor": user_cache.processor(),
            "where": cache_folder(),
        }
        self._first = user_cache.recall(KIND, self._key) is None
        self._thread: Thread | None = None
        self._enough = Event()
        self._alone = available_threads() == 1 or not sys.executable
        self._thresholds = gc.get_threshold()

    def prepare(self) -> None:
        """Start the process of a first run."""
        if self._first and not self._alone:
            with suppress(OSError):
                self._process = subprocess.Popen(
                    children.command("zonda.core.compilation.compile_ahead", "serve"),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,  # Ctrl-C is the parent's affair
                )

    def begin(self) -> None:
        """Let the process compile, or the thread load, the kernels of the modules that are imported
        now.
        """
        modules = list(sys.modules)
        if self._first:
            gc.set_threshold(*COMPILING)
        elif not self._alone:
            self._thread = Thread(
                target=compile_listed, args=(modules, False, self._enough), daemon=True
            )
            self._thread.start()
        if self._process is not None and self._process.stdin is not None:
            from .jit import share

            share()
            with suppress(OSError):  # it has ended
                self._process.stdin.write(json.dumps(modules).encode() + b"\n")
                self._process.stdin.flush()

    def succeeded(self) -> None:
        """Remember that this was the first run."""
        if self._first:
            user_cache.remember(KIND, self._key, True)

    def close(self) -> None:
        """End the process and the thread."""
        gc.set_threshold(*self._thresholds)
        self._enough.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def serve() -> None:
    """The child's side: it ends when there is nothing left to compile, or when the parent has hung
    up.
    """
    from ..numerics import (
        random,
    )  # the second with numba, whose compiler is made ready while the parent reads its file
    from .jit import share

    random.fill_normals.targetctx.refresh()
    random.fill_normals.typingctx.refresh()
    modules = json.loads(sys.stdin.buffer.readline())

    def leave_with_parent() -> None:
        sys.stdin.buffer.read()
        os._exit(0)

    Thread(target=leave_with_parent, daemon=True).start()
    share(polite=True)
    gc.freeze()
    gc.set_threshold(*COMPILING)
    compile_listed(modules)


def compile_listed(modules: list[str], as_child: bool = True, enough: Event | None = None) -> int:
    """Compile or load the listed kernels of these modules until ``enough``; returns how many there
    were.
    """

    rows = [row for row in listed() if row[1] in modules]
    done = 0
    for _, module, name, *types in for_child(rows) if as_child else rows:
        if enough is not None and enough.is_set():
            break
        with suppress(
            Exception
        ):  # a list of another version: what it lacks is compiled when it is used
            getattr(import_module(module), name).compile(tuple(map(type_of, types)))
            done += 1
    return done


def listed() -> list[list[str]]:
    """Rows (seconds, module, name, types) of all lists, in the order of first use; a list that
    cannot be read is left out.
    """
    rows = []
    for found in discover(GROUP):
        with suppress(*RAISED):
            rows += [(float(order), rest) for order, *rest in map(str.split, found.load())]
    return [row for _, row in sorted(rows)]


def for_child(rows: list[list[str]]) -> list[list[str]]:
    """Rows that begin with seconds in the child's order: what ends in the second half of the time,
    the dearest first; then the others from the end."""
    ends = list(accumulate(float(row[0]) for row in rows))
    first = bisect_right(ends, ends[-1] / 2) if ends else 0
    return sorted(rows[first:], key=lambda row: -float(row[0])) + rows[:first][::-1]


def text_of(kind: Any) -> str | None:
    """A numba type as the list has it: ``f8``, ``f4:2C`` (dimensions, layout, ``r``: read only),
    ``f4:2C*3`` (a tuple of three); None: not one for the list."""
    from numba import types
    from numba.np.numpy_support import as_dtype

    if isinstance(kind, types.UniTuple):
        inner = text_of(kind.dtype)
        return f"{inner}*{kind.count}" if inner and "*" not in inner else None
    array = isinstance(kind, types.Array) and kind.aligned
    scalar = kind.dtype if array else kind
    if type(scalar) not in (types.Boolean, types.Integer, types.Float):
        return None
    code = as_dtype(scalar).str[1:]
    return f"{code}:{kind.ndim}{kind.layout}{'' if kind.mutable else 'r'}" if array else code


def type_of(text: str) -> Any:
    """The inverse of `text_of`. Raises ValueError."""
    import numpy as np
    from numba import types
    from numba.np.numpy_support import from_dtype

    if "*" in text:
        inner, _, count = text.partition("*")
        return types.UniTuple(type_of(inner), int(count))
    found = re.fullmatch(r"(b1|f[48]|[iu][1248])(?::(\d)([CFA])(r?))?", text)
    if found is None:
        raise ValueError(f"no type {text!r}")
    scalar = from_dtype(np.dtype(found[1]))
    return (
        types.Array(scalar, int(found[2]), found[3], readonly=bool(found[4]))
        if found[2]
        else scalar
    )
