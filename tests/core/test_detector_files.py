"""Focal planes in files of TOAST (HDF5) and sotodlib (TOML) as `focalplane:` of an instrument."""

import gzip
from pathlib import Path

import astropy.units as u
import h5py
import numpy as np
import pytest
from astropy.io.misc.hdf5 import write_table_hdf5
from astropy.table import QTable

import zonda
from zonda.core.array_table import read_array
from zonda.core.errors import InputError
from zonda.core.numerics.quaternions import detector_quaternions
from zonda.core.numerics.radiation import to_kelvin_rj

ANGLES = np.radians([0.0, 90.0, 45.0, 135.0])
XI, ETA = np.radians([0.5, 0.5, -1.0, -1.0]), np.radians([0.2, 0.2, 0.7, 0.7])
QUATS = detector_quaternions(XI, ETA, ANGLES)
NAMES = ["a", "b", "c", "d"]
F090 = {"center": 92.0, "low": 79.0, "high": 105.0, "NET": 300.0, "fknee": 50.0, "fmin": 0.01}
F090 |= {"alpha": 3.5, "NET_corr": 1.1}
BANDS = {"SAT_f090": F090, "SAT_f150": F090 | {"low": 130.0, "high": 165.0, "NET": 350.0}}
BANDS |= {"NC": F090 | {"low": np.nan, "high": np.nan}}
CAMERA = {
    "name": "camera",
    "telescope": {"name": "dish", "diameter": "0.42 m"},
    "bands": [
        {"name": "f090", "low": "79 GHz", "high": "105 GHz"},
        {"name": "f150", "low": "130 GHz", "high": "165 GHz"},
    ],
    "main_beam_efficiency": 0.7,
    "illumination_efficiency": 0.9,
    "sample_rate": "50 Hz",
}


def toast_file(path: Path, inside: str = "", **changes: object) -> Path:
    """A focal plane of two bands as TOAST writes it; a column that is None is left out."""
    columns: dict[str, object] = {
        "name": np.array(NAMES, "S"),
        "quat": QUATS,
        "band": np.array(["SAT_f090", "SAT_f090", "SAT_f150", "SAT_f150"], "S"),
        "fwhm": np.full(4, 30.0) * u.arcmin,
        "psd_net": np.array([300, 300, 350, 350]) * u.uK * u.s**0.5,
        "psd_fknee": np.full(4, 50.0) * u.mHz,
        "psd_fmin": np.full(4, 0.01) * u.mHz,
        "psd_alpha": np.full(4, 1.5),
        "bandcenter": np.array([92.0, 92.0, 147.5, 147.5]) * u.GHz,
        "bandwidth": np.array([26.0, 26.0, 35.0, 35.0]) * u.GHz,
        "pol_leakage": np.full(4, 0.0),
        "pol_efficiency": np.full(4, 1.0),
        "pixel": np.array(NAMES, "S"),
    }
    columns |= changes
    table = QTable({key: value for key, value in columns.items() if value is not None})
    table.meta["sample_rate"] = 50 * u.Hz
    with h5py.File(path, "w") as file:
        group = file.create_group(inside) if inside else file
        write_table_hdf5(table, group, path="focalplane", serialize_meta=True)
    return path


def hardware(path: Path, bands: dict[str, dict[str, float]] = BANDS, extra: str = "") -> Path:
    """Hardware as sotodlib writes it: two detectors of either band, and a dark one."""
    lines = []
    for band, keys in bands.items():
        lines += [f"[bands.{band}]", *(f"{key} = {value}" for key, value in keys.items())]
    on = ["SAT_f090", "SAT_f090", "SAT_f150", "SAT_f150", "NC"]
    for name, band, quat in zip([*NAMES, "dark"], on, [*QUATS, QUATS[0]], strict=True):
        lines += [f"[detectors.{name}]", f'band = "{band}"', f"quat = {quat.tolist()}"]
        lines += ['wafer_slot = "w25"', "fwhm = 30.0", 'pol = "A"']
    text = "\n".join([*lines, extra])
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return path


def net(row: int) -> float:
    """300 or 350 uK of the CMB's temperature in the two bands, K_RJ."""
    low, high, value = ((79, 105, 300e-6), (130, 165, 350e-6))[row]
    return value * to_kelvin_rj("K_CMB", zonda.Band(name="b", low=f"{low} GHz", high=f"{high} GHz"))


