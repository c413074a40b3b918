"""No parameter is accepted and then ignored.

Every field of every operator, noise model, instrument, telescope, band, site and scene is changed
alone: the streams, pointing or products of a short run change with it, or the run is refused with a
message. What is only said about a run (tally, labels) does not count as a change.
"""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import healpy
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

import zonda
from zonda.core.data import Data
from zonda.core.errors import ZondaError
from zonda.core.figures import Figures
from zonda.core.focalplane import Focalplane
from zonda.core.registry import noise_models, operators
from zonda.core.site import Site
from zonda.operators.io.save_tod import load_tod

STREAMS = ("sky", "atmosphere", "transmission", "white", "pink", "ground", "glitches", "signal")
SCAN = {
    "scan_duration": "12 s",
    "scans": 2,
    "radius": "1 arcmin",
    "sample_rate": "50 Hz",
    "offsets": "box",
}
TURN = {
    "scan_duration": "40 s",
    "throw": "4 arcmin",
    "speed": "30 arcsec/s",
    "acceleration": "20 arcsec/s2",
}
REFUSED = "refused"


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


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A source and a slope, 6 arcmin wide: ``map.fits`` in K_RJ, ``flux.fits`` in Jy/pixel,
    ``hole.fits`` with a NaN.
    """
    folder = tmp_path_factory.mktemp("maps")
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
    return folder


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


# ---- operators: (other parameters that the case needs, the change)


def tangent(pixel: float) -> WCS:
    """About the scene's target, pixels in arcsec."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = (
        ["RA---TAN", "DEC--TAN"],
        [75.0, 20.0],
        [32.5, 32.5],
    )
    wcs.wcs.cdelt = [-pixel / 3600, pixel / 3600]
    return wcs


ARRAY: dict[str, Any] = {
    "file": None,
    "map": np.hypot(*np.indices((64, 64)) - 31.5) / 1e3,
    "wcs": tangent(3.0),
    "unit": "K_RJ",
}
"""A map that is no file."""

POINTING = {
    "target": ({}, {"target": "05h00m10s +20d00m00s"}),
    "targets": ({}, {"targets": ["05h00m00s +20d00m00s", "05h00m10s +20d00m00s"]}),
    "scan_duration": ({}, {"scan_duration": "14 s"}),
    "scans": ({}, {"scans": 3}),
    "gap": ({"scans": 2}, {"gap": "60 s"}),
    "offsets": ({"offsets": "none"}, {"offsets": "box"}),
    "offset_size": ({"offsets": "box"}, {"offset_size": "30 arcsec"}),
    "sample_rate": ({}, {"sample_rate": "40 Hz"}),
    "interpolation_error": ({"scan_duration": "30 s"}, {"interpolation_error": 1e-9}),
    "jitter": ({}, {"jitter": "1 ms"}),
    "check_limits": ({"check_limits": "warn"}, {"check_limits": "error"}),
}

