"""A second process that draws while this one computes: matplotlib holds Python's lock, so a thread would not do.

It is a child that hears from nobody but its parent, through pipes, and ends with it. When it is ready it makes a twin of itself
(Linux), so that two pictures are drawn at a time. Whatever goes wrong there (no processes allowed, killed for memory, a warning
or an error while drawing) is no matter: the caller draws the picture itself.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import Any, BinaryIO

from zonda.core import children

LAID_IN = (1, 2, 1, 2, 2, 1, 2, 4)
"""Numbers of axes of the figures that are made ahead, for the pictures of a run with a noiseless and a source-free one."""

Tasks = SimpleQueue[tuple[Future[Any], Any] | None]


class Artist:
    """Calls functions of modules in a second process and its twin, in the order in which they are submitted.

    Raises OSError where there can be no such process.
    """

    def __init__(self) -> None:
        self._closed = False
        twin = [*os.pipe(), *os.pipe()] if sys.platform == "linux" else []
        theirs, ours = twin[::3], twin[1:3]
        try:
            self._process = subprocess.Popen(
                children.command("zonda.operators.diagnostics.artist", "serve", *theirs),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is the parent's affair
                pass_fds=theirs,
            )
        except BaseException:
            for end in ours:
                os.close(end)
            raise
        finally:
            for end in theirs:
                os.close(end)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._tasks: Tasks = SimpleQueue()
        others: list[str] = ["twin"] if twin else []
        lines = [(self._process.stdin, self._process.stdout, False)]
        lines += [(os.fdopen(ours[0], "wb"), os.fdopen(ours[1], "rb"), True)] if twin else []
        for outbox, inbox, later in lines:
            Thread(target=_converse, args=(outbox, inbox, self._tasks, others, later), name="artist", daemon=True).start()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """What ``function(*arguments)`` returned there; None where it failed, warned, or there is no process any more."""
        future: Future[Any] = Future()
        if self._closed:
            future.set_result(None)
            return future
        self._tasks.put((future, (function, arguments)))
        return future

    def close(self) -> None:
        """End the process and its twin; the rest of the answers are None."""
        self._closed = True
        for _ in range(2):
            self._tasks.put(None)
        if self._process.returncode is None:  # nobody has waited for it: dead or not, the group's number is still its own
            if hasattr(os, "killpg"):
                with suppress(OSError):
                    os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()
            self._process.wait()

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()


def _converse(outbox: BinaryIO, inbox: BinaryIO, tasks: Tasks, others: list[str], later: bool) -> None:
    """Send tasks and receive answers, one by one. A daemon's work: nobody waits for it where the run fails.

    ``others``: who goes on where this line is dead; nobody: the answers are None. ``later``: the other end says when it is there.
    """
    dead = later and not inbox.read(1)
    while not (dead and _leaves(others)) and (task := tasks.get()) is not None:
        future, call = task
        answer = None
        with suppress(Exception):  # something that cannot be pickled
            body = pickle.dumps(call, protocol=pickle.HIGHEST_PROTOCOL)
            try:
                outbox.write(body)
                outbox.flush()
                answer = pickle.load(inbox)
            except (OSError, EOFError):
                dead = True
        future.set_result(answer)
    for pipe in (inbox, outbox):
        with suppress(OSError):
            pipe.close()


def _leaves(others: list[str]) -> bool:
    """Whether somebody else goes on; may be true once."""
    with suppress(IndexError):
        others.pop()
        return True
    return False


def serve(*twin: int) -> None:
    """The child's side: until the parent hangs up. ``twin``: where a twin of this process reads and writes."""
    inbox, outbox = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout = sys.stderr  # what anybody prints must not come between
    _prepare()
    if twin:
        _divide(*twin)
    while _answer(inbox, outbox):
        pass


def _answer(inbox: BinaryIO, outbox: BinaryIO) -> bool:
    """One task; False: the parent has hung up."""
    import warnings

    try:
        function, arguments = pickle.load(inbox)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            answer = function(*arguments)
    except EOFError:
        return False
    except Exception:
        answer = None
    _send(outbox, answer)
    return True


def _divide(reads: int, writes: int) -> None:
    """Make a twin of this process, which reads and writes there instead, and says so."""
    with suppress(OSError):
        if os.fork() == 0:
            os.dup2(reads, 0)
            os.dup2(writes, 1)
            os.write(1, b"!")
    os.close(reads)
    os.close(writes)


def _prepare() -> None:
    """Import and make what drawing needs while the parent has nothing to draw yet."""
    import gc
    from importlib import import_module

    gc.disable()
    with suppress(Exception):  # this process shows nobody the lists of properties in matplotlib's docstrings
        vars(import_module("matplotlib.artist")).update(kwdoc=lambda artist: "")
    for name in ("zonda.operators.diagnostics.pictures", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        with suppress(Exception):
            import_module(name)
    gc.freeze()
    with suppress(Exception):
        lay_in = import_module("zonda.operators.diagnostics.canvas").lay_in
        for count in LAID_IN:
            lay_in(count)
    gc.enable()


def _send(outbox: BinaryIO, answer: Any) -> None:
    try:
        body = pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL)
    except Exception:
        body = pickle.dumps(None)
    outbox.write(body)
    outbox.flush()
