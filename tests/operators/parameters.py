"""Runs that differ in one parameter of one operator: whatever a parameter states must show in what
a run makes, or be refused. The cases stand beside the tests of each operator (`test_parameters.py`
of each folder).
"""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import healpy
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table

import zonda
from zonda.core.data import Data
from zonda.core.errors import ZondaError
from zonda.core.figures import Figures
from zonda.core.focalplane import Focalplane
from zonda.core.registry import operators
from zonda.operators.io.save_tod import load_tod

Changes = dict[str, tuple[dict[str, Any], dict[str, Any]]]
"""By parameter: the other parameters that the case needs, and the change."""
ALL = ("all",)
"""Every parameter of an operator that acts on polarized detectors alone."""
STREAMS = ("sky", "atmosphere", "transmission", "white", "pink", "ground", "glitches", "signal")
SCAN = {
    "scan_duration": "12 s",
    "scans": 2,
    "radius": "1 arcmin",
    "sample_rate": "50 Hz",
    "offsets": "box",
}


# ---- the run


def scene(**more: Any) -> Any:
    return zonda.Scene(
        **{
            "site": "green_bank",
            "instrument": instrument(),
            "time": "2024-11-25T07:00",
            "target": "05h +20d",
            "seed": 3,
        }
        | more
    )


class OfTwoWafers(zonda.Instrument):
    """Every second detector is on the second wafer."""

    def focalplane(self) -> Focalplane:
        plane = super().focalplane()
        plane.wafer = np.arange(len(plane)) % 2
        return plane


def instrument(
    band: Any = None, telescope: Any = None, kind: Any = zonda.Instrument, **more: Any
) -> Any:
    dish = {"name": "dish", "diameter": "100 m", "elevation_max": "88 deg"} | (telescope or {})
    values = {
        "name": "camera",
        "telescope": zonda.Telescope(**dish),
        "band": (
            None
            if "bands" in more
            else zonda.Band(**({"name": "b", "low": "78 GHz", "high": "108 GHz"} | (band or {})))
        ),
        "detectors": 19,
        "field_of_view": "2 arcmin",
        "fwhm": "8.5 arcsec",
        "main_beam_efficiency": 0.3,
        "illumination_efficiency": 0.8,
        "net": "1.7 mK s(1/2)",
        "knee": "0.5 Hz",
        "sample_rate": "50 Hz",
    }
    values |= more
    return kind(
        **{
            k: v
            for k, v in values.items()
            if v is not None or k not in ("detectors", "field_of_view")
        }
    )


def recorded(folder: Path) -> None:
    """Two saved scans, one with flags of samples and of a detector, a longer one, and a table of
    noise.
    """
    for name, seconds, seed in (("recorded", 12, 3), ("again", 12, 4), ("long", 30, 3)):
        pointing = make("PointingDaisy", **(SCAN | {"scan_duration": f"{seconds} s", "scans": 1}))
        steps = [pointing, make("WhiteNoise"), make("Efficiency"), make("SaveTOD")]
        zonda.Pipeline(steps).run(scene(seed=seed), output=folder / name, threads=1)
        shutil.copy(folder / name / "tod_scan-000.h5", folder / f"{name}.h5")
    shutil.copy(folder / "recorded.h5", folder / "flagged.h5")
    with h5py.File(folder / "flagged.h5", "r+") as file:
        file["shared/flags"][100:200] = 2
        file["detdata/flags"][3] = 4
    names = instrument().focalplane().names
    nets = np.linspace(1e-3, 3e-3, len(names))
    table = Table(
        [names, nets, np.ones(len(names)), np.ones(len(names))],
        names=["name", "net", "knee", "slope"],
    )
    table.write(folder / "noise.ecsv", format="ascii.ecsv")


def make(which: str, /, **parameters: Any) -> Any:
    return operators.get(which)(**parameters)