CASES: dict[str, dict[str, tuple[dict[str, Any], dict[str, Any]]]] = {
    "PointingDaisy": POINTING
    | {
        "radius": ({}, {"radius": "70 arcsec"}),
        "speed": ({}, {"speed": "40 arcsec/s"}),
        "petals": ({}, {"petals": 4.0}),
        "inner": ({}, {"inner": 0.2}),
        "phase": ({}, {"phase": "1 rad"}),
    },
    "PointingStare": POINTING,
    "PointingBackAndForth": POINTING
    | {
        "throw": ({}, {"throw": "5 arcmin"}),
        "speed": ({}, {"speed": "20 arcsec/s"}),
        "acceleration": ({}, {"acceleration": "30 arcsec/s2"}),
        "flag_turnarounds": ({}, {"flag_turnarounds": True}),
    },
    "PointingRaster": POINTING
    | {
        "width": ({}, {"width": "3 arcmin"}),
        "height": ({}, {"height": "1 arcmin"}),
        "spacing": ({}, {"spacing": "15 arcsec"}),
        "speed": ({}, {"speed": "40 arcsec/s"}),
        "acceleration": ({}, {"acceleration": "60 arcsec/s2"}),
        "smooth": ({}, {"smooth": True}),
        "position_angle": ({}, {"position_angle": "0 deg"}),
        "angles": ({}, {"angles": "cross_hatch"}),
        "axes": ({}, {"axes": "horizontal"}),
        "flag_turnarounds": ({}, {"flag_turnarounds": True}),
    },
    "Mispointing": {
        "offset": ({}, {"offset": ["5 arcsec", "0 arcsec"]}),
        "scan_rms": ({}, {"scan_rms": "5 arcsec"}),
        "jitter_rms": ({}, {"jitter_rms": "5 arcsec"}),
        "jitter_time": ({"jitter_rms": "5 arcsec"}, {"jitter_time": "2 s"}),
    },
    "CMBSky": {
        "spectrum": ({}, {"spectrum": "flat.txt"}),
        "nside": ({}, {"nside": 512}),
        "realization": ({}, {"realization": 1}),
        "columns": ({"spectrum": "two.txt", "columns": "TT, EE"}, {"columns": "EE, TT"}),
        "unit": ({"spectrum": "flat.txt", "unit": "uK^2"}, {"unit": "K^2"}),
        "scaling": ({"unit": "uK^2"}, {"scaling": "none"}),
    },
    "PointSources": {
        "catalogue": ({}, {"catalogue": "others.csv"}),
        "frequency": ({"catalogue": "sources.csv"}, {"frequency": "30 GHz"}),
        "scale": ({}, {"scale": 2.0}),
    },
    "PointingSchedule": {
        "schedule": ({}, {"schedule": "later.txt"}),
        "speed": ({}, {"speed": "0.2 deg/s"}),
        "acceleration": ({}, {"acceleration": "0.5 deg/s2"}),
        "turnaround": ({}, {"turnaround": "smooth"}),
        "flag_turnarounds": ({}, {"flag_turnarounds": False}),
        "sun_close": ({}, {"sun_close": "180 deg"}),
        "elevation_nods": ({}, {"elevation_nods": ["1 deg", "0 deg"]}),
        "elevation_speed": (
            {"elevation_nods": ["1 deg", "0 deg"]},
            {"elevation_speed": "0.5 deg/s"},
        ),
        "elevation_acceleration": (
            {"elevation_nods": ["1 deg", "0 deg"]},
            {"elevation_acceleration": "0.5 deg/s2"},
        ),
        "sample_rate": ({}, {"sample_rate": "40 Hz"}),
        "check_limits": ({}, {"check_limits": "error"}),
        "interpolation_error": ({}, {"interpolation_error": 1e-9}),
    },
    "PointingRecorded": {
        "file": ({}, {"file": "other.csv"}),
        "clock": ({}, {"clock": "scene"}),
        "split": ({}, {"split": "2 s"}),
        "target": ({}, {"target": "05h00m10s +20d00m00s"}),
        "flag_mask": ({"file": "flagged.csv"}, {"flag_mask": 2}),
        "celestial": ({}, {"celestial": "recorded"}),
        "interpolation_error": ({"file": "long.csv"}, {"interpolation_error": 1e-9}),
    },
    "LoadTOD": {
        "file": ({}, {"file": "again.h5"}),
        "signal": ({}, {"signal": "none"}),
        "band": ({}, {"band": "150 GHz"}),
        "noise": ({}, {"noise": "noise.ecsv"}),
        "noise_model": ({}, {"noise_model": "el_noise"}),
        "celestial": ({}, {"celestial": "recomputed"}),
        "flag_mask": ({"file": "flagged.h5"}, {"flag_mask": 1}),
        "detector_mask": ({"file": "flagged.h5"}, {"detector_mask": 1}),
        "target": ({}, {"target": "05h00m10s +20d00m00s"}),
        "interpolation_error": (
            {"file": "long.h5", "celestial": "recomputed"},
            {"interpolation_error": 1e-9},
        ),
    },
    "SkyMap": {
        "file": ({}, {"file": "flux.fits"}),
        "map": (ARRAY, {"map": 2 * ARRAY["map"]}),
        "wcs": (ARRAY, {"wcs": tangent(4.0)}),
        "unit": ({}, {"unit": "mK_CMB"}),
        "pixel_size": ({}, {"pixel_size": "4 arcsec"}),
        "centre": ({}, {"centre": "05h00m01s +20d00m00s"}),
        "input_beam": (
            {"file": "beam.fits", "input_beam": "9 arcsec"},
            {"input_beam": "12 arcsec"},
        ),
        "coordsys": ({"file": "sphere.fits"}, {"coordsys": "galactic"}),
        "plane": ({"file": "cube.fits", "plane": 1}, {"plane": 2}),
        "polarization_convention": (
            {"file": "iqu.fits", "polarization_convention": "cosmo"},
            {"polarization_convention": "iau"},
        ),
        "hdu": ({"file": "two.fits"}, {"hdu": "second"}),
        "column": ({"file": "fine.fits"}, {"column": "other"}),
        "beam": ({}, {"beam": "none"}),
        "fwhm": ({}, {"fwhm": "12 arcsec"}),
        "outside": ({"pixel_size": "1 arcsec"}, {"outside": "1 K"}),
        "missing": ({"file": "hole.fits", "missing": "zero"}, {"missing": "error"}),
        "scale": ({}, {"scale": 2.0}),
        "spectral_index": ({"file": "flux.fits"}, {"spectral_index": 3.0}),
        "pixels_per_fwhm": ({}, {"pixels_per_fwhm": 8.0}),
        "interpolation": ({}, {"interpolation": "linear"}),
    },
    "AtmosphereLayers": {
        "pwv": ({}, {"pwv": "5 mm"}),
        "pwv_rms": ({}, {"pwv_rms": "1 %"}),
        "pwv_rms_at": ({}, {"pwv_rms_at": "zenith"}),
        "pwv_rms_after_beam": ({}, {"pwv_rms_after_beam": True}),
        "layers": ({}, {"layers": 5}),
        "lowest": ({}, {"lowest": "600 m"}),
        "highest": ({}, {"highest": "4000 m"}),
        "weights": ({}, {"weights": "equal"}),
        "layer_response": ({}, {"layer_response": "column"}),
        "outer_scale": ({}, {"outer_scale": "400 m"}),
        "wind": ({}, {"wind": {"speed": "3 m/s", "direction": "10 deg"}}),
        "fidelity": ({}, {"fidelity": "fine"}),
        "beam": ({}, {"beam": "top_hat"}),
        "edge_taper": ({"beam": "tapered"}, {"edge_taper": 20.0}),
        "outputs": ({}, {"outputs": ["pwv", "opacity", "path_delay"]}),
        "omit": ({}, {"omit": [0]}),
        "spectra": ({}, {"spectra": "none such"}),
        "lattice": ({}, {"lattice": 0.15}),
        "tolerance": ({}, {"tolerance": "0.01 %"}),
    },
    "AtmosphereScreens": {
        "observation": ({}, {"observation": 1}),
        "moment": ({}, {"moment": "2 s"}),
        "moments": ({}, {"moments": 2}),
        "pixels": ({}, {"pixels": 8}),
    },
    "WhiteNoise": {
        "net": ({}, {"net": "1 mK s(1/2)"}),
        "reference": ({"net": "1 mK s(1/2)"}, {"reference": "detector"}),
        "scatter": ({}, {"scatter": 0.1}),
        "model": ({}, {"model": "background_limited"}),
    },
    "PinkNoise": {
        "net": ({}, {"net": "1 mK s(1/2)"}),
        "reference": ({"net": "1 mK s(1/2)"}, {"reference": "detector"}),
        "knee": ({}, {"knee": "1 Hz"}),
        "slope": ({}, {"slope": 1.5}),
        "minimum_frequency": ({}, {"minimum_frequency": "10 mHz"}),
        "poles": ({}, {"poles": 6}),
        "shared": ({}, {"shared": 0.5}),
    },
    "Efficiency": {
        "main_beam": ({}, {"main_beam": 0.5}),
        "illumination": ({}, {"illumination": 0.5}),
        "scatter": ({}, {"scatter": "5 %"}),
        "calibration": ({}, {"calibration": "instantaneous"}),
        "calibration_error": ({}, {"calibration_error": "5 %"}),
    },
    "HalfWavePlate": {
        "frequency": ({}, {"frequency": "3 Hz"}),
        "angle": ({}, {"angle": "10 deg"}),
    },
    "Leakage": {
        "share": ({}, {"share": "2 %"}),
        "angle": ({}, {"angle": "10 deg"}),
    },
    "HighpassFilter": {
        "frequency": ({}, {"frequency": "0.2 Hz"}),
        "degree": ({}, {"degree": 1}),
        "trim": ({}, {"trim": "1 s"}),
        "oversampling": ({}, {"oversampling": 8.0}),
        "response": ({}, {"response": "bessel"}),
        "mask": ({}, {"mask": {"radius": "20 arcsec"}}),
    },
    "Detrend": {"order": ({}, {"order": 2}), "mask": ({}, {"mask": {"radius": "20 arcsec"}})},
    "Despline": {"knots": ({}, {"knots": "5 s"})},
    "GroundPickup": {
        "rms": ({}, {"rms": "2 mK"}),
        "fwhm": ({}, {"fwhm": "5 deg"}),
        "power": ({}, {"power": -2.0}),
        "scatter": ({}, {"scatter": "5 %"}),
        "realization": ({}, {"realization": 1}),
    },
    "Glitches": {
        "rate": ({}, {"rate": "1 Hz"}),
        "amplitude": ({}, {"amplitude": "1 K"}),
        "decay": ({}, {"decay": "50 ms"}),
        "flag_above": ({}, {"flag_above": "1 mK"}),
    },
    "GainDrift": {
        "rms": ({}, {"rms": "1 %"}),
        "slope": ({}, {"slope": 1.0}),
        "fastest": ({}, {"fastest": "1 Hz"}),
    },
    "TimeConstant": {"tau": ({}, {"tau": "20 ms"}), "scatter": ({}, {"scatter": "10 %"})},
    "Crosstalk": {"level": ({}, {"level": "1 %"}), "file": ({}, {"file": "shares.csv"})},
    "PolynomialFilter": {
        "order": ({}, {"order": 2}),
        "interval": ({}, {"interval": "throw"}),
        "mask": ({}, {"mask": {"radius": "20 arcsec"}}),
    },
    "GroundFilter": {
        "bin": ({}, {"bin": "0.02 deg"}),
        "split": ({}, {"split": True}),
        "trend": ({}, {"trend": 3}),
    },
    "Taper": {"share": ({}, {"share": "20 %"})},
    "CommonModeFilter": {
        "modes": ({}, {"modes": 2}),
        "method": ({}, {"method": "mean"}),
        "residual": ({}, {"residual": 1e-2}),
        "gap": ({"gap": 0.99}, {"gap": 1e-3}),
        "on_undetermined": ({"gap": 1e-3}, {"on_undetermined": "skip"}),
        "scale": ({}, {"scale": "rms"}),
        "group": ({}, {"group": "wafer"}),
        "mask": ({}, {"mask": {"radius": "20 arcsec"}}),
    },
    "BinMap": {
        "pixel": ({}, {"pixel": "3 arcsec"}),
        "width": ({}, {"width": "3 arcmin"}),
        "height": ({"width": "3 arcmin"}, {"height": "2 arcmin"}),
        "centre": ({}, {"centre": "05h00m01s +20d00m00s"}),
        "projection": ({}, {"projection": "CAR"}),
        "frame": ({}, {"frame": "galactic"}),
        "nside": ({}, {"nside": 8192}),
        "ordering": ({"nside": 8192}, {"ordering": "nested"}),
        "weights": ({}, {"weights": "uniform"}),
        "noise": ({}, {"noise": "scatter"}),
        "stokes": ({}, {"stokes": "IQU"}),
        "condition_limit": ({"stokes": "IQU"}, {"condition_limit": 3.0}),
        "contents": ({}, {"contents": "hits"}),
        "half_difference": ({}, {"half_difference": False}),
        "crosslinking": ({}, {"crosslinking": True}),
        "scan_hits": ({}, {"scan_hits": True}),
        "smooth": ({}, {"smooth": "beam"}),
        "product": ({}, {"product": "chart"}),
    },
    "PowerSpectrum": {
        "streams": ({}, {"streams": ["signal"]}),
        "detectors": ({}, {"detectors": 3}),
        "segment": ({}, {"segment": "4 s"}),
    },
    "TimeStreams": {
        "streams": ({}, {"streams": ["signal", "white"]}),
        "detectors": ({}, {"detectors": 5}),
        "observation": ({}, {"observation": 1}),
    },
    "SaveTOD": {
        "format": ({}, {"format": "fits"}),
        "streams": ({}, {"streams": ["signal", "white"]}),
        "dtype": ({}, {"dtype": "float32"}),
    },
    "ModeSpectrum": {
        "modes": ({}, {"modes": 2}),
        "delays": ({}, {"delays": 1}),
        "delay": ({"delays": 1}, {"delay": "0.5 s"}),
        "detectors": ({}, {"detectors": 5}),
        "center": ({}, {"center": False}),
        "normalize": ({}, {"normalize": True}),
    },
    "CompareStreams": {
        "stream": ({}, {"stream": "pink"}),
        "reference": ({}, {"reference": "pink"}),
        "detectors": ({}, {"detectors": 3}),
        "segment": ({}, {"segment": "0.5 s"}),
    },
    "MeasureFigures": {"metrics": ({}, {"metrics": ["central_rms"]})},
    "TransferFunction": {
        "modes": ({}, {"modes": "full"}),
        "bins": ({}, {"bins": 4}),
        "largest": ({}, {"largest": "50 arcsec"}),
        "smallest": ({}, {"smallest": "20 arcsec"}),
        "radius": ({}, {"radius": "60 arcsec"}),
        "taper": ({}, {"taper": "20 arcsec"}),
        "least_coverage": ({}, {"least_coverage": 0.6}),
        "map": ({}, {"map": "chart"}),
    },
    "CompareMaps": {
        "map": ({}, {"map": "chart"}),
        "reference": ({}, {"reference": "map"}),
        "file": ({}, {"file": "map.fits"}),
        "plane": ({"file": "cube.fits", "plane": 1}, {"plane": 2}),
        "hdu": ({"file": "two.fits"}, {"hdu": "second"}),
        "coordsys": ({"file": "fine.fits"}, {"coordsys": "galactic"}),
        "beam": ({}, {"beam": "20 arcsec"}),
        "least_coverage": ({}, {"least_coverage": 0.6}),
        "threshold": ({}, {"threshold": 3.0}),
        "noise": ({}, {"noise": "map"}),
        "bins": ({}, {"bins": 5}),
    },
    "MapSpectrum": {
        "maps": ({}, {"maps": ["chart"]}),
        "bins": ({}, {"bins": 5}),
        "least_coverage": ({}, {"least_coverage": 0.6}),
        "taper": ({}, {"taper": "20 arcsec"}),
    },
    "SaveMap": {
        "central_diameter": ({}, {"central_diameter": "30 arcsec"}),
        "overwrite": ({}, {"overwrite": False}),
    },
    "Plots": {
        "smooth": ({}, {"smooth": "none"}),
        "central_diameter": ({}, {"central_diameter": "30 arcsec"}),
        "least_coverage": ({}, {"least_coverage": 0.5}),
        "contours": ({}, {"contours": [-1.0, 1.0]}),
        "formats": ({}, {"formats": ["svg"]}),
        "dpi": ({}, {"dpi": 60.0}),
    },
    "Report": {"central_diameter": ({}, {"central_diameter": "30 arcsec"})},
}

