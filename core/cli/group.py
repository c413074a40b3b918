"""The group of commands ``zonda``: the built-in ones and those of plugins, imported when they are
named or listed.
"""

from __future__ import annotations

import signal
from importlib import import_module
from typing import Any

import click

from zonda import __version__
from zonda.commands import COMMANDS

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
        self, ctx: click.Context, args: list[str]
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
