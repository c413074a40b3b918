"""The command ``zonda``. Each command imports what it needs: ``zonda --help`` must stay quick."""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from zonda import __version__

from .errors import ZondaError

if TYPE_CHECKING:
    from .configuration.pipeline_file import PipelineFile

    _Integer = click.ParamType[int]
    _Anything = click.ParamType[Any]
else:
    _Integer = _Anything = click.ParamType  # an older click's has no type of its values

USER_ERROR, INTERRUPTED = 2, 130

_UNITS = {"": 1, "B": 1, **{f"{p}{i}B": b ** (k + 1) for k, p in enumerate("KMGT") for i, b in (("", 1000), ("I", 1024))}}


class Bytes(_Integer):
    """A size such as 4GB or 500MiB, in bytes."""

    name = "SIZE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Bytes; fails with what was expected."""
        if isinstance(value, int):
            return value
        text = str(value).strip()
        number = text.rstrip("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ ")
        try:
            size = float(number) * _UNITS[text[len(number) :].strip().upper()]
        except (ValueError, KeyError):
            self.fail(f"{value!r} is not a size; write e.g. 4GB or 500MiB", param, ctx)
        if not 1 <= size < 2**63:
            self.fail(f"{value!r} is not a size a computer has", param, ctx)
        return int(size)


class Share(_Anything):
    """``3/8``, the third of eight shares, as (3, 8)."""

    name = "K/N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """(K, N); fails with what was expected."""
        first, _, second = str(value).partition("/")
        if not (first.isdecimal() and second.isdecimal() and 1 <= int(first) <= int(second)):
            self.fail(f"{value!r} is no share of the tasks; write K/N with K from 1 to N, e.g. 3/8", param, ctx)
        return int(first), int(second)


ELSEWHERE = {
    "accuracy": "zonda.core.accuracy.command:accuracy",
    "doctor": "zonda.plugins.doctor_command:doctor",
    "plan": "zonda.core.plan.command:plan",
    "resume": "zonda.core.campaign.command:resume",
    "status": "zonda.core.campaign.command:status",
    "weather": "zonda.plugins.weather_command:weather",
}
"""Built-in commands that live with what they use, imported when they are named or listed.

Through the hook `zonda_commands`, as a third party's, they would cost ``zonda --help`` 60 ms more: pluggy and the metadata.
"""


class Stopped(KeyboardInterrupt):
    """A signal that asks the process to end; it is handled as Ctrl-C is. ``status``: the exit status, 128 + its number."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.status = 128 + number


class Interrupted(Exception):
    """Ctrl-C or `Stopped`; click would print an empty line for a KeyboardInterrupt."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


class Commands(click.Group):
    """The built-in commands, and those of plugins: plugins are loaded only when a command is not built in, or for help."""

    _extended = False

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All names."""
        self._extend()
        return sorted(self.commands)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """One command."""
        if name in ELSEWHERE:
            self._import(name)
        elif name not in self.commands:
            self._extend()
        return super().get_command(ctx, name)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """As click's, but an unknown command names the nearest one, and a pipeline file the command to use."""
        name = args[0]
        if self.get_command(ctx, name) is None and not name.startswith("-"):
            from .configuration.diagnostics import nearest
            from .configuration.locate import shipped

            a_file = name.endswith((".yaml", ".yml")) or name in shipped()
            hint = f"did you mean 'zonda run {name}'?" if a_file else nearest(name, self.commands)
            ctx.fail(f"there is no command '{name}'; {hint or 'see zonda --help'}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command."""
        from .faults import faults_named

        try:
            with faults_named():
                return super().invoke(ctx)
        except KeyboardInterrupt as err:
            raise Interrupted(getattr(err, "status", INTERRUPTED)) from None

    def _import(self, name: str) -> None:
        from importlib import import_module

        module, _, attribute = ELSEWHERE[name].partition(":")
        self.commands[name] = getattr(import_module(module), attribute)

    def _extend(self) -> None:
        for name in ELSEWHERE:
            self._import(name)
        if not self._extended:
            self._extended = True
            from .discovery import others_may_declare

            if not others_may_declare("zonda.hooks"):
                return
            from .hooks import manager

            built_in = dict(self.commands)
            manager().hook.zonda_commands(group=self)
            self.commands.update(built_in)  # a plugin adds commands, it does not replace any


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, "--version", prog_name="zonda", message="%(prog)s %(version)s")
def zonda() -> None:
    """Simulate what a ground-based (sub-)millimetre telescope records, and map it."""


