"""``zonda run``, ``zonda check``, ``zonda compile``: commands about pipeline files. Only click is
imported with this module.
"""

from __future__ import annotations

import gc
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..command_options import (
    RunRequest,
    Share,
    drop_option,
    keep_option,
    on_engine,
    only_option,
    set_option,
)
from . import listing

if TYPE_CHECKING:
    from ..configuration.loaded import Accuracy
    from ..configuration.pipeline_file import PipelineFile
    from ..data import Data


@click.command()
@click.argument(
    "pipelines",
    metavar="FILE_OR_NAME...",
    nargs=-1,
    required=True,
    shell_complete=listing.complete_pipelines,
)
@set_option
@keep_option
@drop_option
@only_option
@click.option(
    "--prune/--no-prune",
    default=None,
    help=(
        "Plan: leave out and coarsen what the error budget allows; or simulate everything in full."
        "  [default: plan from 2e8 samples on]"
    ),
)
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder for products.  [default: as in the file]",
)
@on_engine
@click.option(
    "--verify",
    is_flag=True,
    help="Measure the error of this run's approximations: one more run, at their tightest.",
)
@click.option(
    "--task",
    "share",
    type=Share(),
    help="Run this share of a campaign's tasks, e.g. 3/8: for job arrays.",
)
def run(**given: Any) -> None:
    """Run a pipeline file, or a shipped pipeline by its name; a campaign of observations where the
    file has `campaign:`, or where there are several files.

    What its outputs do not depend on is left out. From 2e8 samples on, or with --prune, effects are
    dropped or coarsened while the errors stay within the budget (by default a tenth of the noise):
    `zonda plan` shows what. The products are in the folder that the last line names.
    """
    from ..machine import one_blas_thread

    request = RunRequest(**given)
    one_blas_thread()
    context = click.get_current_context()
    context.call_on_close(gc.enable)
    gc.disable()  # modules make no garbage, and looking for it takes a tenth of their time
    file = load(request.pipelines[0], request.settings)
    if request.is_campaign or file.header.campaign is not None:
        _run_campaign(request)
    else:
        _run_one(request, file)


def load(pipeline: str, settings: tuple[str, ...], only: tuple[str, ...] = ()) -> PipelineFile:
    """A pipeline file with the values of ``--set`` and the components of ``--only``."""
    from ..configuration.pipeline_file import load

    file = load(pipeline, settings)
    if not only:
        return file
    from ..plan.structure import only as alone

    return alone(file, only)


def _run_campaign(request: RunRequest) -> None:
    if request.verify or request.only:
        raise click.UsageError(
            f"{'--verify' if request.verify else '--only'} is for one run, not for a campaign"
        )
    gc.enable()
    from ..campaign import command as campaign

    campaign.run(request)


def _run_one(request: RunRequest, file: PipelineFile) -> None:
    from ..plan.planner import for_run
    from ..storage.files import check_output_folder, write_text
    from ..storage.output_folder import lock, recording

    pipeline = request.pipelines[0]
    settings = request.settings
    if request.only and request.verify:
        raise click.UsageError("--verify measures the whole pipeline: leave --only out")
    if request.only:
        file = load(pipeline, settings, request.only)
    file.look()  # minutes of work must not come before a mistake that is seen at once
    if file.header.accuracy is not None:
        settings = (*settings, *_knobs(file, file.header.accuracy))
        file = load(pipeline, settings, request.only)
    folder = file.output if request.output is None else request.output
    check_output_folder(folder)  # before anything is worked out
    click.get_current_context().with_resource(lock(folder))
    read = [Path(file.place), *file.inputs]
    click.get_current_context().with_resource(recording(folder, anew=True, inputs=read))
    campaign_there = (folder / "campaign.json").exists()
    if campaign_there:
        from ..campaign.folder import check_free, make_way

        check_free(folder)
    made = for_run(
        file,
        keep=request.keep,
        drop=request.drop,
        prune_all=request.prune,
        threads=request.threads,
        memory=request.memory,
    )
    click.echo(str(made), err=True)
    if omitted := made.omitted(file):
        click.echo(f"omitted: {', '.join(omitted)} (zonda plan says why)", err=True)
    whole = len(file.steps)
    file = made.apply(file)
    resolved = file.resolved_yaml()
    provenance = {"resolved_yaml": resolved, "command": request.command, "plan": made.short}
    if campaign_there:
        make_way(folder)
    gc.freeze()
    gc.enable()
    data = file.pipeline().run(
        file.scene(),
        output=folder,
        threads=request.threads,
        ceiling=request.memory,
        provenance=provenance,
    )
    write_text(folder / "resolved.yaml", resolved)
    _show(data, request.verbose)
    if request.verify:
        _verify(file, request, settings, data if len(file.steps) == whole else None)
    click.echo(f"{folder}/")


