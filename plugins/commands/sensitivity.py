"""``zonda sensitivity``. Only click is imported with this module."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from zonda.core.cli import listing
from zonda.core.command_options import set_option


@click.command()
@click.argument(
    "pipeline",
    metavar="[FILE_OR_NAME]",
    required=False,
    shell_complete=listing.complete_pipelines,
)
@click.option(
    "--instrument",
    metavar="NAME",
    shell_complete=listing.complete_instruments,
    help="Without a pipeline: the camera.",
)
@click.option(
    "--site",
    metavar="NAME",
    shell_complete=listing.complete_sites,
    help="Without a pipeline: where it stands.",
)
@click.option(
    "--pwv",
    metavar="PWV",
    help="Water at zenith, e.g. '1.2 mm'.  [default: the climatology's median]",
)
@click.option(
    "--month",
    type=click.IntRange(1, 12),
    metavar="1-12",
    help="Of the climatology.  [default: the present one]",
)
@click.option(
    "--quantile",
    type=float,
    metavar="SHARE",
    help="Of the PWV in that month, e.g. 0.25.",
)
@click.option(
    "--elevation",
    metavar="ANGLE",
    help="Of the target when it culminates at midnight.  [default: 60 deg]",
)
@click.option(
    "--target",
    metavar="POSITION",
    help="A position on the sky instead, observed when it culminates, or below 80 deg.",
)
@click.option(
    "--area",
    metavar="ANGLE",
    help="Diameter of the field that is scanned.  [default: two fields of view]",
)
@click.option(
    "--integration",
    metavar="TIME",
    help="Integration time, e.g. '3 h'.  [default: 1 h; of a pipeline its scans]",
)
@click.option("--time", hidden=True)
@click.option(
    "--source",
    metavar="SOURCE",
    help="S/N of a source: 'point', 'gaussian 1 arcmin' (FWHM), 'beta 1 arcmin 0.7' (core radius,"
    " beta), 'disc 30 arcsec' (diameter), or a FITS map.",
)
@click.option(
    "--peak",
    metavar="BRIGHTNESS",
    help="Of its peak as the beam sees it, e.g. '1 mJy/beam' or '200 uK_CMB'.",
)
@click.option("--flux", metavar="FLUX", help="Its flux density instead, e.g. '3 mJy'.")
@click.option(
    "--radius",
    metavar="ANGLE",
    help="Of the circle that the depth is averaged over.  [default: 0.5 arcmin or two beams]",
)
@set_option
@click.option(
    "--reach",
    metavar="DEPTH",
    help="How long it takes to reach e.g. '10 uK', '0.1 mJy/beam', or '5 sigma' of the source.",
)
@click.option(
    "--audit",
    type=click.IntRange(min=2),
    metavar="N",
    help="Simulate the pipeline with N seeds beside the forecast.",
)
@click.option(
    "--threads",
    type=click.IntRange(min=1),
    metavar="N",
    help="Threads of --audit.  [default: all]",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder for a picture, a table and the pipeline.",
)
def sensitivity(
    pipeline: str | None,
    radius: str | None,
    source: str | None,
    peak: str | None,
    flux: str | None,
    time: str | None,
    settings: tuple[str, ...],
    reach: str | None,
    audit: int | None,
    threads: int | None,
    as_json: bool,
    output: Path | None,
    **asked: Any,
) -> None:
    """Forecast how deep a map becomes, without a run: of a pipeline, or of an instrument at a site.

    The depth is the rms of the noise behind the beam, split into white noise, 1/f noise and
    atmosphere. Without a pipeline one is made: daisy scans of the area, a high-pass filter, the
    common mode; it is shown. A map of I, Q and U has a depth of each. With --source it is the
    signal-to-noise ratio of that source behind the filters.

      zonda sensitivity mustang2_cluster

      zonda sensitivity --instrument mustang2 --site green_bank --pwv '7.7 mm' --area '8 arcmin'
      --reach '20 uK'

      zonda sensitivity mustang2_cluster --source 'gaussian 1 arcmin' --peak '0.1 mJy/beam'
      --reach '5 sigma'
    """
    from zonda.core.machine import one_blas_thread

    one_blas_thread()
    from zonda.core.storage.files import check_output_folder
    from zonda.plugins.forecast import default_pipeline
    from zonda.plugins.forecast.report import SensitivityOfBands, noise_alone, report
    from zonda.plugins.forecast.sensitivity import sensitivity as forecast
    from zonda.plugins.forecast.source import OF, sigmas

    if output is not None:
        check_output_folder(output)
    if time is not None:
        asked["time"] = time  # it has another name, which the forecast tells
    about = {"radius": radius, "source": source, "peak": peak, "flux": flux}
    found = forecast(pipeline, settings=settings, **about, **asked)
    each = [*found.bands.values()] if isinstance(found, SensitivityOfBands) else [found]
    if reach is not None:
        found.reach(reach)  # what cannot be read is told before anything is simulated
    if audit is not None:
        found = found.audited(audit, threads)
        each = [*found.bands.values()] if isinstance(found, SensitivityOfBands) else [found]
    written = found.write(output) if output is not None else []
    if as_json:
        import json

        text = found.as_dict()
        if reach is not None:
            text["reach"] = {"depth": reach, "seconds": found.reach(reach)}
            if sigmas(reach):
                text["reach"] = {"sigma": sigmas(reach)}
                text["reach"] |= {f"{of}_seconds": found.reach(reach, of=of) for of in OF}
            elif planes := each[0].polarization:
                text["reach"]["stokes"] = {
                    plane: max(one.reach(reach, plane) for one in each) for plane in planes
                }
        click.echo(json.dumps(text, indent=2))
        return
    if pipeline is None:
        made = default_pipeline.text(**asked).rstrip()
        click.echo("\n".join(["# the pipeline:", made, *(f"# --set {s}" for s in settings), ""]))
    told = report(each, reach)
    for one in each:
        if one.source is None:
            told = told.replace(noise_alone(one), click.style(noise_alone(one), bold=True))
    click.echo(told)
    for path in written:
        click.echo(f"{path}")