@pytest.mark.parametrize("inside", ["", "instrument"])
def test_a_focal_plane_of_toast(tmp_path: Path, inside: str) -> None:
    """Alone, or in the file of a whole observation."""
    path = toast_file(tmp_path / "fp.h5", inside)
    plane = zonda.Instrument(**CAMERA, focalplane=str(path)).focalplane()
    assert plane.names == NAMES
    assert plane.band.tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose([plane.xi, plane.eta], [XI, ETA], rtol=1e-12)
    np.testing.assert_allclose(plane.polarization_angle, ANGLES, atol=1e-12)
    assert (plane.polarization_efficiency == 1).all()
    np.testing.assert_allclose(plane.fwhm, np.radians(0.5))
    # Gauss-Legendre of 16 points over the band, and of 4 over each of its parts: to rounding
    np.testing.assert_allclose(plane.net, [net(0)] * 2 + [net(1)] * 2, rtol=1e-9)
    np.testing.assert_allclose([plane.knee, plane.slope], [[0.05] * 4, [1.5] * 4])
    np.testing.assert_allclose(plane.minimum_frequency, 1e-5)


def test_leakage_dark_detectors_and_a_file_without_bands(tmp_path: Path) -> None:
    leaky = toast_file(tmp_path / "a.h5", pol_leakage=np.full(4, 0.25), pol_efficiency=None)
    np.testing.assert_allclose(read_array(leaky).columns["polarization_efficiency"], 0.6)
    dark = toast_file(tmp_path / "b.h5", bandcenter=np.array([92, 92, np.nan, np.nan]) * u.GHz)
    table = read_array(dark)
    assert table.names == ["a", "b"]
    assert "dark detectors, without a band, are left out: 2" in table.notes
    none = read_array(toast_file(tmp_path / "c.h5", bandcenter=None, bandwidth=None))
    assert "net" not in none.columns
    assert "without a band they cannot be turned into K_RJ" in " ".join(none.notes)


def test_bands_without_a_name_have_that_of_their_centre(tmp_path: Path) -> None:
    assert read_array(toast_file(tmp_path / "a.h5", band=None)).bands == ["f092"] * 2 + ["f148"] * 2
    one = np.full(4, 92.0) * u.GHz
    assert not read_array(toast_file(tmp_path / "b.h5", band=None, bandcenter=one)).bands


def test_a_file_of_zonda_has_its_own_places_and_kelvin(tmp_path: Path) -> None:
    """A file that SaveTOD wrote, whose NETs are K_RJ, is the camera that it was made with."""
    camera = zonda.Instrument(**CAMERA, focalplane=str(toast_file(tmp_path / "fp.h5")))
    steps = [zonda.PointingStare(scan_duration="2 s"), zonda.WhiteNoise(), zonda.Efficiency()]
    scene = zonda.Scene(
        site="atacama", instrument=camera, time="2024-06-25T07:00", target="az 180 deg el 50 deg"
    )
    data = zonda.Pipeline([*steps, zonda.SaveTOD()]).run(scene, output=tmp_path)
    again = read_array(Path(data.products["tod_file"][0]))
    own = camera.cameras["f090"].focalplane()
    for key in ("xi", "eta", "fwhm"):
        np.testing.assert_allclose(again.columns[key], getattr(own, key), rtol=1e-15)
    np.testing.assert_allclose(again.columns["net"], own.net, rtol=1e-15)
    assert not again.notes


@pytest.mark.parametrize("name", ["hw.toml", "hw.toml.gz"])
def test_hardware_of_sotodlib(tmp_path: Path, name: str) -> None:
    path = hardware(tmp_path / name)
    camera = zonda.Instrument(**CAMERA, focalplane=str(path))
    plane = camera.focalplane()
    assert plane.names == NAMES
    assert plane.band.tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose([plane.xi, plane.eta], [XI, ETA], rtol=1e-12)
    np.testing.assert_allclose(plane.polarization_angle, ANGLES, atol=1e-12)
    np.testing.assert_allclose(plane.net, [1.1 * net(0)] * 2 + [1.1 * net(1)] * 2, rtol=1e-9)
    np.testing.assert_allclose([plane.knee, plane.slope], [[0.05] * 4, [3.0] * 4])
    for told in (
        "left out: 1",
        "without SAT_",
        "times NET_corr",
        "from K_CMB into K_RJ",
        "above 3",
    ):
        assert told in camera.notes["focal plane"]