NEED_OTHERS = {"ToastOperator", "PySMSky"}
"""Steps that need packages which are not installed with the tests; tests/interop and
sky/test_pysm.py have them.
"""

CHAINS = {
    "PointingRecorded": ["WhiteNoise", "Efficiency", "BinMap"],
    "SkyMap": ["SkyMap"],
    "PointSources": ["PointSources"],
    "CMBSky": ["CMBSky"],
    "Mispointing": ["PointingDaisy", "Mispointing", "SkyMap"],
    "AtmosphereLayers": ["AtmosphereLayers"],
    "AtmosphereScreens": ["AtmosphereLayers", "AtmosphereScreens"],
    "WhiteNoise": ["WhiteNoise"],
    "PinkNoise": ["PinkNoise"],
    "Efficiency": ["SkyMap", "AtmosphereLayers", "WhiteNoise", "PinkNoise", "Efficiency"],
    "HalfWavePlate": ["HalfWavePlate", "SkyMap", "AtmosphereLayers", "Leakage"],
    "Leakage": ["SkyMap", "AtmosphereLayers", "Leakage"],
    "HighpassFilter": ["WhiteNoise", "PinkNoise", "Efficiency", "HighpassFilter"],
    "CommonModeFilter": ["WhiteNoise", "PinkNoise", "Efficiency", "CommonModeFilter"],
    "Detrend": ["WhiteNoise", "PinkNoise", "Efficiency", "Detrend"],
    "Despline": ["WhiteNoise", "PinkNoise", "Efficiency", "Despline"],
    "GroundPickup": ["GroundPickup"],
    "Glitches": ["Glitches"],
    "GainDrift": ["WhiteNoise", "Efficiency", "GainDrift"],
    "TimeConstant": ["WhiteNoise", "Efficiency", "TimeConstant"],
    "Crosstalk": ["WhiteNoise", "Efficiency", "Crosstalk"],
    "PolynomialFilter": ["WhiteNoise", "PinkNoise", "Efficiency", "PolynomialFilter"],
    "GroundFilter": ["WhiteNoise", "PinkNoise", "Efficiency", "GroundFilter"],
    "Taper": ["WhiteNoise", "PinkNoise", "Efficiency", "Taper"],
    "BinMap": ["SkyMap", "WhiteNoise", "Efficiency", "BinMap"],
    "LoadTOD": ["BinMap"],
    "PowerSpectrum": ["WhiteNoise", "PinkNoise", "Efficiency", "PowerSpectrum"],
    "TimeStreams": ["WhiteNoise", "Efficiency", "TimeStreams"],
    "ModeSpectrum": ["WhiteNoise", "PinkNoise", "Efficiency", "ModeSpectrum"],
    "CompareStreams": ["WhiteNoise", "PinkNoise", "Efficiency", "CompareStreams"],
    "MeasureFigures": ["WhiteNoise", "Efficiency", "BinMap", "MeasureFigures"],
    "SaveTOD": ["WhiteNoise", "Efficiency", "SaveTOD"],
    "SaveMap": ["WhiteNoise", "Efficiency", "BinMap", "SaveMap"],
    "TransferFunction": [
        "SkyMap",
        "WhiteNoise",
        "PinkNoise",
        "Efficiency",
        "HighpassFilter",
        "CommonModeFilter",
        "BinMap",
        "TransferFunction",
    ],
    "CompareMaps": ["SkyMap", "WhiteNoise", "Efficiency", "BinMap", "CompareMaps"],
    "MapSpectrum": ["WhiteNoise", "Efficiency", "BinMap", "MapSpectrum"],
    "Plots": ["WhiteNoise", "Efficiency", "BinMap", "Plots"],
    "Report": ["WhiteNoise", "Efficiency", "BinMap", "Report"],
}
DEFAULTS: dict[str, dict[str, Any]] = {
    "SkyMap": {"file": "map.fits"},
    "PointSources": {"catalogue": "sources.csv"},
    "CMBSky": {"spectrum": "theory.txt", "nside": 256, "scaling": "l(l+1)/2pi"},
    "AtmosphereLayers": {"pwv": "7.7 mm"},
    "WhiteNoise": {},
    "BinMap": {"pixel": "4 arcsec"},
    "HighpassFilter": {"frequency": "0.1 Hz"},
    "HalfWavePlate": {"frequency": "2 Hz"},
    "GroundFilter": {"bin": "0.01 deg"},
    "Glitches": {"rate": "0.5 Hz"},
    "GainDrift": {"fastest": "0.5 Hz"},
    "PointingDaisy": SCAN,
    "PointingStare": {"scan_duration": "12 s"},
    "PointingBackAndForth": TURN,
    "PointingRaster": {
        "scan_duration": "32 s",
        "scans": 2,
        "width": "2 arcmin",
        "speed": "30 arcsec/s",
    },
    "CompareStreams": {"reference": "white"},
    "MeasureFigures": {"metrics": ["coverage", "central_rms"]},
    "PointingRecorded": {"file": "scan.csv"},
    "LoadTOD": {"file": "recorded.h5"},
    "PointingSchedule": {"schedule": "night.txt", "speed": "0.5 deg/s", "check_limits": "warn"},
}


