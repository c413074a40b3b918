"""A second process that draws while this one computes: matplotlib holds Python's lock, so a thread would not do.

It is a child that hears from nobody but its parent, through pipes, and ends with it. Whatever goes wrong there (no processes
allowed, killed for memory, a warning or an error while drawing) is no matter: the caller draws the picture itself.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import Any, BinaryIO

_CHILD = "import sys; sys.path[:] = {path!r}; from zonda.operators.diagnostics.artist import serve; serve()"


class Artist:
    """Calls functions of modules in a second process, one after the other.

    Raises OSError where there can be no such process.
    """

    def __init__(self) -> None:
        self._closed = False
        if not sys.executable:
            raise OSError("this is no Python interpreter that could be started again")
        self._process = subprocess.Popen(
            [sys.executable, "-c", _CHILD.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is the parent's affair
        )
        self._tasks: SimpleQueue[tuple[Future[Any], Any] | None] = SimpleQueue()
        Thread(target=_converse, args=(self._process, self._tasks), name="artist", daemon=True).start()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """What ``function(*arguments)`` returned there; None where it failed, warned, or there is no process any more."""
        future: Future[Any] = Future()
        if self._closed:
            future.set_result(None)
            return future
        self._tasks.put((future, (function, arguments)))
        return future

    def close(self) -> None:
        """End the process; the rest of the answers are None."""
        self._closed = True
        self._tasks.put(None)
        self._process.kill()
        self._process.wait()

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()


def _converse(process: subprocess.Popen[bytes], tasks: SimpleQueue[tuple[Future[Any], Any] | None]) -> None:
    """Send tasks and receive answers, one by one. A daemon's work: nobody waits for it where the run fails."""
    inbox, outbox = process.stdout, process.stdin
    assert inbox is not None
    assert outbox is not None
    while (task := tasks.get()) is not None:
        future, call = task
        answer = None
        with suppress(Exception):  # a broken pipe, something that cannot be pickled
            body = pickle.dumps(call, protocol=pickle.HIGHEST_PROTOCOL)
            outbox.write(body)
            outbox.flush()
            answer = pickle.load(inbox)
        future.set_result(answer)
    for pipe in (inbox, outbox):
        with suppress(OSError):
            pipe.close()


def serve() -> None:
    """The child's side: until the parent hangs up."""
    import warnings

    inbox, outbox = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout = sys.stderr  # what anybody prints must not come between
    _prepare()
    while True:
        try:
            function, arguments = pickle.load(inbox)
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                answer = function(*arguments)
        except EOFError:
            return
        except Exception:
            answer = None
        _send(outbox, answer)


def _prepare() -> None:
    """Import what drawing needs while the parent has nothing to draw yet."""
    import gc
    from importlib import import_module

    gc.disable()
    with suppress(Exception):  # this process shows nobody the lists of properties in matplotlib's docstrings
        vars(import_module("matplotlib.artist")).update(kwdoc=lambda artist: "")
    for name in ("zonda.operators.diagnostics.pictures", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        with suppress(Exception):
            import_module(name)
    gc.freeze()
    gc.enable()


def _send(outbox: BinaryIO, answer: Any) -> None:
    try:
        body = pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL)
    except Exception:
        body = pickle.dumps(None)
    outbox.write(body)
    outbox.flush()
