"""``zonda check``. Only click is imported with this module."""

from __future__ import annotations

import sys

import click

from . import complete
from .run import load


@click.command()
@click.argument("pipeline", metavar="FILE_OR_NAME", shell_complete=complete.pipelines)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change one value, as for `zonda run`.",
)
def check(pipeline: str, settings: tuple[str, ...]) -> None:
    """Check a pipeline file without running it.

    Every mistake in the file is shown at once, with its place. The telescope is pointed at some
    instants of the scans: whether the target is up, how near they come to the telescope's speed and
    acceleration, how many samples there are in a beam; and whether it is on the input maps. Files
    are read by the code with which a run reads them, which begins with the same look.
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