def _knobs(file: PipelineFile, wanted: Accuracy) -> tuple[str, ...]:
    """Settings of the knobs that meet an accuracy."""
    from ..accuracy.fronts import settings_for

    choice = settings_for(file, wanted.target, wanted.metric)
    click.echo(f"accuracy: {choice.reason}", err=True)
    return choice.overrides


def _show(data: Data, verbose: bool) -> None:
    """Print what was lost; with ``verbose`` all that was counted, chosen and approximated."""
    counts = {(who, what) for who, what, number in data.log.counts() if number and "/" not in who}
    lost = {(who, what) for who, what in counts if what != "samples binned"}
    for who, what, value in data.log.told():
        if verbose or (who, what) in lost:
            click.echo(f"{who}: {what}: {value}", err=True)


def _verify(
    file: PipelineFile,
    request: RunRequest,
    settings: tuple[str, ...],
    data: Data | None,
) -> None:
    """Measure the error of a run; ``data``: what it made, if that is the whole pipeline."""
    from ..accuracy.fronts import achieved
    from ..accuracy.report import by_band

    target = file.header.accuracy
    metric = target.metric if target else "map_rms"
    error, bands = achieved(file, request.pipelines[0], settings, metric, request.threads, data)
    wanted = f" (target {100 * target.target:g} %)" if target else ""
    each = f" (the largest of {by_band(bands)})" if bands else ""
    click.echo(
        f"error of {metric} against the tightest knobs: {100 * error:.2g} %{each}{wanted}",
        err=True,
    )


@click.command("compile")
@click.argument(
    "names", metavar="[FILE_OR_NAME]...", nargs=-1, shell_complete=listing.complete_pipelines
)
def compile_kernels(names: tuple[str, ...]) -> None:
    """Compile the kernels of pipelines, by default of all shipped ones, so that no later run does.

    Run it once where many processes are going to start together, e.g. on a cluster whose nodes
    share a home: while one process compiles, the others wait for it. Seconds of each pipeline are
    simulated; nothing is written but the machine code.
    """
    from ..machine import one_blas_thread

    one_blas_thread()
    from ..configuration.locate import shipped
    from ..errors import OutputError
    from ..kernels import folder
    from ..plan.planner import for_run
    from ..plan.prediction import sliced

    place = folder()
    if place is None:
        raise OutputError(
            "machine code cannot be stored",
            place="zonda compile",
            cure="set NUMBA_CACHE_DIR to a folder of yours that lasts",
        )
    for name in names or shipped():
        file = load(name, ())
        part = sliced(for_run(file).apply(file), seconds=2.0)
        part.pipeline().run(part.scene())
        click.echo(f"compiled: {name}", err=True)
    click.echo(place)


@click.command()
@click.argument("pipeline", metavar="FILE_OR_NAME", shell_complete=listing.complete_pipelines)
@set_option
def check(pipeline: str, settings: tuple[str, ...]) -> None:
    """Check a pipeline file without running it.

    Every mistake in the file is shown at once, with its place. The telescope is pointed at some
    instants of the scans: whether the target is up, how near they come to the telescope's speed and
    acceleration, how many samples there are in a beam; and whether it is on the input maps. Files
    are read as a run reads them, and a run begins with the same checks.
    """
    file = load(pipeline, settings)
    from ..scene import elsewhere

    if note := elsewhere(file.scene()):
        click.echo(f"warning: {note}", err=True)
    found = file.look(say=_say if sys.stderr.isatty() else None)
    if sys.stderr.isatty():
        _say("")
    click.echo(f"{file.place}: no mistakes, {len(file.steps)} steps")
    for what, text in file.scene().instrument.notes.items():
        click.echo(f"  {what}: {text}")
    for step, lines in zip(file.steps, found, strict=True):
        click.echo(f"  {step.key}")
        for line in lines:
            click.echo(f"    {line}")
    if file.header.campaign is not None:
        from ..campaign.command import source
        from ..campaign.prepare import outline

        click.echo(outline(source(pipeline, settings, False))[0])


def _say(label: str) -> None:
    """Name the step that is looked at, on one line of the terminal."""
    click.echo(f"\r\033[K{f'checking {label}' if label else ''}", nl=False, err=True)