def test_bands_of_two_telescopes_keep_their_names(tmp_path: Path) -> None:
    row = f'[detectors.e]\nband = "LAT_f150"\nquat = {QUATS[1].tolist()}\nfwhm = 1.4'
    path = hardware(tmp_path / "hw.toml", BANDS | {"LAT_f150": BANDS["SAT_f150"]}, row)
    assert set(read_array(path).bands) == {"SAT_f090", "SAT_f150", "LAT_f150"}


def test_a_table_with_these_numbers_is_the_same_camera(tmp_path: Path) -> None:
    """Also the angles, by the column gamma."""
    degrees = np.degrees(ANGLES).tolist()
    text = "".join(
        f"{name},{x!r},{y!r},{angle!r},{band}\n"
        for name, x, y, angle, band in zip(
            NAMES, XI.tolist(), ETA.tolist(), degrees, ["f090"] * 2 + ["f150"] * 2, strict=True
        )
    )
    (tmp_path / "t.csv").write_text(f"name,xi [rad],eta [rad],gamma [deg],band\n{text}")
    more = CAMERA | {"net": "0 K s(1/2)"}
    ours = zonda.Instrument(**more, focalplane=str(tmp_path / "t.csv")).focalplane()
    theirs = zonda.Instrument(**more, focalplane=str(toast_file(tmp_path / "fp.h5"))).focalplane()
    np.testing.assert_allclose(
        detector_quaternions(theirs.xi, theirs.eta, theirs.polarization_angle),
        detector_quaternions(ours.xi, ours.eta, ours.polarization_angle),
        atol=1e-12,
    )


def faults(folder: Path) -> list[tuple[Path, str]]:
    """Files that cannot be used, and what is said of them."""
    quats = QUATS.copy()
    quats[1] = 0.0, 0.0, 0.0, 2.0
    backwards = QUATS.copy()
    backwards[2] = 1.0, 0.0, 0.0, 0.0
    fwhm = np.array([30.0, 30.0, np.nan, 30.0]) * u.arcmin
    found = [
        (toast_file(folder / "a.h5", quat=quats), "quaternion of detector b.* is no rotation"),
        (toast_file(folder / "b.h5", quat=backwards), "quaternion of detector c.*less than 90"),
        (toast_file(folder / "c.h5", fwhm=fwhm), "fwhm of detector c is no number"),
        (toast_file(folder / "d.h5", quat=np.zeros((4, 3))), "does not fit together: quaternion"),
        (toast_file(folder / "e.h5", quat=None), "incomplete or corrupt: quat"),
        (toast_file(folder / "f.h5", fwhm=np.full(4, 1.0) * u.K), "cannot be read"),
        (toast_file(folder / "g.h5", name=np.array(["a", "a", "c", "d"], "S")), "'a'"),
        (toast_file(folder / "h.h5", "elsewhere"), "there is no table /focalplane"),
    ]
    texts = {
        "a.toml": ("[bands]", "there are no detectors"),
        "b.toml": ("detectors = 3", "cannot be read as hardware of sotodlib"),
        "c.toml": ('[detectors.x]\nband = "f090"', "detector x: is incomplete or corrupt: quat"),
        "d.toml": ("= [", "cannot be read as hardware"),
        "e.toml": (
            '[detectors.x]\nband = "f"\nquat = [0, 0, 0, "1+"]',
            "detector x: cannot be read as hardware",
        ),
    }
    for name, (text, said) in texts.items():
        (folder / name).write_text(text)
        found.append((folder / name, said))
    return found


def test_faults_are_named(tmp_path: Path) -> None:
    for path, said in faults(tmp_path):
        with pytest.raises(InputError, match=said):
            read_array(path)


def test_headers_that_unfold_are_refused(tmp_path: Path) -> None:
    """YAML of a kilobyte with aliases of aliases: 10^9 values."""
    path = toast_file(tmp_path / "fp.h5")
    text = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    text += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 9)]
    with h5py.File(path, "a") as file:
        name = "focalplane.__table_column_meta__"
        lines = [*file[name][:], *(line.encode() for line in text)]
        del file[name]
        file.create_dataset(name, data=lines)
    with pytest.raises(InputError, match="unfold to more than"):
        read_array(path)
