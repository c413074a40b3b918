"""``zonda compile``. Only click is imported with this module."""

from __future__ import annotations

import click

from . import complete
from .run import load


@click.command("compile")
@click.argument("names", metavar="[FILE_OR_NAME]...", nargs=-1, shell_complete=complete.pipelines)
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
