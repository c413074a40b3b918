"""``zonda compare``: two maps, or the maps of two runs, side by side in figures and pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from zonda.operators.diagnostics.comparison.files import Wanted
    from zonda.operators.diagnostics.comparison.planes import Plane
    from zonda.operators.diagnostics.comparison.statistics import Comparison, Settings

ROWS = (
    ("rms of the reference", "rms reference", "", 1.0),
    ("rms of the map", "rms map", "", 1.0),
    ("rms of the difference", "rms difference", "", 1.0),
    ("mean of the difference", "mean difference", "", 1.0),
    ("gain: map = gain x reference + offset", "gain", "gain error", 0.0),
    ("offset", "offset", "offset error", 1.0),
    ("correlation", "correlation", "", 0.0),
    ("peak of the reference", "peak reference", "", 1.0),
    ("map / reference at that pixel", "peak ratio", "", 0.0),
    (
        "median fidelity above 10 % of the peak",
        "median fidelity where the reference is above 10 % of its peak",
        "",
        0.0,
    ),
)
"""What is printed: text, figure, its error, whether it has the map's unit."""


@click.command()
@click.argument("first", metavar="REFERENCE", type=click.Path(path_type=Path))
@click.argument("second", metavar="MAP", type=click.Path(path_type=Path))
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    default=Path("out/compare"),
    show_default=True,
    metavar="DIR",
)
@click.option(
    "--unit",
    metavar="UNIT",
    help="Of the figures: mK_RJ, K_CMB, MJy/sr, Jy/beam ...  [default: that of REFERENCE]",
)
@click.option(
    "--frequency",
    metavar="FREQUENCY",
    help="For conversions, e.g. '93 GHz'.  [default: RESTFRQ of the files]",
)
@click.option(
    "--beam",
    metavar="ANGLE",
    help="Common resolution (FWHM), e.g. '20 arcsec'.  [default: the wider of the two]",
)
@click.option(
    "--sky", is_flag=True, help="REFERENCE is a sky before any beam: it gets the whole common beam."
)
@click.option(
    "--hdu",
    "hdus",
    multiple=True,
    metavar="HDU",
    help=(
        "Extension, by name or number; given twice: of REFERENCE and of MAP.  [default: the first"
        " map]"
    ),
)
@click.option(
    "--plane",
    "planes",
    multiple=True,
    metavar="N[,N]",
    help="Plane of a cube, counted from 1; given twice: of REFERENCE and of MAP.",
)
@click.option(
    "--coordsys",
    "systems",
    multiple=True,
    metavar="C|G|E",
    help="Of a HEALPix map without COORDSYS; given twice: of REFERENCE and of MAP.",
)
@click.option(
    "--threshold",
    type=click.FloatRange(0, 100, min_open=True),
    default=0.7,
    show_default=True,
    help="Least difference that the fidelity divides by, in units of the rms of the difference.",
)
@click.option(
    "--contours",
    default="-8,-4,-2,2,4",
    show_default=True,
    metavar="LEVELS",
    help="Of the signal-to-noise ratio.",
)
@click.option(
    "--format",
    "formats",
    multiple=True,
    type=click.Choice(["png", "pdf", "svg"]),
    default=("png",),
    show_default=True,
)
def compare(
    first: Path,
    second: Path,
    output: Path,
    unit: str | None,
    frequency: str | None,
    beam: str | None,
    sky: bool,
    hdus: tuple[str, ...],
    planes: tuple[str, ...],
    systems: tuple[str, ...],
    threshold: float,
    contours: str,
    formats: tuple[str, ...],
) -> None:
    """Compare a map with a reference: print figures, write pictures, FITS images and tables.

    REFERENCE and MAP are FITS files (images in any projection, or HEALPix tables), or two folders
    with the maps of runs, of which those of the same name are compared. The reference is taken to
    be without error: put the truth first. Both maps are smoothed to one beam; the one with the
    larger pixels is interpolated (cubic splines) onto the pixels of the other.

    Of maps of I, Q and U (an axis STOKES, extensions, or columns of a HEALPix table) each plane is
    compared, Q and U from the meridians of MAP's frame. Maps whose headers state different bands
    (RESTFRQ, BAND) are compared with a warning.
    """
    from zonda.core.configuration.units import Unit
    from zonda.operators.diagnostics.comparison.statistics import Settings
    from zonda.plugins.commands.arguments import checked

    fwhm = None if beam is None else checked("--beam", lambda: Unit("rad").parse(beam))
    hertz = (
        None if frequency is None else checked("--frequency", lambda: Unit("Hz").parse(frequency))
    )
    levels, choices = _levels(contours), _choices(hdus, planes, systems)
    for name, one, other in pairs(first, second):
        folder = output / name if name else output
        _compare(
            (one, other),
            folder,
            Settings(fwhm, threshold),
            (unit, hertz, sky),
            (levels, formats),
            choices,
        )