def outcome(steps: list[Any], where: Any, folder: Path, runs: Any = None) -> dict[str, Any]:
    """Everything that a run makes, by name."""
    keep = [
        s
        for s in (*STREAMS, "pwv", "opacity", "path_delay")
        if any(s in step.provides for step in steps)
    ]
    data = zonda.Pipeline(steps, runs=runs).run(where, keep=keep, output=folder, threads=1)
    found: dict[str, Any] = {"scans": len(data.observations)}
    for o in data.observations:
        found |= {f"{o.name} {k}": v for k, v in o.detdata.items()}
        found |= {
            f"{o.name} {k}": getattr(o, k)
            for k in ("boresight_azel", "boresight_radec", "flags", "detector_flags")
        }
        found[f"{o.name} start"] = str(o.start)
    for name, product in data.products.items():
        found[name] = contents(product)
    for path in sorted(folder.rglob("*")):
        if path.name.startswith("tod_"):
            found[path.name] = {k: (v, v.dtype.name) for k, v in load_tod(path).streams.items()}
        elif path.suffix == ".html":
            found[path.name] = re.findall(
                r"<section id=\"results\">.*?</section>", path.read_text(), re.S
            )
        elif path.suffix == ".fits":
            with fits.open(path) as file:
                found[path.name] = [
                    (h.name, h.data, h.header.get("RMSHALF")) for h in file if h.is_image
                ]
    return found


def contents(product: Any) -> Any:
    """Numbers and bytes inside a product; labels and paths are left out."""
    if dataclasses.is_dataclass(product) and not isinstance(product, type):
        fields = [
            f.name
            for f in dataclasses.fields(product)
            if f.name not in ("lock", "label", "caption", "title")
        ]
        return {f: contents(getattr(product, f)) for f in fields}
    if isinstance(product, Mapping):
        return {k: contents(v) for k, v in product.items()}
    if isinstance(product, list | tuple | Figures):
        return [contents(v) for v in product]
    if isinstance(product, np.ndarray | np.generic | bytes | int | float | str | None):
        return product
    return str(product) if type(product).__name__ == "Header" else None


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return (
            isinstance(a, np.ndarray)
            and isinstance(b, np.ndarray)
            and a.shape == b.shape
            and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        )
    return bool(a == b or (a != a and b != b))


