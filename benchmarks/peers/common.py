"""What every script here shares: the case it is given, and the figures it gives back. Needs numpy
only.
"""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


def cpu() -> float:
    """CPU seconds of this process, all its threads, and its ended children."""
    own, children = (
        resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def peak() -> float:
    """Largest memory of this process so far, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


class Stopwatch:
    """CPU seconds spent in one method of a class."""

    total = 0.0

    @contextmanager
    def of(self, owner: type, name: str) -> Iterator[None]:
        inner = getattr(owner, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            start = cpu()
            found = inner(*arguments, **options)
            self.total += cpu() - start
            return found

        setattr(owner, name, timed)
        try:
            yield
        finally:
            setattr(owner, name, inner)


def case() -> dict[str, Any]:
    """The case named on the command line: arrays and scalars by name (`peers.write_case`)."""
    with np.load(sys.argv[1]) as file:
        return {name: file[name] if file[name].ndim else file[name].item() for name in file.files}


def twice(run: Callable[[], dict[str, Any]], **more: Any) -> None:
    """Report the second of two runs, and with ``first`` what the first took, compilation
    included.
    """
    before = peak()
    first = run()
    report(first=first["setup"] + first["evaluation"], before=before, **run(), peak=peak(), **more)


def report(**figures: Any) -> None:
    """One line of JSON, the last of the output, for `peers.py`."""
    print(json.dumps(figures))
