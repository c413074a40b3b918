"""``zonda accuracy``: error against CPU time for the user's own pipeline and metric. Imports click
alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..cli import listing
from ..command_options import set_option

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile

NOT_MET = 1
"""Exit status if no setting meets the target, or a stored Pareto front does not hold any more."""


@click.command()
@click.argument("pipeline", metavar="FILE_OR_NAME", shell_complete=listing.complete_pipelines)
@click.option(
    "--metric",
    default="map_rms",
    show_default=True,
    metavar="NAME",
    help=(
        "map_rms, peak, transfer, psd, structure; a figure, e.g. 'central_rms(radius=30 arcsec)';"
        " or a plugin's."
    ),
)
@click.option(
    "--target",
    default="1 %",
    show_default=True,
    metavar="ERROR",
    help="Error that the metric may have.",
)
@set_option
@click.option(
    "--knob",
    "knobs",
    multiple=True,
    metavar="NAME",
    help="Turn only this one, e.g. Step.parameter; may be repeated.",
)
@click.option("--quick", is_flag=True, help="Shorten the scans to at most two of 30 s.")
@click.option("--duration", metavar="TIME", help="Length of each scan, e.g. '2 min'.")
@click.option(
    "--repeats",
    default=1,
    show_default=True,
    type=click.IntRange(1, 100),
    help="Timed runs of each setting.",
)
@click.option(
    "--seeds",
    default=2,
    show_default=True,
    type=click.IntRange(1, 1000),
    help="For scatter, and knobs that redraw.",
)
@click.option(
    "--budget",
    default=30,
    show_default=True,
    type=click.IntRange(2),
    metavar="RUNS",
    help="Largest number of runs, and of their CPU time in units of one run.",
)
@click.option(
    "--threads",
    default=1,
    show_default=True,
    type=click.IntRange(min=1),
    metavar="N",
    help="Threads of each run.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder.  [default: out/accuracy/NAME.METRIC]",
)
@click.option(
    "--store",
    is_flag=True,
    help="Keep the Pareto front beside the pipeline file, for `accuracy: 1 %` in it.",
)
@click.option(
    "--check",
    "check",
    is_flag=True,
    help="Measure the errors of the stored Pareto front again; exit status 1 where one grew.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of tables.")
def accuracy(
    pipeline: str,
    metric: str,
    target: str,
    settings: tuple[str, ...],
    knobs: tuple[str, ...],
    quick: bool,
    duration: str | None,
    repeats: int,
    seeds: int,
    budget: int,
    threads: int,
    output: Path | None,
    store: bool,
    check: bool,
    as_json: bool,
) -> int:
    """Show what accuracy costs in time: error against CPU seconds and memory.

    Every knob that the pipeline's operators declare is turned alone and jointly, with the same
    random numbers, and compared with all knobs at their tightest. Prints the tables, draws the
    work-precision diagram and writes the setting that meets the target at least cost. Ctrl-C ends
    it with the Pareto front found so far.
    """
    from ..campaign.campaign_file import plural
    from ..configuration.pipeline_file import load
    from ..experiment.engines import engine
    from .bench import Setup
    from .metrics import get
    from .pareto import most_runs, study
    from .settings import knobs_of, shortened

    file = load(pipeline, settings)
    get(metric)
    file.look(saved=False)
    wanted = _fraction(target)
    if check:
        return _retest(file, pipeline, metric)
    turned = knobs_of(file, knobs)
    numbers = tuple(file.scene().seed + k for k in range(seeds))
    shorter = shortened(file, duration, quick)
    from ..storage.files import check_output_folder, product_path, write_text

    folder = (
        product_path("out/accuracy", f"{file.header.name}.{metric}") if output is None else output
    )
    check_output_folder(folder)
    setup = Setup(pipeline, settings, metric, wanted, shorter, repeats, numbers, threads, budget)
    with engine("processes", workers=1, threads=threads) as pool:
        _say(
            f"{metric} of {file.header.name}: {plural(len(turned), 'knob')}, at most"
            f" {most_runs(setup, turned)} runs (--budget {budget}) after a first one that compiles"
        )
        found = study(file, setup, turned, pool, say=_say)
        if found.interrupted:
            pool.stop()

    from . import fronts as stored
    from .report import fragment, lines, not_met, percent, save

    text = "\n".join(lines(found))
    if found.interrupted:
        click.echo(text)
        raise KeyboardInterrupt
    write_text(folder / "accuracy.txt", text + "\n")
    stored.save(found, file, folder / "front.json")
    save(found, folder / "work_precision.png")
    if found.chosen:
        heading = (
            f"{file.header.name}: {metric} within {percent(found.chosen.error + found.sweep.left)},"
            " measured by zonda accuracy"
        )
        write_text(folder / "fragment.yaml", fragment(found.chosen.setting, heading))
    if as_json:
        import json

        click.echo(json.dumps(stored.as_json(found, file), indent=2))
        if not found.chosen:
            click.echo("\n".join(not_met(found)), err=True)
    else:
        click.echo(text)
        click.echo(f"\n{folder}/")
    if store:
        click.echo(f"stored: {stored.save(found, file)}", err=as_json)
    return 0 if found.chosen else NOT_MET


def _retest(file: PipelineFile, pipeline: str, metric: str) -> int:
    from .fronts import path_for, read, retest
    from .report import percent
    from .settings import overrides

    results = retest(read(path_for(file, metric)), file, pipeline)
    for result in results:
        verdict = "ok" if result.good else "GREW"
        click.echo(
            f"{verdict:>4}  {percent(result.stored):>9} -> {percent(result.now):>9} "
            f" {' '.join(overrides(result.setting))}"
        )
    return 0 if all(r.good for r in results) else NOT_MET


def _fraction(text: str) -> float:
    from pydantic_core import PydanticCustomError

    from ..configuration.units import Unit

    try:
        return Unit("").parse(text)
    except (PydanticCustomError, ValueError) as err:
        message = (
            err.message()
            if isinstance(err, PydanticCustomError)
            else f"expected a fraction such as '1 %', got {text!r}"
        )
        raise click.BadParameter(message, param_hint="--target") from None


def _say(what: str) -> None:
    click.echo(what, err=True)