def write_inputs(folder: Path) -> None:
    """A source and a slope, 6 arcmin wide: ``map.fits`` in K_RJ, ``flux.fits`` in Jy/pixel,
    ``hole.fits`` with a NaN.
    """
    y, x = np.indices((121, 121)) - 60.0
    values = 0.1 * np.exp(-(x**2 + y**2) / 50) + 1e-4 * x
    for name, unit in (("map", "K"), ("flux", "Jy/pixel"), ("hole", "K")):
        image = fits.PrimaryHDU(
            np.where((x == 3) & (y == 5), np.nan, values) if name == "hole" else values
        )
        image.header.update(
            CTYPE1="RA---TAN", CTYPE2="DEC--TAN", CRPIX1=61, CRPIX2=61, CRVAL1=75.0, CRVAL2=20.0
        )
        image.header.update(
            CDELT1=-3 / 3600,
            CDELT2=3 / 3600,
            CUNIT1="deg",
            CUNIT2="deg",
            RADESYS="ICRS",
            BUNIT=unit,
        )
        if unit == "K":
            image.header["TEMPSCAL"] = "K_RJ"
        image.writeto(folder / f"{name}.fits")
    header = fits.getheader(folder / "map.fits")
    fits.PrimaryHDU(np.array([values, values**2]), header).writeto(folder / "cube.fits")
    stokes = header.copy()
    stokes.update(CTYPE3="STOKES", CRPIX3=1, CRVAL3=1, CDELT3=1)
    fits.PrimaryHDU(np.array([values, values**2, values / 2]), stokes).writeto(folder / "iqu.fits")
    fits.HDUList(
        [
            fits.PrimaryHDU(),
            fits.ImageHDU(values, header),
            fits.ImageHDU(values**2, header, "SECOND"),
        ]
    ).writeto(folder / "two.fits")
    header["BUNIT"] = "Jy/beam"
    fits.PrimaryHDU(values, header).writeto(folder / "beam.fits")
    healpy.write_map(
        folder / "sphere.fits",
        np.arange(12.0 * 64**2),
        coord="C",
        column_units="uK_CMB",
        dtype=np.float64,
    )
    middle = SkyCoord(75, 20, unit="deg")
    # where the target is, if these are equatorial coordinates and if they are galactic ones
    near = [
        healpy.query_disc(8192, healpy.ang2vec(lon.deg, lat.deg, lonlat=True), np.radians(0.15))
        for lon, lat in ((middle.ra, middle.dec), (middle.galactic.l, middle.galactic.b))
    ]
    columns = [fits.Column("PIXEL", "K", array=np.concatenate(near))]
    for name, power in (("SIGNAL", 1), ("OTHER", 2)):
        columns.append(
            fits.Column(
                name, "D", unit="K_RJ", array=np.linspace(0.1, 1, sum(map(len, near))) ** power
            )
        )
    fine = fits.BinTableHDU.from_columns(columns)
    fine.header.update(
        PIXTYPE="HEALPIX",
        ORDERING="RING",
        NSIDE=8192,
        COORDSYS="C",
        INDXSCHM="EXPLICIT",
        OBJECT="PARTIAL",
    )
    fits.HDUList([fits.PrimaryHDU(), fine]).writeto(folder / "fine.fits")
    for name, minute in (("night", "00"), ("later", "05")):
        row = (
            f"2024-11-25 07:{minute}:00 | 2024-11-25 07:{minute}:30 | 0 | patch | 120 | 124 | 50 |"
            " 0 | 0"
        )
        (folder / f"{name}.txt").write_text(f"green_bank | dish | 38.4 | -79.8 | 818\n{row}\n")
    multipoles = np.arange(2, 1500)
    np.savetxt(folder / "theory.txt", np.stack([multipoles, 1e6 / multipoles], axis=1))
    np.savetxt(
        folder / "two.txt",
        np.stack(
            [multipoles, np.full(len(multipoles), 2e3), np.full(len(multipoles), 1e3)], axis=1
        ),
    )
    np.savetxt(folder / "flat.txt", np.stack([multipoles, np.full(len(multipoles), 1e3)], axis=1))
    for name, flux in (("sources", 1.0), ("others", 2.0)):
        (folder / f"{name}.csv").write_text(
            f"ra [deg],dec [deg],flux [Jy],spectral_index\n75,20,{flux},-0.7\n"
        )
    (folder / "array.csv").write_text("name,xi [arcsec],eta [arcsec]\na,0,0\nb,10,0\nc,0,20\n")
    a, b, *_ = instrument().focalplane().names
    (folder / "shares.csv").write_text(f"detector,source,share\n{a},{b},0.01\n")
    np.savetxt(folder / "band.txt", [[78, 0.2], [93, 1.0], [108, 0.5]])
    seen = Data(scene())
    operators.get("PointingStare")(scan_duration="1 s").observe(seen)
    az, el = (
        float(np.degrees(v[0]))
        for v in (seen.observations[0].azimuth, seen.observations[0].elevation)
    )
    for name, seconds in (
        ("scan", 12),
        ("other", 13),
        ("long", 30),
    ):  # to and fro about where the target stands, with a gap of 4 s
        t = np.arange(0, seconds, 0.02)
        t = t[(t < 3) | (t > 7)]
        columns = [1732518000 + t, az + 0.02 * np.sin(t), el + 0.01 * np.cos(t)]
        head = "time [s], az [deg], el [deg]"
        np.savetxt(
            folder / f"{name}.csv", np.transpose(columns), fmt="%.9f", delimiter=",", header=head
        )
        if name == "scan":
            columns.append(np.arange(t.size) // 10 % 4)  # in turn no flag, 1, 2 and both
            np.savetxt(
                folder / "flagged.csv",
                np.transpose(columns),
                fmt="%.9f",
                delimiter=",",
                header=f"{head}, flags",
            )
    recorded(folder)


SHORT: dict[str, dict[str, Any]] = {
    "SkyMap": {"file": "map.fits"},
    "AtmosphereLayers": {"pwv": "7.7 mm"},
    "BinMap": {"pixel": "4 arcsec"},
    "HighpassFilter": {"frequency": "0.1 Hz"},
    "PointingDaisy": SCAN,
}
"""Parameters of steps that stand in the chains of others."""
FILES = ("file", "schedule", "catalogue", "spectrum")


@dataclass(frozen=True)
class Step:
    """An operator in a short pipeline, and a change of each of its parameters."""

    name: str
    changes: Changes
    chain: tuple[str, ...] = ()
    """Steps behind the pointing step, this one among them; empty: this one alone."""
    given: dict[str, Any] = field(default_factory=dict)
    """Parameters that it needs in any case."""
    refused: dict[str, str] = field(default_factory=dict)
    """By parameter: what the message says where the change is refused."""
    polarized: tuple[str, ...] = ()
    """Parameters that act on polarized detectors alone."""
    ignored: tuple[dict[str, Any], ...] = ()
    """Parameters one of which would be without effect beside the others: they are refused."""

    def pipeline(self, maps: Path, /, **parameters: Any) -> list[Any]:
        """A short pipeline with this step in it."""
        own = self.name.startswith(("Pointing", "LoadTOD"))
        names = [*self.chain] if self.chain or own else [self.name]
        if own:
            names = [self.name, *names]
        elif "PointingDaisy" not in names:
            names = ["PointingDaisy", *names]
        return [self._of(name, maps, parameters if name == self.name else {}) for name in names]

    def made(self, maps: Path, parameters: dict[str, Any]) -> Any:
        """The operator with these parameters alone."""
        return make(self.name, **_with_paths(self.name, maps, self.given | parameters))

    def _of(self, name: str, maps: Path, parameters: dict[str, Any]) -> Any:
        values = SHORT.get(name, {}) | (self.given if name == self.name else {}) | parameters
        values = _with_paths(name, maps, values)
        if name == "BinMap" and "nside" in values:
            values.pop("pixel", None)
        return make(name, **values)

    def check(self, field: str, maps: Path, folder: Path, known: dict[str, Any]) -> None:
        """Compare a run with one in which a parameter is changed; ``known``: runs before the
        change, by case.
        """
        needs, change = self.changes[field]
        case = f"{self.name} {needs}"
        camera: dict[str, Any] = (
            {"telescope": {"azimuth_speed_max": "1 arcsec/s"}} if field == "check_limits" else {}
        )
        if field == "group":
            case, camera = f"{case} wafers", {"kind": OfTwoWafers}
        if self.polarized == ALL or field in self.polarized:
            case, camera = f"{case} polarized", {"polarization": "pairs", "detectors": 20}
        where = scene(instrument=instrument(**camera))
        if case not in known or field == "overwrite":
            known[case] = outcome(self.pipeline(maps, **needs), where, folder / "before")
        after = folder / ("before" if field == "overwrite" else "after")
        given = needs | change
        if field in self.refused:
            with pytest.raises(ZondaError, match=self.refused[field]):
                outcome(self.pipeline(maps, **given), where, after)
        else:
            assert not same(known[case], outcome(self.pipeline(maps, **given), where, after))


def _with_paths(name: str, maps: Path, values: dict[str, Any]) -> dict[str, Any]:
    files = (*FILES, "noise") if name == "LoadTOD" else FILES
    return values | {key: maps / values[key] for key in files if values.get(key) is not None}


def cases(steps: Iterable[Step]) -> list[Any]:
    """Parameters of a test: each parameter of each step."""
    return [
        pytest.param(step, field, id=f"{step.name}.{field}")
        for step in steps
        for field in step.changes
    ]


def ignored(steps: Iterable[Step]) -> list[Any]:
    """Parameters of a test: what each step refuses because it would be without effect."""
    return [
        pytest.param(step, given, id=f"{step.name} {' '.join(given)}")
        for step in steps
        for given in step.ignored
    ]