def chain(which: str, maps: Path, /, **parameters: Any) -> list[Any]:
    """A short pipeline with this step in it."""

    def step(other: str) -> Any:
        values = DEFAULTS.get(other, {}) | (parameters if other == which else {})
        files = (
            "file",
            "schedule",
            "catalogue",
            "spectrum",
            *(("noise",) if other == "LoadTOD" else ()),
        )
        values = values | {key: maps / values[key] for key in files if values.get(key) is not None}
        if which == "BinMap" == other and "nside" in values:
            values.pop("pixel", None)
        return make(other, **values)

    if which == "Mispointing":  # stands behind a pointing step
        return [step(other) for other in CHAINS[which]]
    pointing = which if which.startswith(("Pointing", "LoadTOD")) else "PointingDaisy"
    return [step(pointing), *(step(other) for other in CHAINS.get(which, []))]


REFUSALS = {
    ("LoadTOD", "signal"): "BinMap needs signal",
    ("LoadTOD", "band"): "no band, or more than one, at 150 GHz",
    ("LoadTOD", "noise_model"): "has no noise model 'el_noise'",
    ("SkyMap", "missing"): "NaN",
    ("PolynomialFilter", "interval"): "no interval 'throw'",
    ("TransferFunction", "map"): "there is no map 'chart'",
    ("CompareMaps", "map"): "there is no map 'chart'",
    ("MapSpectrum", "maps"): "no TAN map 'chart'",
    ("AtmosphereLayers", "spectra"): "unknown spectra 'none such'",
    ("SaveMap", "overwrite"): "exists already",
    ("PointingRecorded", "clock"): "is too large",
    ("PointingRecorded", "celestial"): "no boresight_radec",
    ("PointingDaisy", "check_limits"): "dish's largest speed of the azimuth axis",
    ("PointingStare", "check_limits"): "dish's largest speed of the azimuth axis",
    ("PointingRaster", "check_limits"): "dish's largest speed of the azimuth axis",
    ("PointingSchedule", "check_limits"): "dish's largest speed of the azimuth axis",
    ("PointingBackAndForth", "check_limits"): "dish's largest speed of the azimuth axis",
}
"""What a changed parameter is answered with, where it is not another result."""