_pipeline = click.argument("pipeline", metavar="FILE_OR_NAME")
_set = click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change one value, e.g. PinkNoise.knee='0.5 Hz' or seed=8."
)


_keep = click.option("--keep", multiple=True, metavar="NAME", help="Simulate this effect or operator in full, see `zonda plan`.")
_drop = click.option("--drop", multiple=True, metavar="NAME", help="Leave this effect or operator out, whatever that costs.")
_only = click.option(
    "--only", multiple=True, metavar="COMPONENT", help="Simulate this component (e.g. sky) alone, as a companion run would."
)
_no_prune = click.option("--no-prune", is_flag=True, help="Simulate everything in full.")


@zonda.command()
@click.argument("pipelines", metavar="FILE_OR_NAME...", nargs=-1, required=True)
@_set
@_keep
@_drop
@_only
@_no_prune
@click.option("--output", type=click.Path(path_type=Path), metavar="DIR", help="Folder for products.  [default: as in the file]")
@click.option("--threads", type=click.IntRange(min=1), metavar="N", help="Threads; results do not depend on it.  [default: all]")
@click.option(
    "--memory",
    type=Bytes(),
    metavar="SIZE",
    help="Most memory to hold, of a campaign all its workers' on this machine (with MPI and Dask each process's), e.g. 4GB; "
    "results do not depend on it.  [default: half of the free]",
)
@click.option("-v", "--verbose", is_flag=True, help="Say all that was counted, chosen and approximated, not only what was lost.")
@click.option("--verify", is_flag=True, help="Measure the error of this run's approximations: one more run, at their tightest.")
@click.option(
    "--engine",
    type=click.Choice(["serial", "processes", "mpi", "dask"]),
    help="Run scans as tasks of a campaign.  [default: as in the file's campaign]",
)
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Processes of --engine processes.")
@click.option("--scheduler", metavar="ADDRESS", help="Of Dask, e.g. tcp://host:8786, or its scheduler file.")
@click.option("--task", "share", type=Share(), help="Run this share of a campaign's tasks, e.g. 3/8: for job arrays.")
def run(
    pipelines: tuple[str, ...],
    settings: tuple[str, ...],
    keep: tuple[str, ...],
    drop: tuple[str, ...],
    only: tuple[str, ...],
    no_prune: bool,
    output: Path | None,
    threads: int | None,
    memory: int | None,
    verbose: bool,
    verify: bool,
    engine: str | None,
    workers: int | None,
    scheduler: str | None,
    share: tuple[int, int] | None,
) -> None:
    """Run a pipeline file, or a shipped pipeline by its name; a campaign of observations where the file has `campaign:`, or where
    there are several files.

    What its outputs do not depend on is left out, and effects are dropped or coarsened while the errors stay within the budget
    (by default a tenth of the noise): `zonda plan` shows what. The products are in the folder that the last line names.
    """
    from . import early
    from .compilation.compile_ahead import Helper
    from .compilation.compiled import ensure_cache, one_blas_thread
    from .machine import available_threads

    one_blas_thread()
    ensure_cache()
    click.get_current_context().call_on_close(gc.enable)
    gc.disable()  # modules make no garbage, and looking for it takes a tenth of their time
    pipeline = pipelines[0]
    helper = Helper()
    click.get_current_context().call_on_close(helper.close)
    several = len(pipelines) > 1 or engine or workers or scheduler or share
    if available_threads() > 1 and threads != 1 and not several:
        click.get_current_context().call_on_close(early.end)
        early.begin(pipeline)
    if not several:
        helper.prepare()
    file = _load(pipeline, settings)
    if several or file.header.campaign is not None:
        helper.close()
        early.end()
        if verify or only:
            raise click.UsageError(f"{'--verify' if verify else '--only'} is for one run, not for a campaign")
        gc.enable()
        from .campaign import command as campaign

        campaign.run(
            pipelines, settings, keep=keep, drop=drop, no_prune=no_prune, output=output, threads=threads, memory=memory,
            verbose=verbose, engine=engine, workers=workers, scheduler=scheduler, share=share,
            command=_command(pipelines, settings, keep, drop, no_prune),
        )  # fmt: skip
        return
    from .plan import remembered
    from .run.first_look import first_look
    from .storage.files import check_output_folder, write_text
    from .storage.lock import lock

    if only and verify:
        raise click.UsageError("--verify measures the whole pipeline: leave --only out")
    if only:
        file = _load(pipeline, settings, only)
    first_look(file.pipeline(), file.scene())  # minutes of work must not come before a mistake that is seen at once
    target = file.header.accuracy
    if target is not None:
        from .accuracy.store import settings_for

        choice = settings_for(file, target.target, target.metric)
        click.echo(f"accuracy: {choice.reason}", err=True)
        settings = (*settings, *choice.overrides)
        file = _load(pipeline, settings, only)
    folder = file.output if output is None else output
    check_output_folder(folder)  # before anything is worked out
    click.get_current_context().with_resource(lock(folder))
    campaign_there = (folder / "campaign.json").exists()
    if campaign_there:
        from .campaign.folder import check_free, make_way

        check_free(folder)
    helper.begin()
    made = remembered.summary(file, keep=keep, drop=drop, prune_all=not no_prune, threads=threads, memory=memory)
    click.echo(str(made), err=True)
    whole, file = len(file.steps), made.apply(file)
    resolved = file.resolved_yaml()
    command = _command(pipelines, settings, keep, drop, no_prune, only)
    provenance = {"resolved_yaml": resolved, "command": command, "plan": made.short}
    if campaign_there:
        make_way(folder)
    gc.freeze()
    gc.enable()
    data = file.pipeline().run(file.scene(), output=folder, threads=threads, ceiling=memory, provenance=provenance)
    helper.succeeded()
    write_text(folder / "resolved.yaml", resolved)
    counts = {(who, what) for who, what, number in data.tally.counts() if number and "/" not in who}
    lost = {(who, what) for who, what in counts if what != "samples binned"}
    for who, what, value in data.tally.told():
        if verbose or (who, what) in lost:
            click.echo(f"{who}: {what}: {value}", err=True)
    if verify:
        from .accuracy.verify import achieved

        metric = target.metric if target else "map_rms"
        error = achieved(file, pipeline, settings, metric, threads, data if len(file.steps) == whole else None)
        wanted = f" (target {100 * target.target:g} %)" if target else ""
        click.echo(f"error of {metric} against the tightest knobs: {100 * error:.2g} %{wanted}", err=True)
    click.echo(f"{folder}/")


