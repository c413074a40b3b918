"""``zonda run``. Only click is imported with this module."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..command_types import RunRequest, Share, on_engine
from . import complete

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
    shell_complete=complete.pipelines,
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change one value, e.g. Step.parameter='0.5 Hz' or seed=8.",
)
@click.option(
    "--keep",
    multiple=True,
    metavar="NAME",
    help="Simulate this effect or operator in full, see `zonda plan`.",
)
@click.option(
    "--drop",
    multiple=True,
    metavar="NAME",
    help="Leave this effect or operator out, whatever that costs.",
)
@click.option(
    "--only", multiple=True, metavar="COMPONENT", help="Simulate this component (e.g. sky) alone."
)
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
    from ..storage.lock import lock

    pipeline, settings = request.pipelines[0], request.settings
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
    whole, file = len(file.steps), made.apply(file)
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
    file: PipelineFile, request: RunRequest, settings: tuple[str, ...], data: Data | None
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
        f"error of {metric} against the tightest knobs: {100 * error:.2g} %{each}{wanted}", err=True
    )