POLARIZED = {
    "SkyMap.polarization_convention",
    "BinMap.stokes",
    "BinMap.condition_limit",
    "HalfWavePlate",
    "Leakage",
}
"""Steps and parameters that act on polarized detectors alone."""

ALL = [
    pytest.param(name, field, id=f"{name}.{field}")
    for name, cases in CASES.items()
    for field in cases
]


@pytest.mark.parametrize(("name", "field"), ALL)
def test_every_parameter_of_every_operator(
    name: str, field: str, maps: Path, tmp_path: Path, known: dict[str, Any]
) -> None:
    needs, change = CASES[name][field]
    case = f"{name} {needs}"
    camera: dict[str, Any] = (
        {"telescope": {"azimuth_speed_max": "1 arcsec/s"}} if field == "check_limits" else {}
    )
    if field == "group":
        case, camera = f"{case} wafers", {"kind": OfTwoWafers}
    if f"{name}.{field}" in POLARIZED or name in POLARIZED:
        case, camera = f"{case} polarized", {"polarization": "pairs", "detectors": 20}
    where = scene(instrument=instrument(**camera))
    if case not in known or field == "overwrite":
        known[case] = outcome(chain(name, maps, **needs), where, tmp_path / "before")
    folder = tmp_path / ("before" if field == "overwrite" else "after")
    if (name, field) in REFUSALS:
        with pytest.raises(ZondaError, match=REFUSALS[name, field]):
            outcome(chain(name, maps, **(needs | change)), where, folder)
    else:
        assert not same(known[case], outcome(chain(name, maps, **(needs | change)), where, folder))