def pairs(first: Path, second: Path) -> list[tuple[str, Path, Path]]:
    """(subfolder, reference, map) of each comparison. Raises InputError where folders have no map
    in common.
    """
    from zonda.core.errors import InputError

    folders = [path.is_dir() for path in (first, second)]
    if folders == [False, False]:
        return [("", first, second)]
    if not all(folders):
        folder, file = (first, second) if folders[0] else (second, first)
        return [("", *((folder / "map.fits", file) if folders[0] else (file, folder / "map.fits")))]
    names = [
        {p.name for p in folder.glob("*.fits") if not _is_comparison(p)}
        for folder in (first, second)
    ]
    both = sorted(names[0] & names[1])
    if not both:
        found = [", ".join(sorted(n)) or "none" for n in names]
        cure = "give the folders of two runs that saved their maps (SaveMap), or two files"
        raise InputError(
            f"no map has the same name in both (*.fits: {found[0]}; {found[1]})",
            place=f"{first}, {second}",
            cure=cure,
        )
    single = len(both) == 1
    return [("" if single else Path(name).stem, first / name, second / name) for name in both]


def _is_comparison(path: Path) -> bool:
    """True for a FITS file that `write_comparison` wrote."""
    with open(path, "rb") as file:
        return b"REFERENC=" in file.read(10 * 2880)


def _levels(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(level) for level in text.split(",") if level.strip())
    except ValueError:
        raise click.BadParameter(
            f"'{text}' is not a list of numbers, e.g. -4,-2,2,4", param_hint="'--contours'"
        ) from None


def _compare(
    paths: tuple[Path, Path],
    folder: Path,
    settings: Settings,
    given: tuple[str | None, float | None, bool],
    look: tuple[tuple[float, ...], tuple[str, ...]],
    choices: tuple[Wanted, Wanted],
) -> None:
    """One comparison, printed and written to ``folder``. ``given``: unit, frequency [Hz], whether
    the reference is a sky.

    ``choices``: what to read of the two files.
    """
    from zonda.core.storage.files import atomic_path
    from zonda.operators.diagnostics.comparison import statistics
    from zonda.operators.diagnostics.comparison.files import read_planes, write_comparison
    from zonda.operators.diagnostics.comparison.planes import common_beam
    from zonda.operators.diagnostics.comparison.stokes import on_meridians_of
    from zonda.operators.diagnostics.drawing.comparison_plots import draw_comparison
    from zonda.operators.diagnostics.drawing.pictures import Style
    from zonda.operators.diagnostics.series import plane_key

    read = [
        read_planes(path, _name(path, paths), wanted)
        for path, wanted in zip(paths, choices, strict=True)
    ]
    if not read[0].is_of_the_band_of(read[1]):
        both_bands = " and ".join(
            f"{_name(path, paths)} of {one.band_in_words}"
            for path, one in zip(paths, read, strict=True)
        )
        click.echo(
            f"warning: the maps are of different bands, {both_bands}: the sky itself differs"
            " between them",
            err=True,
        )
    maps = read[1].planes
    references = on_meridians_of(maps["I"], read[0].planes)
    both, written = [plane for plane in maps if plane in references], []
    levels, formats = look
    style = Style(0.0, 0.0, 0.0, levels, formats)
    for plane in both:
        sky = replace(references[plane], fwhm=0.0) if given[2] else references[plane]
        beam = settings.fwhm or common_beam(sky, maps[plane])
        hertz = given[1] or read[0].frequency or read[1].frequency
        one, other = _in_one_unit(references[plane], maps[plane], given[0], hertz, beam)
        one = replace(one, fwhm=sky.fwhm)
        found = statistics.compare(one, other, settings)
        click.echo(
            "\n".join(
                [
                    *([f"Stokes {plane}"] if len(both) > 1 else []),
                    *lines(found),
                    *([""] if len(both) > 1 else []),
                ]
            )
        )
        name = plane_key("comparison", plane)
        written += write_comparison(found, folder / name, {})
        for picture in map(style.printed, draw_comparison(name, found, levels)):
            for kind, content in picture.files.items():
                path = folder / f"{picture.name}.{kind}"
                with atomic_path(path) as temporary:
                    temporary.write_bytes(content)
                written.append(path)
    told = [f"{path}: {note}" for path, one in zip(paths, read, strict=True) for note in one.notes]
    for note in [
        *told,
        *(_without(references, maps, paths) if not any("Q and U" in note for note in told) else []),
    ]:
        click.echo(note)
    click.echo("\n" + "\n".join(map(str, written)))