def _command(
    pipelines: tuple[str, ...],
    settings: tuple[str, ...],
    keep: tuple[str, ...] = (),
    drop: tuple[str, ...] = (),
    no_prune: bool = False,
    only: tuple[str, ...] = (),
) -> str:
    """The command that makes the same products elsewhere: what changes no result (threads, memory, folder) is left out."""
    import shlex

    options = [("--set", settings), ("--keep", keep), ("--drop", drop), ("--only", only)]
    parts = [part for option, texts in options for text in texts for part in (option, text)]
    return shlex.join(["zonda", "run", *pipelines, *parts, *(["--no-prune"] if no_prune else [])])


@zonda.command()
@_pipeline
@_set
def check(pipeline: str, settings: tuple[str, ...]) -> None:
    """Check a pipeline file without running it.

    Every mistake in the file is shown at once, with its place. The telescope is pointed at some instants of the scans: whether
    the target is up, how near they come to the telescope's speed and acceleration, how many samples there are in a beam; and
    whether it is on the input maps, of which the headers alone are read. A run begins with the same look.
    """
    file = _load(pipeline, settings)
    from .run.first_look import first_look
    from .scene import elsewhere

    if note := elsewhere(file.scene()):
        click.echo(f"warning: {note}", err=True)
    found = first_look(file.pipeline(), file.scene())
    click.echo(f"{file.place}: no mistakes, {len(file.steps)} steps")
    for step, lines in zip(file.steps, found, strict=True):
        click.echo(f"  {step.key}")
        for line in lines:
            click.echo(f"    {line}")
    if file.header.campaign is not None:
        from .campaign.command import source
        from .campaign.prepare import outline

        click.echo(outline(source(pipeline, settings, False))[0])


@zonda.command()
@click.option("--check", is_flag=True, help="Import each one; exit status 1 where one fails.")
def plugins(check: bool) -> None:
    """List operators, instruments, sites and other components.

    These are operators, mapmakers, instruments, sites, bands, noise models, weather sources, spectra, checks, metrics and hooks,
    each with the distribution and the module that it comes from.
    """
    from . import hooks
    from .discovery import discover
    from .registry import registries

    rows: list[tuple[str, ...]] = []
    failures: list[Exception] = []
    for registry in registries:
        candidates = registry.candidates()
        for found in candidates:
            twice = sum(other.name == found.name for other in candidates) > 1
            note = "provided twice" if twice else ""
            if check:
                try:
                    registry.load(found) if registry.classes or twice else registry.create(found.name)
                except ZondaError as err:
                    failures.append(err)
                    note = "FAILED"
            rows.append((registry.kind, found.name, found.origin, found.reference, note))
    rows += [("hook", found.name, found.origin, found.reference, "") for found in discover(hooks.GROUP)]
    widths = [max((len(row[k]) for row in rows), default=0) for k in range(4)]
    for row in rows:
        click.echo("  ".join([*(text.ljust(width) for text, width in zip(row, widths, strict=False)), row[4]]).rstrip())
    if check:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            hooks.manager.cache_clear()
            hooks.manager()
        for warning in caught:
            failures.append(ZondaError(str(warning.message)))
        for failure in failures:
            click.echo(f"\n{failure}", err=True)
            if failure.__cause__ is not None:
                import traceback

                click.echo("".join(traceback.format_exception(failure.__cause__)).rstrip(), err=True)
        click.echo(f"\n{len(rows)} components, {len(failures)} fault{'s' if len(failures) != 1 else ''}", err=True)
        if failures:
            raise click.exceptions.Exit(1)


