"""``zonda noise``: white level, knee and slope of each detector of recorded data. Only click is
imported with this module.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .arguments import checked

if TYPE_CHECKING:
    from zonda.core.types import Floats


@click.command()
@click.argument("file", type=click.Path(path_type=Path), metavar="FILE")
@click.option(
    "--signal",
    default="signal",
    show_default=True,
    metavar="NAME",
    help="Name of the stream.",
)
@click.option(
    "--segment",
    metavar="TIME",
    help="Length of the segments of Welch's method.  [default: 1/24 of the scan or less]",
)
@click.option(
    "--subtract-mean",
    is_flag=True,
    help="Subtract the mean over each band's detectors first: the atmosphere.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    metavar="TABLE",
    help="The table.  [default: FILE with .noise.ecsv]",
)
def noise(
    file: Path,
    signal: str,
    segment: str | None,
    subtract_mean: bool,
    output: Path | None,
) -> None:
    """Estimate the noise of each detector from a file of time-ordered data (HDF5 in TOAST's layout,
    FITS of SaveTOD).

    The one-sided spectrum 2 NET^2 (1 + (knee / f)^slope) is fitted to the median of the spectra of
    segments without flagged samples. The table goes into a pipeline with `LoadTOD: {file: FILE,
    noise: TABLE}`; its NET weighs the detectors in maps, and NET, knee and slope are those of a
    twin.
    """
    import numpy as np

    from zonda import __version__
    from zonda.core.configuration.units import Unit
    from zonda.core.errors import InputError
    from zonda.operators.io.noise_table import noise_of, write_noise
    from zonda.operators.noise.estimate import fit, segment_length, spectrum

    seconds = (
        checked("--segment", lambda: Unit("s", "20 s").parse(segment))
        if segment is not None
        else None
    )

    def estimate(row: Floats, good: Any, rate: float) -> Any:
        return fit(
            *spectrum(
                row,
                good,
                rate,
                segment_length(len(row), rate, seconds, f"zonda noise, {file}"),
            )
        )

    tod, found = noise_of(file, signal, estimate, subtract_mean=subtract_mean)
    made = [n for n in found.values() if n is not None]
    if not made:
        cure = "give a shorter --segment, or a stream that is not zero"
        raise InputError(
            "no detector has enough segments without flagged samples",
            place=f"zonda noise, {file}",
            cure=cure,
        )
    meta = {"zonda": __version__, "file": str(file), "observation": tod.name, "signal": signal}
    meta["mean over the detectors"] = "subtracted" if subtract_mean else "left in"
    path = write_noise(output or file.with_suffix(".noise.ecsv"), tod, found, meta)
    net, knee, slope = (
        np.array([getattr(n, name) for n in made]) for name in ("net", "knee", "slope")
    )
    click.echo(f"{len(made)} of {tod.n_detectors} detectors, {made[0].segments} segments or fewer")
    error = 1e2 * np.median([n.net_error / n.net for n in made])
    click.echo(f"NET    {_span(net * 1e3)} mK_RJ sqrt(s); standard error {error:.2g} %")
    with_knee = knee > 0
    if with_knee.any():
        error = np.median([n.knee_error for n in made if n.knee > 0])
        click.echo(
            f"knee   {_span(knee[with_knee])} Hz of {int(with_knee.sum())} detectors; standard"
            f" error {error:.2g} Hz"
        )
        error = np.median([n.slope_error for n in made if n.knee > 0])
        click.echo(f"slope  {_span(slope[with_knee])}; standard error {error:.2g}")
    else:
        click.echo(f"knee   none above {made[0].knee_error:.3g} Hz")
    if (bad := sum(n.chi_square > 2 for n in made)) > len(made) / 10:
        click.echo(
            f"warning: {bad} spectra are not of this form (chi square above 2): draw them with"
            " PowerSpectrum",
            err=True,
        )
    click.echo(str(path))


def _span(values: Floats) -> str:
    """Median and range in words."""
    import numpy as np

    return f"{np.median(values):.4g} ({values.min():.4g} to {values.max():.4g})"
