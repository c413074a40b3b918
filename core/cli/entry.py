"""The entry point of the command line: exit statuses, signals, warnings and errors as a user reads
them.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import click

from zonda import __version__
from zonda.commands import COMMANDS

from ..errors import ZondaError

INTERRUPTED = 130
"""Exit status after Ctrl-C."""


class Stopped(KeyboardInterrupt):
    """A signal that asks the process to end; it is handled as Ctrl-C is. ``status``: the exit
    status, 128 + its number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.status = 128 + number


class Interrupted(Exception):
    """Ctrl-C or `Stopped`; click would print an empty line for a KeyboardInterrupt."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


class Commands(click.Group):
    """The built-in commands, and those of plugins: plugins are loaded only when a command is not
    built in, or for help.
    """

    _extended = False

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of all commands."""
        self._extend()
        return sorted(self.commands)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """One command."""
        if name in COMMANDS:
            self._import(name)
        elif name not in self.commands:
            self._extend()
        return super().get_command(ctx, name)

    def resolve_command(
        self,
        ctx: click.Context,
        args: list[str],
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a command as click does; an unknown command names the nearest one, and a pipeline
        file the command to use.
        """
        name = args[0]
        if self.get_command(ctx, name) is None and not name.startswith("-"):
            from ..configuration.diagnostics import nearest
            from ..configuration.locate import shipped

            a_file = name.endswith((".yaml", ".yml")) or name in shipped()
            hint = f"did you mean 'zonda run {name}'?" if a_file else nearest(name, self.commands)
            ctx.fail(f"there is no command '{name}'; {hint or 'see zonda --help'}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command."""
        from ..faults import faults_named

        try:
            with faults_named():
                return super().invoke(ctx)
        except KeyboardInterrupt as err:
            raise Interrupted(getattr(err, "status", INTERRUPTED)) from None

    def _import(self, name: str) -> None:
        module, _, attribute = COMMANDS[name].partition(":")
        self.commands[name] = getattr(import_module(module), attribute)

    def _extend(self) -> None:
        for name in COMMANDS:
            self._import(name)
        if not self._extended:
            self._extended = True
            from ..hooks import manager

            built_in = dict(self.commands)
            manager().hook.zonda_commands(group=self)
            self.commands.update(built_in)  # a plugin adds commands, it does not replace any


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, "--version", prog_name="zonda", message="%(prog)s %(version)s")
def zonda() -> None:
    """Simulate what a ground-based (sub-)millimetre telescope records, and map it."""


USER_ERROR = 2
"""Exit status after a mistake of the user's."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; the exit status: 0, 1 (a plugin's fault), 2 (a user's mistake), 128 + a
    signal that ended it.
    """
    with _unbroken_streams(), _plain_warnings(), _stoppable():
        try:
            result = zonda.main(arguments, prog_name="zonda", standalone_mode=False)
            return result if isinstance(result, int) else 0
        except click.ClickException as err:
            err.show()
            return err.exit_code
        except ZondaError as err:
            _report(err)
        except (Interrupted, KeyboardInterrupt, click.Abort) as err:
            clear_line()
            with contextlib.suppress(OSError):  # the terminal may be gone
                click.echo("interrupted: unfinished files were removed", err=True)
            return int(getattr(err, "status", INTERRUPTED))
        except MemoryError as err:
            cure = (
                "make the scans shorter, the sample rate lower or the detectors fewer, or use a"
                " larger machine"
            )
            _report(ZondaError(f"not enough memory{f': {err}' if str(err) else ''}", cure=cure))
        except OSError as err:
            if err.filename is None and err.errno not in (
                errno.ENOSPC,
                errno.EDQUOT,
                errno.EROFS,
                errno.EFBIG,
            ):
                raise
            _report(ZondaError(err.strerror or str(err), place=str(err.filename or "")))
        return USER_ERROR


def _report(err: ZondaError) -> None:
    colour = sys.stderr.isatty() and "NO_COLOR" not in os.environ
    clear_line()
    if render := getattr(err, "render", None):
        text = render(colour)
    else:
        text = f"{click.style('error', fg='red', bold=True) if colour else 'error'}: {err}"
    click.echo(text.encode(errors="backslashreplace").decode(), err=True)  # names that are no UTF-8


def clear_line() -> None:
    """Clear the line that a progress plugin may have left."""
    if sys.stderr.isatty():
        click.echo("\r\033[K", nl=False, err=True)


class _Unbroken:
    """A standard stream that drops what nobody can read any more.

    ``lossy``: what cannot be written for another cause, such as a full disk, is dropped, too.
    """

    def __init__(self, stream: Any, lossy: bool) -> None:
        self._stream = stream
        self.lossy = lossy

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text; the number of letters."""
        self._try(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        self._try(self._stream.flush)

    def _try(self, function: Callable[..., Any], *arguments: str) -> None:
        try:
            function(*arguments)
        except OSError as err:
            if not (self.lossy or err.errno in (errno.EPIPE, errno.EIO)):
                raise
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())  # what is buffered is written at the end
            os.close(nowhere)


@contextlib.contextmanager
def _unbroken_streams() -> Iterator[None]:
    """Let a command end as usual if a standard stream is closed or its reader is gone."""
    usual: Any = (sys.stdout, sys.stderr)
    with contextlib.ExitStack() as opened:
        taken = [
            # a closed one; else a file of the run would take its number
            opened.enter_context(open(os.devnull, "w")) if stream is None else stream
            for stream in usual
        ]
        made: list[Any] = [_Unbroken(taken[0], lossy=False), _Unbroken(taken[1], lossy=True)]
        sys.stdout, sys.stderr = made
        try:
            yield
        finally:
            sys.stdout, sys.stderr = usual
            for stream in made:
                stream.lossy = True  # what could not be written has been told
                stream.flush()


@contextlib.contextmanager
def _stoppable() -> Iterator[None]:
    """SIGTERM (batch systems, containers) and SIGHUP (a terminal that closes) end a command as
    Ctrl-C does: cleaned up, once.

    A signal that somebody handles or ignores (nohup) already is left alone.
    """
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    taken = [n for n in numbers if signal.getsignal(n) is signal.SIG_DFL]

    def stop(number: int, frame: object) -> None:
        for n in taken:
            signal.signal(n, signal.SIG_IGN)  # a second one must not interrupt the cleaning
        raise Stopped(number)

    for number in taken:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


@contextlib.contextmanager
def _plain_warnings() -> Iterator[None]:
    """Warnings as one line without the source that raised them.

    A warning that differs from an earlier one in its figures alone is not shown again.
    """
    usual = warnings.formatwarning
    usual_show = warnings.showwarning
    shown: set[str] = set()

    def one_line(
        message: Any,
        category: Any,
        filename: str,
        lineno: int,
        line: str | None = None,
    ) -> str:
        return f"warning: {message}\n"

    def show(message: Any, *place: Any, **more: Any) -> None:
        text = _FIGURES.sub("#", str(message))
        if text not in shown:
            shown.add(text)
            usual_show(message, *place, **more)

    warnings.formatwarning, warnings.showwarning = one_line, show
    try:
        yield
    finally:
        warnings.formatwarning, warnings.showwarning = usual, usual_show


_FIGURES = re.compile(r"scan-\d+|(?<![\w.-])[-+]?\d[\d.]*(e[-+]?\d+)?(?!\w)")