@pytest.fixture(scope="module")
def known() -> dict[str, Any]:
    """Runs before the change, made once each."""
    return {}


def test_no_operator_and_no_parameter_is_left_out() -> None:
    own = {c.name: operators for c in operators.candidates() if c.distribution == "zonda"}
    assert set(own) == set(CASES) | NEED_OTHERS
    for name, registry in own.items():
        if name in NEED_OTHERS:
            continue
        assert set(registry.get(name).model_fields) - {"name"} == set(CASES[name]), name


@pytest.mark.parametrize("name", sorted(CASES))
def test_the_name_of_a_step_is_its_label(name: str, maps: Path) -> None:
    given = chain(name, maps, name="mine")
    assert "mine" in [step.label for step in zonda.Pipeline(given).operators]


# ---- what belongs together


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("PointingDaisy", {"offsets": "none", "offset_size": "2 arcmin"}),
        ("SkyMap", {"beam": "none", "fwhm": "9 arcsec"}),
        ("WhiteNoise", {"model": "background_limited", "net": "1 mK s(1/2)"}),
        ("WhiteNoise", {"reference": "detector"}),
        ("PinkNoise", {"reference": "detector"}),
        ("BinMap", {"nside": 1024, "pixel": "3 arcsec"}),
        ("BinMap", {"nside": 1024, "width": "3 arcmin"}),
        ("BinMap", {"ordering": "nested"}),
        ("HighpassFilter", {"response": "bessel", "oversampling": 12}),
        ("HighpassFilter", {"degree": None}),
        ("CommonModeFilter", {"method": "mean", "scale": "rms"}),
        ("CommonModeFilter", {"method": "mean", "modes": 3}),
        ("CommonModeFilter", {"method": "mean", "residual": 1e-3}),
        ("CommonModeFilter", {"method": "mean", "gap": 0.5}),
        ("CommonModeFilter", {"method": "mean", "on_undetermined": "skip"}),
        ("AtmosphereLayers", {"layers": 1, "highest": "3000 m"}),
        ("AtmosphereLayers", {"layers": 1, "weights": "equal"}),
    ],
)
def test_what_would_be_ignored_is_refused(
    name: str, parameters: dict[str, Any], maps: Path
) -> None:
    values = {"file": maps / "map.fits"} if name == "SkyMap" else {}
    with pytest.raises(ZondaError):
        make(name, **values, **parameters)