def _without(
    references: Mapping[str, Plane], maps: Mapping[str, Plane], paths: tuple[Path, Path]
) -> list[str]:
    """Says that one of two files has no Q and U, where the other has."""
    if references.keys() == maps.keys():
        return []
    return [f"Q and U: not compared: {_name(paths['Q' in references], paths)} has none"]


def _choices(
    hdus: tuple[str, ...], planes: tuple[str, ...], systems: tuple[str, ...]
) -> tuple[Wanted, Wanted]:
    """Planes of the reference and of the map to read. Raises BadParameter for more than two, or for
    a name that is no plane.
    """
    from zonda.operators.diagnostics.comparison.files import Wanted

    pairs = []
    for name, given in (("--hdu", hdus), ("--plane", planes), ("--coordsys", systems)):
        if len(given) > 2:
            raise click.BadParameter(
                "is given more than twice: there are two maps", param_hint=f"'{name}'"
            )
        pairs.append((given * 2)[:2] if given else (None, None))
    numbers = []
    for text in pairs[1]:
        try:
            numbers.append(None if text is None else tuple(int(n) for n in text.split(",")))
        except ValueError:
            raise click.BadParameter(
                f"'{text}' is not a number, or numbers with commas: 2 or 1,3",
                param_hint="'--plane'",
            ) from None
    once = max(len(planes), len(systems)) < 2
    first, second = (Wanted(pairs[0][k], numbers[k], pairs[2][k], once) for k in (0, 1))
    return first, second


def _name(path: Path, paths: tuple[Path, Path]) -> str:
    """Short enough for a picture, and different for the two."""
    return path.name if paths[0].name != paths[1].name else f"{path.parent.name or '.'}/{path.name}"


def _in_one_unit(
    reference: Plane, other: Plane, unit: str | None, frequency: float | None, beam: float
) -> tuple[Plane, Plane]:
    """Convert both maps to ``unit``, or to that of the reference: to brightness if that is per
    pixel, per common ``beam`` [rad] if it is per beam.
    """
    from zonda.core.errors import InputError
    from zonda.operators.diagnostics.comparison.files import in_unit

    if unit is None and not (reference.unit and other.unit) and reference.unit != other.unit:
        bare = other if reference.unit else reference
        known = reference.unit or other.unit
        raise InputError(
            f"has no unit, and the other map is in {known}",
            place=bare.name,
            cure="set its header key BUNIT to what it is in",
        )
    wanted = unit or ("MJy/sr" if reference.unit == "Jy/pixel" else reference.unit)
    per_beam = (
        unit is None
        and wanted == reference.unit == other.unit == "Jy/beam"
        and not (reference.fwhm and other.fwhm)
    )
    if per_beam and beam <= max(reference.fwhm or 0.0, other.fwhm or 0.0):
        return reference, other  # a beam is not known, so that nothing is smoothed
    return (
        (in_unit(reference, wanted, frequency, beam), in_unit(other, wanted, frequency, beam))
        if wanted
        else (reference, other)
    )


def lines(found: Comparison) -> list[str]:
    """The table as text."""
    from zonda.core.numerics.angles import angle_text
    from zonda.core.tables import aligned

    f, (first, second) = found.figures, found.names
    factor, unit = _readable(f["rms reference"], found.unit)
    rows: list[tuple[str, str]] = [("reference", first), ("map", second)]
    rows.append(("pixels with both", f"{f['pixels']:.0f} of {angle_text(found.pixel)}"))
    rows.append(("resolution (FWHM)", angle_text(found.fwhm) if found.fwhm else "not known"))
    for text, key, error, has_unit in ROWS:
        scale = factor if has_unit else 1.0
        value = f"{f[key] * scale:.5g}" + (
            f" +- {f[error] * scale:.2g}" if error and math.isfinite(f[error]) else ""
        )
        rows.append((text, value + (f" {unit}" if has_unit and unit else "")))
    if "chi2" in f:
        scatter = math.sqrt(2 / f["chi2 values"]) if f["chi2 values"] else math.nan
        rows.append(
            (
                "chi2 of the difference / pixels",
                f"{f['chi2']:.5g} / {f['chi2 pixels']:.0f} = {_ratio(f):.4g} +- {scatter:.2g}",
            )
        )
    return [*aligned(rows), "", *found.notes]


def _ratio(figures: dict[str, Any]) -> float:
    return float(figures["chi2"] / figures["chi2 pixels"]) if figures["chi2 pixels"] else math.nan


def _readable(size: float, unit: str) -> tuple[float, str]:
    """Factor and name of the unit in which an rms of ``size`` reads well; kelvins only."""
    if unit in ("K_RJ", "K_CMB"):
        for factor, prefix in ((1e6, "u"), (1e3, "m")):
            if abs(size) * factor < 1e3:
                return factor, prefix + unit
    return 1.0, unit
