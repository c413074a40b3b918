"""A second process that draws while this one computes: matplotlib holds Python's lock, so a thread
would not do.

It is a child that hears from nobody but its parent, through pipes, and ends with it. On Linux it
has two processes of its own, made when all is imported, so that two pictures are drawn at a time.
Whatever goes wrong there (no processes allowed, killed for memory, a warning or an error while
drawing) is no matter: the caller draws the picture itself.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from queue import SimpleQueue
from threading import Event, Lock, Thread
from typing import IO, Any

from zonda.core import children

Calls = SimpleQueue[tuple[Future[Any], Any] | None]
Waiting = dict[int, Future[Any]]


class Artist:
    """Calls functions of modules in a second process, in the order in which they are submitted.

    Raises OSError where there can be no such process.
    """

    def __init__(self) -> None:
        self._closed = False
        self._process = subprocess.Popen(
            children.command("zonda.operators.diagnostics.drawing.artist", "serve"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is the parent's affair
        )
        self._calls: Calls = SimpleQueue()
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        waiting, ended = Waiting(), Event()
        for line in (
            partial(_ask, self._process.stdin, self._calls),
            partial(_hear, self._process.stdout),
        ):
            Thread(target=line, args=(waiting, ended), name="artist", daemon=True).start()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """What ``function(*arguments)`` returned there; None where it failed, warned, or there is
        no process any more.
        """
        future: Future[Any] = Future()
        if self._closed:
            future.set_result(None)
        else:
            self._calls.put((future, (function, arguments)))
        return future

    def close(self) -> None:
        """End the process and its children; the rest of the answers are None."""
        self._closed = True
        self._calls.put(None)
        if (
            self._process.returncode is None
        ):  # nobody has waited for it: dead or not, the group's number is still its own
            if hasattr(os, "killpg"):
                with suppress(OSError):
                    os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()
            self._process.wait()

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()


def _ask(outbox: IO[bytes], calls: Calls, waiting: Waiting, ended: Event) -> None:
    """Send calls. A daemon's work, as `_hear`: nobody waits for it where the run fails."""
    while (call := calls.get()) is not None:
        future, task = call
        waiting[id(future)] = future
        try:
            pickle.dump(
                (id(future), pickle.dumps(task, pickle.HIGHEST_PROTOCOL)),
                outbox,
                pickle.HIGHEST_PROTOCOL,
            )
            outbox.flush()
        except Exception:  # something that cannot be pickled, or nobody there
            _answer(waiting, id(future), None)
        if ended.is_set():
            _answer(waiting, id(future), None)
    with suppress(OSError):
        outbox.close()


def _hear(inbox: IO[bytes], waiting: Waiting, ended: Event) -> None:
    """Receive answers until the other end hangs up; the rest of them are None."""
    with suppress(Exception):
        while True:
            key, body = pickle.load(inbox)
            _answer(waiting, key, pickle.loads(body))
    ended.set()
    for key in list(waiting):
        _answer(waiting, key, None)
    inbox.close()


def _answer(waiting: Waiting, key: int, answer: Any) -> None:
    if (future := waiting.pop(key, None)) is not None:
        future.set_result(answer)


def serve() -> None:
    """The child's side: until the parent hangs up."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    inbox, outbox, lock = sys.stdin.buffer, sys.stdout.buffer, Lock()
    sys.stdout = sys.stderr  # what anybody prints must not come between
    _prepare()
    if sys.platform == "linux":
        pool: Executor = ProcessPoolExecutor(2, get_context("fork"), _hang_up)
    else:
        pool = ThreadPoolExecutor(1)

    def reply(key: int, done: Future[bytes]) -> None:
        with lock:
            pickle.dump((key, pickle.dumps(None) if done.exception() else done.result()), outbox)
            outbox.flush()

    with suppress(EOFError):
        while True:
            key, task = pickle.load(inbox)
            pool.submit(_draw, task).add_done_callback(partial(reply, key))


def _hang_up() -> None:
    """Leave the pipes to the process that listens to them."""
    for pipe in (0, 1):
        os.dup2(2, pipe)


def _draw(task: bytes) -> bytes:
    """The answer to one call."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        function, arguments = pickle.loads(task)
        return pickle.dumps(function(*arguments), pickle.HIGHEST_PROTOCOL)


def _prepare() -> None:
    """Import what drawing needs while the parent has nothing to draw yet."""
    import gc
    from importlib import import_module

    gc.disable()
    with suppress(
        Exception
    ):  # this process shows nobody the lists of properties in matplotlib's docstrings
        vars(import_module("matplotlib.artist")).update(kwdoc=lambda artist: "")
    for name in (
        "zonda.operators.diagnostics.drawing.pictures",
        "matplotlib.figure",
        "matplotlib.backends.backend_agg",
    ):
        with suppress(Exception):
            import_module(name)
    gc.freeze()
    gc.enable()