def test_a_scan_that_is_not_there_cannot_be_shown(maps: Path, tmp_path: Path) -> None:
    with pytest.raises(ZondaError, match="observation"):
        outcome(chain("TimeStreams", maps, observation=7), scene(), tmp_path)


# ---- scene, site, instrument, telescope, band, noise models, companion runs

WHOLE = ["AtmosphereLayers", "WhiteNoise", "PinkNoise", "Efficiency", "BinMap"]
SAID = {"name", "description", "provenance"}
"""Texts that name and explain: shown by `zonda plugins` and in products."""
SITE = {
    "name": "s",
    "latitude": "38.4 deg",
    "longitude": "-79.8 deg",
    "altitude": "825 m",
    "climatology": "green_bank",
}

SETTINGS: dict[str, dict[str, Any]] = {
    "scene": {
        "site": {"site": Site(**(SITE | {"latitude": "39 deg"}))},
        "instrument": {"instrument": instrument(detectors=7)},
        "time": {"time": "2024-11-25T07:30"},
        "target": {"target": "05h00m10s +20d"},
        "seed": {"seed": 4},
        "weather": {"weather": {"wind": "median"}},
    },
    "site": {
        "latitude": {"latitude": "39 deg"},
        "longitude": {"longitude": "-70 deg"},
        "altitude": {"altitude": "1500 m"},
        "climatology": {"climatology": "meerkat"},
    },
    "instrument": {
        "telescope": {"telescope": {"diameter": "50 m"}},
        "band": {"band": {"high": "112 GHz"}},
        "bands": {
            "bands": [
                {"name": "b", "low": "78 GHz", "high": "108 GHz"},
                {"name": "c", "low": "130 GHz", "high": "170 GHz"},
            ]
        },
        "pixels": {
            "pixels": "separate",
            "bands": [
                {"name": "b", "low": "78 GHz", "high": "108 GHz", "detectors": 7},
                "so_93ghz",
            ],
        },
        "polarization": {"polarization": "pairs", "detectors": 20},
        "detectors": {"detectors": 7},
        "field_of_view": {"field_of_view": "3 arcmin"},
        "layout": {"layout": "rings"},
        "wafers": {"layout": "wafers", "detectors": 21, "wafers": 3},
        "focalplane": {"focalplane": "array.csv", "detectors": None, "field_of_view": None},
        "fwhm": {"fwhm": None},
        "main_beam_efficiency": {"main_beam_efficiency": 0.4},
        "illumination_efficiency": {"illumination_efficiency": 0.7},
        "net": {"net": "1 mK s(1/2)"},
        "knee": {"knee": "1 Hz"},
        "slope": {"slope": 1.4},
        "pink_minimum_frequency": {"pink_minimum_frequency": "20 mHz"},
        "sample_rate": {"sample_rate": "40 Hz"},
    },
    "telescope": {
        "diameter": {"diameter": "50 m"},
        "elevation_min": {"elevation_min": "80 deg"},
        "elevation_max": {"elevation_max": "20 deg"},
        "speed_max": {"speed_max": "10 arcsec/s"},
        "acceleration_max": {"acceleration_max": "1 arcsec/s2"},
        "azimuth_speed_max": {"azimuth_speed_max": "10 arcsec/s"},
        "azimuth_acceleration_max": {"azimuth_acceleration_max": "1 arcsec/s2"},
        "azimuth_jerk_max": {"azimuth_jerk_max": "1 arcsec/s3"},
        "elevation_speed_max": {"elevation_speed_max": "10 arcsec/s"},
        "elevation_acceleration_max": {"elevation_acceleration_max": "1 arcsec/s2"},
        "elevation_jerk_max": {"elevation_jerk_max": "1 arcsec/s3"},
    },
    "band": {
        "low": {"low": "80 GHz"},
        "high": {"high": "112 GHz"},
        "file": {"low": None, "high": None, "file": "band.txt"},
    },
    "background_limited": {
        "reference": {"reference": REFUSED},
        "optical_efficiency": {"optical_efficiency": 0.5},
        "polarizations": {"polarizations": 1},
        "modes": {"modes": 2},
        "telescope_temperature": {"telescope_temperature": "20 K"},
        "receiver_temperature": {"receiver_temperature": "20 K"},
    },
    "fixed_net": {
        "reference": {"reference": "detector", "level": "1 mK s(1/2)"},
        "level": {"level": "1 mK s(1/2)"},
    },
}


