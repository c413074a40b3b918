"""``zonda plan``. Only click is imported with this module."""

from __future__ import annotations

import click

from ..cli import listing
from ..command_options import drop_option, keep_option, only_option, set_option


@click.command()
@click.argument("pipeline", metavar="FILE_OR_NAME", shell_complete=listing.complete_pipelines)
@set_option
@keep_option
@drop_option
@only_option
@click.option("--no-prune", is_flag=True, help="Leave nothing out.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option(
    "--audit",
    is_flag=True,
    help="Rerun a short slice with everything on and compare; exit status 1 where a bound fails.",
)
@click.option(
    "--threads",
    type=click.IntRange(min=1),
    metavar="N",
    help="Threads of the run that is planned.  [default: all]",
)
def plan(
    pipeline: str,
    settings: tuple[str, ...],
    keep: tuple[str, ...],
    drop: tuple[str, ...],
    only: tuple[str, ...],
    no_prune: bool,
    as_json: bool,
    audit: bool,
    threads: int | None,
) -> None:
    """Show what of a scene is worth simulating, the error of leaving out the rest, and the time and
    memory of the run.

    Each effect has an upper bound on the error that its coarser form adds to the products. Coarser
    forms are taken, what saves most first, while the bounds add up to no more than the budget: a
    tenth of the noise, or the file's `budget:`. Slices of a few seconds are run to predict the
    time. `zonda run` plans scenes of 2e8 samples and more, and with --prune.
    """
    from ..machine import one_blas_thread

    one_blas_thread()
    from ..configuration.pipeline_file import load
    from .planner import plan as make
    from .structure import only as alone

    file = load(pipeline, settings)
    if file.header.campaign is not None:
        from ..campaign.command import source
        from ..campaign.prepare import outline

        text, file = outline(source(pipeline, settings, False))
        click.echo(f"{text}; the plan of the first one:", err=as_json)
    if only:
        file = alone(file, only)
    file.look()
    made = make(
        file,
        keep=keep,
        drop=drop,
        prune_all=not no_prune,
        threads=threads,
        measure=not audit,
    )
    if not audit:
        import json

        click.echo(json.dumps(made.as_dict(), indent=2) if as_json else str(made))
        return
    from .audit import audit as compare
    from .audit import audit_of_bands

    audits = compare if "" in made.bands else audit_of_bands
    found = audits(file, made, threads=threads)
    click.echo(found.json() if as_json else str(found))
    if found.violated:
        raise click.exceptions.Exit(1)