@zonda.command()
def pipelines() -> None:
    """List the shipped pipelines, to be run by their names."""
    from .configuration import locate, yaml_places

    rows = []
    for name, path in locate.shipped().items():
        value = yaml_places.load(yaml_places.Source(str(path), locate.read(path))).value
        rows.append((name, str(value.get("description", "")) if isinstance(value, dict) else ""))
    width = max((len(name) for name, _ in rows), default=0)
    for name, description in rows:
        click.echo(f"{name.ljust(width)}  {description}")


@zonda.command()
def schema() -> None:
    """Print the JSON schema of pipeline files, for editors."""
    import json

    from .configuration.schema import json_schema

    click.echo(json.dumps(json_schema(), indent=2))


def _load(pipeline: str, settings: tuple[str, ...], only: tuple[str, ...] = ()) -> PipelineFile:
    from .configuration.pipeline_file import load

    file = load(pipeline, settings)
    if not only:
        return file
    from .plan.only import only as alone

    return alone(file, only)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; the exit status: 0, 1 (a plugin's fault), 2 (a user's mistake), 128 + a signal that ended it."""
    with _plain_warnings(), _stoppable():
        try:
            result = zonda.main(arguments, prog_name="zonda", standalone_mode=False)
            return result if isinstance(result, int) else 0
        except click.ClickException as err:
            err.show()
            return err.exit_code
        except ZondaError as err:
            _report(err)
        except (Interrupted, KeyboardInterrupt, click.Abort) as err:
            _clear()
            with contextlib.suppress(OSError):  # the terminal may be gone
                click.echo("interrupted: unfinished files were removed", err=True)
            return int(getattr(err, "status", INTERRUPTED))
        except MemoryError as err:
            cure = "make the scans shorter, the sample rate lower or the detectors fewer, or use a larger machine"
            _report(ZondaError(f"not enough memory{f': {err}' if str(err) else ''}", cure=cure))
        except OSError as err:
            if err.filename is None and err.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG):
                raise
            _report(ZondaError(err.strerror or str(err), place=str(err.filename or "")))
        return USER_ERROR


def _report(err: ZondaError) -> None:
    colour = sys.stderr.isatty() and "NO_COLOR" not in os.environ
    _clear()
    if render := getattr(err, "render", None):
        click.echo(render(colour), err=True)
    else:
        click.echo(f"{click.style('error', fg='red', bold=True) if colour else 'error'}: {err}", err=True)


def _clear() -> None:
    """Clear the line that a progress plugin may have left."""
    if sys.stderr.isatty():
        click.echo("\r\033[K", nl=False, err=True)


@contextlib.contextmanager
def _stoppable() -> Iterator[None]:
    """SIGTERM (batch systems, containers) and SIGHUP (a terminal that closes) end a command as Ctrl-C does: cleaned up, once.

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

    One that differs in its figures alone from one before is not shown: the first look at a pipeline has told it already.
    """
    usual, usual_show = warnings.formatwarning, warnings.showwarning
    told: set[str] = set()

    def one_line(message: Any, category: Any, filename: str, lineno: int, line: str | None = None) -> str:
        return f"warning: {message}\n"

    def show(message: Any, *place: Any, **more: Any) -> None:
        text = _FIGURES.sub("#", str(message))
        if text not in told:
            told.add(text)
            usual_show(message, *place, **more)

    warnings.formatwarning, warnings.showwarning = one_line, show
    try:
        yield
    finally:
        warnings.formatwarning, warnings.showwarning = usual, usual_show


_FIGURES = re.compile(r"scan-\d+|(?<![\w.-])[-+]?\d[\d.]*(e[-+]?\d+)?(?!\w)")


if __name__ == "__main__":
    sys.exit(main())
