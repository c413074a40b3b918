"""``zonda doctor``: self-test of numerical accuracy on this machine.

Only click is imported with this module.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from zonda.core.checks import Result


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def doctor(as_json: bool) -> None:
    """Self-test of numerical accuracy on this machine.

    Checks the arithmetic, libraries and compiled code of this machine, in about half a minute,
    against references and limits; all rows of the stability matrix are in docs/stability.md. Exit
    status 1 if a figure exceeds its limit. The first run after installation also compiles, which
    takes a minute.
    """
    from zonda.core.machine import one_blas_thread

    one_blas_thread()
    from zonda.core.checks import measure, registered
    from zonda.core.tables import aligned
    from zonda.plugins.checks.machine import description
    from zonda.plugins.checks.scenes import MACHINE

    chosen = sorted(
        registered(),
        key=lambda check: check.case is not MACHINE,
    )  # the others depend on the machine: it comes first
    about = description()
    results: list[Result] = []
    if not as_json:
        click.echo("\n".join([*aligned(about.items()), ""]))
        width = max(len(check.name) for check in chosen)
    for result in measure(chosen):
        results.append(result)
        if not as_json:
            click.echo(_line(result, width))
    failed = [r for r in results if not r.passed]
    seconds = sum(r.seconds for r in results)
    if as_json:
        import json

        summary = {
            "machine": about,
            "passed": not failed,
            "seconds": round(seconds, 2),
            "checks": [_row(r) for r in results],
        }
        click.echo(json.dumps(summary, indent=2, allow_nan=False))
    else:
        click.echo(f"\n{len(results)} checks in {seconds:.0f} s, {len(failed)} beyond their limits")
        for r in failed:
            click.echo(
                f"\n{r.check.name}: {r.check.what}\n  against {r.check.reference}\n  {r.reached},"
                f" accepted: {r.accepted}"
            )
    if failed:
        raise click.exceptions.Exit(1)


def _line(result: Result, width: int) -> str:
    mark = (
        click.style("ok  ", fg="green")
        if result.passed
        else click.style("FAIL", fg="red", bold=True)
    )
    remark = f"  ({result.remark})" if result.remark else ""
    return f"{mark} {result.check.name.ljust(width)}  {result.reached} <= {result.accepted}{remark}"


def _row(result: Result) -> dict[str, Any]:
    import math

    check = result.check
    return {
        "name": check.name,
        "case": check.case.text,
        "what": check.what,
        "reference": check.reference,
        "limit": check.limit,
        "figure": result.figure if math.isfinite(result.figure) else None,
        "unit": check.unit,
        "passed": result.passed,
        "remark": result.remark,
        "seconds": round(result.seconds, 3),
    }
