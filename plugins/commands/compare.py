"""``zonda compare``: two maps, or the maps of two runs, side by side in figures and pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from zonda.operators.diagnostics.comparison.planes import Plane
    from zonda.operators.diagnostics.comparison.statistics import Comparison

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


def _levels(_context: Any, _option: Any, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(level) for level in text.split(",") if level.strip())
    except ValueError:
        raise click.BadParameter(f"'{text}' is not a list of numbers, e.g. -4,-2,2,4") from None


def _of_both(_context: Any, option: Any, given: tuple[str, ...]) -> Any:
    """Values of an option for the reference and for the map; True where it is given twice."""
    if len(given) > 2:
        raise click.BadParameter("is given more than twice: there are two maps")
    read = tuple(map(_numbers if option.name == "planes" else str, given))
    first, second = (read * 2)[:2] if read else (None, None)
    return first, second, len(given) > 1


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(n) for n in text.split(","))
    except ValueError:
        raise click.BadParameter(
            f"'{text}' is not a number, or numbers with commas: 2 or 1,3"
        ) from None


def _quantity(unit: str) -> Any:
    """Callback that reads an option in a unit."""

    def read(_context: Any, option: Any, text: str | None) -> float | None:
        from zonda.core.configuration.units import Unit
        from zonda.plugins.commands.arguments import checked

        return None if text is None else checked(option.opts[0], lambda: Unit(unit).parse(text))

    return read


def _twice(flag: str, name: str, metavar: str, text: str) -> Any:
    """Option that may be given for each of the two maps."""
    return click.option(flag, name, multiple=True, callback=_of_both, metavar=metavar, help=text)


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
    callback=_quantity("Hz"),
    metavar="FREQUENCY",
    help="For conversions, e.g. '93 GHz'.  [default: RESTFRQ of the files]",
)
@click.option(
    "--beam",
    callback=_quantity("rad"),
    metavar="ANGLE",
    help="Common resolution (FWHM), e.g. '20 arcsec'.  [default: the wider of the two]",
)
@click.option(
    "--sky",
    is_flag=True,
    help="REFERENCE is a sky before any beam: it gets the whole common beam.",
)
@click.option(
    "--aperture",
    "apertures",
    multiple=True,
    callback=lambda *given: tuple(_quantity("rad")(*given[:2], text) for text in given[2]),
    metavar="RADIUS",
    help="Fluxes within this radius of the centre, e.g. '30 arcsec'; may be given several times.",
)
@_twice(
    "--hdu",
    "hdus",
    "HDU",
    "Extension, by name or number; given twice: of REFERENCE and of MAP.  [default: the first map]",
)
@_twice(
    "--plane",
    "planes",
    "N[,N]",
    "Plane of a cube, counted from 1; given twice: of REFERENCE and of MAP.",
)
@_twice(
    "--coordsys",
    "systems",
    "C|G|E",
    "Of a HEALPix map without COORDSYS; given twice: of REFERENCE and of MAP.",
)
@_twice(
    "--column",
    "columns",
    "COLUMN",
    "Of a HEALPix map, by name or number; given twice: of REFERENCE and of MAP.",
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
    callback=_levels,
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
def compare(first: Path, second: Path, output: Path, **options: Any) -> None:
    """Compare a map with a reference: print figures, write pictures, FITS images and tables.

    REFERENCE and MAP are FITS files (images in any projection, or HEALPix tables), or two folders
    with the maps of runs, of which those of the same name are compared. The reference is taken to
    be without error: put the truth first. Both maps are smoothed to one beam; the one with the
    larger pixels is interpolated (cubic splines) onto the pixels of the other.

    Of maps of I, Q and U (an axis STOKES, extensions, or columns of a HEALPix table) each plane is
    compared, Q and U from the meridians of MAP's frame. Maps whose headers state different bands
    (RESTFRQ, BAND) are compared with a warning.
    """
    for name, one, other in pairs(first, second):
        _compare((one, other), output / name, **options)


def pairs(first: Path, second: Path) -> list[tuple[str, Path, Path]]:
    """(subfolder, reference, map) of each comparison. Raises InputError where folders have no map
    in common.
    """
    from zonda.core.errors import InputError

    if first.is_dir() and second.is_dir():
        names = [
            {p.name for p in folder.glob("*.fits") if not _is_comparison(p)}
            for folder in (first, second)
        ]
        both = sorted(names[0] & names[1])
        if not both:
            found = "; ".join(", ".join(sorted(n)) or "none" for n in names)
            raise InputError(
                f"no map has the same name in both (*.fits: {found})",
                place=f"{first}, {second}",
                cure="give the folders of two runs that saved their maps (SaveMap), or two files",
            )
        return [
            (Path(name).stem if len(both) > 1 else "", first / name, second / name) for name in both
        ]
    one, other = (path / "map.fits" if path.is_dir() else path for path in (first, second))
    return [("", one, other)]


def _is_comparison(path: Path) -> bool:
    """True for a FITS file that `write_comparison` wrote."""
    with open(path, "rb") as file:
        return b"REFERENC=" in file.read(10 * 2880)


def _compare(
    paths: tuple[Path, Path],
    folder: Path,
    *,
    unit: str | None,
    frequency: float | None,
    beam: float | None,
    sky: bool,
    hdus: Any,
    planes: Any,
    systems: Any,
    columns: Any,
    threshold: float,
    contours: tuple[float, ...],
    formats: tuple[str, ...],
    apertures: tuple[float, ...],
) -> None:
    """One comparison, printed and written to ``folder``."""
    from zonda.core.errors import InputError
    from zonda.core.maps.read_map import read_map
    from zonda.operators.diagnostics.compare_maps import template_rows
    from zonda.operators.diagnostics.comparison import statistics
    from zonda.operators.diagnostics.comparison.files import (
        Wanted,
        on_meridians_of,
        read_planes,
        write_comparison,
    )
    from zonda.operators.diagnostics.comparison.planes import common_beam
    from zonda.operators.diagnostics.comparison_plots import draw_comparison
    from zonda.operators.diagnostics.plot_operators import Plots
    from zonda.operators.diagnostics.series import plane_key

    shared = not (planes[2] or systems[2] or columns[2])
    read = [
        read_planes(
            path,
            _name(path, paths),
            Wanted(hdus[k], planes[k], systems[k], columns[k], shared),
        )
        for k, path in enumerate(paths)
    ]
    tables = [one.planes["I"].pixels is not None for one in read]
    cubes = [note for one in read for note in one.notes if note.startswith("plane: ")]
    for flag, given, there in (
        ("plane", planes[0] if shared else None, bool(cubes)),
        ("coordsys", systems[0] if shared else None, any(tables)),
        ("column", columns[0] if shared else None, any(tables)),
    ):
        if given is not None and not there:
            what = "a cube" if flag == "plane" else "a HEALPix table"
            cure = f"leave --{flag} out"
            raise InputError(f"neither of the maps is {what}", place=f"--{flag}", cure=cure)
    names = [_name(path, paths) for path in paths]
    if not read[0].is_of_the_band_of(read[1]):
        bands = " and ".join(
            f"{name} of {one.band_in_words}" for name, one in zip(names, read, strict=True)
        )
        what = "the sky itself differs between them"
        click.echo(f"warning: the maps are of different bands, {bands}: {what}", err=True)
    maps = read[1].planes
    references = on_meridians_of(maps["I"], read[0].planes)
    both = [plane for plane in maps if plane in references]
    written = []
    matched: list[tuple[str, str]] = []
    with suppress(InputError):
        matched = template_rows(*map(read_map, paths)) if all(one.own for one in read) else []
    hertz = frequency or read[0].frequency or read[1].frequency
    for plane in both:
        one = references[plane]
        fwhm = 0.0 if sky else one.fwhm
        common = beam or common_beam(replace(one, fwhm=fwhm), maps[plane])
        one, other = _in_one_unit(one, maps[plane], unit, hertz, common)
        both_of = replace(one, fwhm=fwhm), other
        found = statistics.compare(*both_of, beam, threshold, apertures=apertures)
        more = [*fluxes(found, apertures, other, hertz), *(matched if plane == "I" else ())]
        text = "\n".join(lines(found, more))
        click.echo(f"Stokes {plane}\n{text}\n" if len(both) > 1 else text)
        name = plane_key("comparison", plane)
        written += write_comparison(found, folder / name, {})
        plots = Plots(formats=list(formats))
        for sketch in draw_comparison(name, found, contours):
            written += plots.printed(sketch).write(folder)
    notes = [f"{path}: {note}" for path, one in zip(paths, read, strict=True) for note in one.notes]
    if references.keys() != maps.keys() and not any("Q and U" in note for note in notes):
        notes.append(f"Q and U: not compared: {names['Q' in references]} has none")
    click.echo("\n".join([*notes, "", *map(str, written)]))


def _name(path: Path, paths: tuple[Path, Path]) -> str:
    """Short enough for a picture, and different for the two."""
    return path.name if paths[0].name != paths[1].name else f"{path.parent.name or '.'}/{path.name}"


def _in_one_unit(
    reference: Plane,
    other: Plane,
    unit: str | None,
    frequency: float | None,
    beam: float,
) -> tuple[Plane, Plane]:
    """Convert both maps to ``unit``, or to that of the reference: to brightness if that is per
    pixel, per common ``beam`` [rad] if it is per beam.
    """
    from zonda.core.errors import InputError
    from zonda.operators.diagnostics.comparison.files import in_unit

    both = reference, other
    if unit is None and bool(reference.unit) != bool(other.unit):
        bare, known = both if other.unit else both[::-1]
        raise InputError(
            f"has no unit, and the other map is in {known.unit}",
            place=bare.name,
            cure="set its header key BUNIT to what it is in",
        )
    wanted = unit or ("MJy/sr" if reference.unit == "Jy/pixel" else reference.unit)
    beams = [plane.fwhm or 0.0 for plane in both]
    per_beam = unit is None and wanted == reference.unit == other.unit == "Jy/beam"
    if not wanted or (per_beam and min(beams) == 0 and beam <= max(beams)):
        return both  # a beam is not known, so that nothing is smoothed
    first, second = (in_unit(plane, wanted, frequency, beam) for plane in both)
    return first, second


def fluxes(
    found: Comparison,
    apertures: tuple[float, ...],
    plane: Plane,
    hertz: float | None,
) -> list[tuple[str, str]]:
    """Rows of the table about apertures: fluxes in Jy where the frequency is known, and their
    ratio.
    """
    import numpy as np

    from zonda.core.errors import InputError
    from zonda.core.maps.units import parse_unit
    from zonda.core.numerics.sphere import angle_text
    from zonda.operators.diagnostics.comparison.files import in_unit

    rows = []
    jansky = math.nan
    try:
        unit, size = parse_unit(plane.unit, place=plane.name)
        alone: Any = {"values": np.full((), size), "noise": None, "alone": None}
        one = replace(plane, unit=unit, fwhm=found.fwhm or None, **alone)
        jansky = 1e6 * float(in_unit(one, "MJy/sr", hertz).values)
    except InputError:  # ratios are known without
        pass
    for radius in apertures:
        of, seen = (found.values[f"{name} within {radius!r}"] for name in ("reference", "map"))
        text = f"{seen / of:.5g}" if of else "none in the reference"
        if not math.isfinite(seen):
            text = "not known: less than 95 % of the circle is in both maps"
        elif math.isfinite(jansky):
            text += f" ({seen * jansky:.5g} / {of * jansky:.5g} Jy)"
        rows.append((f"flux of map / reference within {angle_text(radius)}", text))
    return rows


def lines(found: Comparison, more: Sequence[tuple[str, str]] = ()) -> list[str]:
    """The table as text, with ``more`` rows."""
    from zonda.core.numerics.sphere import angle_text
    from zonda.core.tables import aligned

    f = found.values
    factor, unit = _readable(f["rms reference"], found.unit)
    rows = [
        ("reference", found.names[0]),
        ("map", found.names[1]),
        ("pixels with both", f"{f['pixels']:.0f} of {angle_text(found.pixel)}"),
        ("resolution (FWHM)", angle_text(found.fwhm) if found.fwhm else "not known"),
    ]
    for text, key, error, has_unit in ROWS:
        scale = factor if has_unit else 1.0
        value = f"{f[key] * scale:.5g}"
        if error and math.isfinite(f[error]):
            value += f" +- {f[error] * scale:.2g}"
        rows.append((text, f"{value} {unit}".rstrip() if has_unit else value))
    if "chi2" in f:
        ratio = f["chi2"] / f["chi2 pixels"] if f["chi2 pixels"] else math.nan
        scatter = math.sqrt(2 / f["chi2 values"]) if f["chi2 values"] else math.nan
        text = f"{f['chi2']:.5g} / {f['chi2 pixels']:.0f} = {ratio:.4g} +- {scatter:.2g}"
        rows.append(("chi2 of the difference / pixels", text))
    return [*aligned([*rows, *more]), "", *found.notes]


def _readable(size: float, unit: str) -> tuple[float, str]:
    """Factor and name of the unit in which an rms of ``size`` reads well; kelvins only."""
    for factor, prefix in ((1e6, "u"), (1e3, "m")) if unit in ("K_RJ", "K_CMB") else ():
        if abs(size) * factor < 1e3:
            return factor, prefix + unit
    return 1.0, unit
