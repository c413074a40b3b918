"""``zonda validate``: measure again what the paper that zonda follows states.

Only click is imported with this module.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zonda.core.cli.entry import clear_line

if TYPE_CHECKING:
    from .claims import Claim
    from .rows import Row

UNDECIDED = 1
"""Exit status where a claim differs and nothing explains it."""


@click.command()
@click.argument("ids", metavar="[ID]...", nargs=-1)
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    default=Path("out/validate"),
    show_default=True,
    metavar="DIR",
)
@click.option("--quick", is_flag=True, help="Closed forms and short runs alone: a minute or two.")
@click.option("--list", "listed", is_flag=True, help="List the claims and run nothing.")
@click.option(
    "--claims",
    "path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A claims file of your own.",
)
def validate(
    ids: tuple[str, ...],
    output: Path,
    quick: bool,
    listed: bool,
    path: Path | None,
) -> int:
    """Measure the claims of the paper that zonda follows, all of them or those named.

    Writes claims.html and claims.ecsv to DIR, and a folder for each claim with its values and
    pictures. What DIR holds of the same runs is not run again. Exit status 1 where a claim differs
    and no counter-experiment explains it.
    """
    from zonda.core.tables import aligned

    from .claims import SHIPPED, read

    path = SHIPPED if path is None else path
    file = read(path)
    chosen = [claim for claim in _chosen(file.claims, ids) if claim.is_quick or not quick]
    if not chosen:
        raise click.UsageError("none of these claims is a quick one: leave --quick out")
    if listed:
        listing = [(c.id, c.paper, f"{c.claim} ({c.section})") for c in chosen]
        click.echo("\n".join(aligned(listing, align="<><")))
        return 0
    from zonda.core.machine import one_blas_thread

    one_blas_thread()
    from zonda.core.storage.files import check_output_folder
    from zonda.core.storage.output_folder import lock

    from .page import summary, write
    from .rows import measured

    check_output_folder(output)
    with lock(output):
        rows = measured(chosen, output, path.parent, _say)
        write(file, rows, output)
    clear_line()
    click.echo("\n".join(aligned(map(_cells, rows), align="<<><><")))
    click.echo(f"\n{summary(rows)}\n{output}/claims.html")
    return 0 if all(row.verdict.decided for row in rows) else UNDECIDED


def _chosen(claims: list[Claim], ids: tuple[str, ...]) -> list[Claim]:
    """The claims of these names, in the order of the file; all where no name is given."""
    from zonda.core.configuration.diagnostics import nearest

    known = [claim.id for claim in claims]
    for name in ids:
        if name not in known:
            raise click.UsageError(
                f"there is no claim '{name}';"
                f" {nearest(name, known, 'zonda validate --list shows them')}"
            )
    return [claim for claim in claims if not ids or claim.id in ids]


def _cells(row: Row) -> tuple[str, ...]:
    """Cells of a line: the claim, the paper's value, zonda's value, the verdict."""
    from .page import stated

    claim = row.claim
    found = stated(row.values, claim.paper.factor, claim.paper.unit) if row.values.values else "-"
    good = row.verdict.decided
    verdict = click.style(row.verdict.value, fg="green" if good else "red", bold=not good)
    return claim.id, "paper", str(claim.paper), "zonda", found, verdict


def _say(text: str) -> None:
    """On a terminal one line that is written over; in a log a line each."""
    terminal = sys.stderr.isatty()
    click.echo(f"\r\033[K{text[:120]}" if terminal else text, nl=not terminal, err=True)