LIMITS = {
    ("telescope", "elevation_min"): "reaches 80 deg to 88 deg",
    ("telescope", "elevation_max"): "reaches 5 deg to 20 deg",
    ("telescope", "speed_max"): "largest speed on the sky is 10 arcsec/s",
    ("telescope", "acceleration_max"): "largest acceleration on the sky is 1 arcsec/s2",
    ("telescope", "azimuth_speed_max"): "largest speed of the azimuth axis is 10 arcsec/s",
    (
        "telescope",
        "azimuth_acceleration_max",
    ): "largest acceleration of the azimuth axis is 1 arcsec/s2",
    ("telescope", "azimuth_jerk_max"): "largest jerk of the azimuth axis is 1 arcsec/s3",
    ("telescope", "elevation_speed_max"): "largest speed of the elevation axis is 10 arcsec/s",
    (
        "telescope",
        "elevation_acceleration_max",
    ): "largest acceleration of the elevation axis is 1 arcsec/s2",
    ("telescope", "elevation_jerk_max"): "largest jerk of the elevation axis is 1 arcsec/s3",
    ("background_limited", "reference"): "'detector'",
}
"""What is refused with which message."""


def described(what: str, change: dict[str, Any], maps: Path) -> tuple[Any, dict[str, Any]]:
    """(scene, parameters of WhiteNoise)."""
    if what == "scene":
        return scene(**change), {}
    if what == "site":
        return scene(site=Site(**(SITE | change))), {}
    if what == "instrument":
        table = {"focalplane": maps / change["focalplane"]} if "focalplane" in change else {}
        return scene(instrument=instrument(**(change | table))), {}
    if what == "telescope":
        return scene(instrument=instrument(telescope=change)), {}
    if what == "band":
        return (
            scene(
                instrument=instrument(
                    band=change | ({"file": maps / change["file"]} if "file" in change else {})
                )
            ),
            {},
        )
    return scene(), {"model": {"name": what, **change}}


def whole(noise: dict[str, Any], maps: Path) -> list[Any]:
    pointing = {k: v for k, v in SCAN.items() if k != "sample_rate"} | {"scans": 1}
    steps = [make("PointingDaisy", **pointing), make("SkyMap", file=maps / "map.fits")]
    return steps + [
        make(n, **(DEFAULTS.get(n, {}) | (noise if n == "WhiteNoise" else {}))) for n in WHOLE
    ]


@pytest.fixture(scope="module")
def unchanged(maps: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The run before the change; where the default depends on what it is of, by its name."""
    found = {}
    for what in SETTINGS:
        where, noise = described(what, {}, maps)
        found[what] = outcome(whole(noise, maps), where, tmp_path_factory.mktemp("out"))
    return found


@pytest.mark.parametrize(
    ("what", "field"), [(w, f) for w, fields in SETTINGS.items() for f in fields]
)
def test_every_parameter_of_the_scene(
    what: str, field: str, maps: Path, tmp_path: Path, unchanged: dict[str, Any]
) -> None:
    def run() -> dict[str, Any]:
        where, noise = described(what, SETTINGS[what][field], maps)
        return outcome(whole(noise, maps), where, tmp_path)

    if (what, field) in LIMITS:
        with pytest.raises(ZondaError, match=LIMITS[what, field]):
            run()
    else:
        assert not same(unchanged[what], run())


def test_no_parameter_of_the_scene_is_left_out() -> None:
    classes = {
        "scene": zonda.Scene,
        "site": Site,
        "instrument": zonda.Instrument,
        "telescope": zonda.Telescope,
        "band": zonda.Band,
        "background_limited": noise_models.get("background_limited"),
        "fixed_net": noise_models.get("fixed_net"),
    }
    assert set(classes) == set(SETTINGS)
    for what, cls in classes.items():
        said = SAID | (
            {"site"} if what == "telescope" else set()
        )  # where it stands: `zonda check` compares, nothing is computed
        assert {field.alias or name for name, field in cls.model_fields.items()} - said == set(
            SETTINGS[what]
        ), what
