"""Recorded data: a saved run gives its map again; skies are injected, twins simulated beside it;
bad files are refused.
"""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from astropy.io import fits

import zonda
import zonda.testing
from zonda.core.configuration.pipeline_file import parse
from zonda.core.errors import InputError, PipelineError, ZondaError
from zonda.core.flags import INVALID, SUN_UP, TURNAROUND
from zonda.core.testing import Given, Points, made_up_scene
from zonda.operators.io.recorded_stream import kelvin_per
from zonda.operators.io.save_tod import load_tod, save_tod
from zonda.plugins.checks.scenes import sky_file

pytestmark = pytest.mark.filterwarnings("ignore:Pointing")

SCENE = {
    "site": "green_bank",
    "instrument": {"like": "mustang2", "detectors": 19},
    "time": "2024-11-25T07:00",
    "target": "05h00m00s +20d00m00s",
    "seed": 3,
}
SCAN = {"radius": "1 arcmin", "scan_duration": "40 s", "sample_rate": "50 Hz"}
AIR = [
    zonda.AtmosphereLayers(pwv="5 mm", layers=2),
    zonda.WhiteNoise(),
    zonda.PinkNoise(),
    zonda.Efficiency(),
]
MAP = zonda.BinMap(pixel="5 arcsec")
PLANES = ("hits", "weights", "noise")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: Any) -> dict[str, Any]:
    """A run of two scans whose streams are saved behind the filters, in both formats, and as they
    were before.
    """
    folder = tmp_path_factory.mktemp("saved")
    steps = [
        zonda.PointingDaisy(scans=2, **SCAN),
        *AIR,
        zonda.SaveTOD(name="Raw"),
        zonda.HighpassFilter(frequency="0.1 Hz"),
        zonda.CommonModeFilter(),
        zonda.SaveTOD(name="Filtered"),
        zonda.SaveTOD(name="Fits", format="fits"),
        MAP,
    ]
    data = zonda.Pipeline(steps).run(zonda.Scene(**SCENE), output=folder, threads=1)
    files = {name: sorted(folder.glob(f"tod_{name}_*")) for name in ("Raw", "Filtered", "Fits")}
    return {"data": data, "map": data["map"], **files}


def load(files: Any, *steps: Any, **more: Any) -> Any:
    step = zonda.LoadTOD(file=files, **more.pop("load", {}))
    settings = {k: more.pop(k) for k in ("precision", "runs") if k in more}
    return zonda.Pipeline([step, *steps], **settings).run(
        step.scene(seed=3), threads=more.pop("threads", 1), **more
    )


@pytest.mark.parametrize("name", ["Filtered", "Fits"])
def test_the_saved_map_comes_back(saved: Any, name: str) -> None:
    found, expected = load(saved[name], MAP)["map"], saved["map"]
    for plane in PLANES:
        np.testing.assert_array_equal(
            getattr(found, plane), getattr(expected, plane), err_msg=plane
        )
    assert found.wcs.to_header_string() == expected.wcs.to_header_string()
    # filtered samples are some mK: float32 keeps them to 1e-9 K
    np.testing.assert_allclose(found.signal, expected.signal, rtol=0, atol=1e-8)
    assert np.nanstd(expected.signal) > 1e-4


def test_tens_of_kelvin_keep_their_nanokelvins(saved: Any) -> None:
    data = load(saved["Raw"][0], MAP, precision="float64", keep=["signal"])
    tod = load_tod(saved["Raw"][0])
    assert tod.streams["signal"].min() > 20
    np.testing.assert_allclose(
        data.tod("signal"), tod.streams["signal"], rtol=0, atol=1e-13
    )  # one rounding of 30 K
    single = load(saved["Raw"][0], MAP)["map"].signal
    # float32 holds what stands above each detector's level, below 0.5 K, to 2^-25 of it
    np.testing.assert_allclose(single, data["map"].signal, rtol=0, atol=0.5 * 2**-24)


def test_the_file_is_the_scene(saved: Any) -> None:
    data = load(saved["Filtered"], MAP)
    first, original = data.observations[0], saved["data"].observations[0]
    for name in ("seconds", "boresight_azel", "boresight_radec", "flags", "detector_flags"):
        np.testing.assert_array_equal(getattr(first, name), getattr(original, name), err_msg=name)
    for name in ("xi", "eta", "net", "knee", "slope", "main_beam_efficiency"):
        np.testing.assert_array_equal(
            getattr(first.focalplane, name), getattr(original.focalplane, name), err_msg=name
        )
    assert first.focalplane.names == original.focalplane.names
    assert first.start == original.start
    assert first.centre == original.centre
    assert first.intervals == original.intervals
    assert first.weather == load_tod(saved["Filtered"][0]).weather
    scene = data.scene
    assert (scene.site.latitude, scene.site.climatology) == (original.site.latitude, "green_bank")
    assert scene.instrument.telescope.diameter == 100
    assert scene.instrument.band.centre == pytest.approx(original.instrument.band.centre, rel=1e-12)


@pytest.mark.parametrize(("threads", "memory"), [(2, 1 << 30), (3, 8_000_000), (1, 5_000_000)])
def test_same_bits_for_all_blocks_and_threads(saved: Any, threads: int, memory: int) -> None:
    steps = [zonda.HighpassFilter(frequency="0.1 Hz"), zonda.CommonModeFilter(), MAP]
    one = load(saved["Raw"], *steps)["map"]
    other = load(saved["Raw"], *steps, threads=threads, memory=memory)["map"]
    for plane in ("signal", *PLANES):
        np.testing.assert_array_equal(getattr(one, plane), getattr(other, plane), err_msg=plane)


def test_no_polarized_map_of_detectors_without_angles(saved: Any) -> None:
    with pytest.raises(
        PipelineError,
        match=r"state angles and efficiencies in the focal plane of the file \(HDF5: gamma",
    ):
        load(saved["Filtered"], zonda.BinMap(pixel="5 arcsec", stokes="IQU"))


def test_a_filter_acts_on_the_stream_that_was_saved(saved: Any) -> None:
    """The level that stands beside the stream is constant: removing it analytically is what the
    filter does to it.
    """
    tod = load_tod(saved["Raw"][0])
    data = load(
        saved["Raw"][0],
        zonda.HighpassFilter(frequency="0.1 Hz"),
        MAP,
        precision="float64",
        keep=["signal"],
    )
    shifted = tod.streams["signal"] - 25.0
    tod.streams["signal"] = shifted
    path = save_tod(saved["Raw"][0].with_name("shifted.h5"), tod)
    other = load(
        path, zonda.HighpassFilter(frequency="0.1 Hz"), MAP, precision="float64", keep=["signal"]
    )
    np.testing.assert_allclose(
        data.tod("signal"), other.tod("signal"), rtol=0, atol=1e-11
    )  # transforms of 40 s of 0.1 K


def test_a_sky_is_injected(saved: Any) -> None:
    """The map with a sky in the real stream, minus the map without it, is the map of the sky alone;
    filters are linear.
    """
    y, x = np.mgrid[-40:40, -40:40]
    with sky_file(1e-2 * np.exp(-(x**2 + y**2) / 200), pixel=2.0) as path:
        sky = zonda.SkyMap(file=path)
        steps = [sky, zonda.HighpassFilter(frequency="0.1 Hz"), zonda.CommonModeFilter(), MAP]
        data = load(
            saved["Raw"],
            *steps,
            runs={"sky": {"only": ["sky"], "modes": "full"}, "real": {"only": ["recorded"]}},
        )
        both = load(saved["Raw"], *steps, runs={"rest": {"without": ["sky"], "modes": "full"}})
    alone, rest, total = data["sky/map"].signal, both["rest/map"].signal, both["map"].signal
    assert np.nanmax(alone) > 1e-3
    np.testing.assert_allclose(
        total - rest, alone, rtol=0, atol=2e-7
    )  # float32 streams of up to 1 K behind the filters
    assert np.nanmax(np.abs(data["real/map"].signal - rest)) < np.nanmax(
        np.abs(alone)
    )  # other modes, the same data


def test_a_twin_on_the_real_pointing(saved: Any) -> None:
    """White noise of the file's NET: map noise is sigma / sqrt(hits), to the standard error of as
    many pixels.
    """
    step = zonda.LoadTOD(file=saved["Raw"], signal="none")
    data = zonda.Pipeline([step, zonda.WhiteNoise(), zonda.Efficiency(), MAP]).run(
        step.scene(seed=8), threads=1
    )
    found = data["map"]
    np.testing.assert_array_equal(found.hits, saved["map"].hits)
    good = found.hits > 20
    ratio = found.signal[good] / found.noise[good]
    assert abs(ratio.var() - 1) < 5 * np.sqrt(2 / good.sum())


def test_a_twin_has_the_noise_of_each_detector(saved: Any, tmp_path: Path) -> None:
    """Knees and NETs of a table: the rms of pink noise of slope 1 goes as NET sqrt(knee), times
    numbers drawn alike.
    """
    names = [f"d{k:02d}" for k in range(19)]
    found = {}
    for which, knee in {"one": np.full(19, 1.0), "own": np.arange(19) / 4}.items():
        table = tmp_path / f"{which}.ecsv"
        rows = [f"{name} {1e-3 * (1 + k)} {knee[k]} 1.0" for k, name in enumerate(names)]
        columns = "net, unit: K s(1/2)", "knee, unit: Hz", "slope"
        head = ["# %ECSV 1.0", "# ---", "# datatype:", "# - {name: name, datatype: string}"]
        head += [f"# - {{name: {column}, datatype: float64}}" for column in columns]
        table.write_text("\n".join([*head, "name net knee slope", *rows]) + "\n")
        step = zonda.LoadTOD(file=saved["Raw"][0], signal="none", noise=table)
        steps = [step, zonda.WhiteNoise(), zonda.PinkNoise(), zonda.Efficiency()]
        found[which] = (
            zonda.Pipeline(steps).run(step.scene(seed=8), threads=1, keep=["pink"]).tod("pink")
        )
    expected = found["one"] * np.sqrt(np.arange(19) / 4)[:, None]
    np.testing.assert_allclose(
        found["own"], expected, rtol=0, atol=1e-6 * np.abs(expected).max()
    )  # float32
    assert found["one"].std(axis=1)[18] > 5 * found["one"].std(axis=1)[0]


def test_the_real_data_and_the_twin_in_one_pass(saved: Any) -> None:
    step = zonda.LoadTOD(file=saved["Raw"])
    steps = [step, *AIR, MAP]
    runs = {"real": {"only": ["recorded"]}, "twin": {"without": ["recorded"]}}
    data = zonda.Pipeline(steps, runs=runs).run(step.scene(seed=3), threads=1)
    np.testing.assert_array_equal(data["real/map"].signal, load(saved["Raw"], MAP)["map"].signal)
    twin, real = (np.nanmedian(data[f"{name}/map"].signal) for name in ("twin", "real"))
    assert real > 20
    assert abs(twin / real - 1) < 0.02, (
        twin,
        real,
    )  # the same weather seen in a flat band of the same width


@pytest.mark.parametrize("celestial", [None, "recomputed"])
def test_directions_on_the_sky(saved: Any, celestial: Any) -> None:
    data = load(saved["Filtered"], MAP, load={"celestial": celestial})
    expected = saved["data"].observations[1].boresight_radec
    assert turned(data.observations[1].boresight_radec, expected) < (4.4e-8 if celestial else 1e-30)


def turned(a: Any, b: Any) -> float:
    """Largest angle between rotations (n, 4), rad. Both may be interpolated to 1e-3 of a beam of 9
    arcsec, 4.4e-8 rad.
    """
    return 2 * float(np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1)).max())


def changed(path: Path, to: Path, change: Any) -> Path:
    to.write_bytes(path.read_bytes())
    with h5py.File(to, "a") as file:
        change(file)
    return to


def test_a_rotated_boresight_and_what_only_one_frame_has(saved: Any, tmp_path: Path) -> None:
    def turn(file: Any) -> None:
        half = 0.3 / 2
        for name in ("boresight_azel", "boresight_radec"):
            x, y, z, w = file[f"shared/{name}"][:].T
            c, s = np.cos(half), np.sin(half)
            file[f"shared/{name}"][...] = np.stack(
                [x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s], axis=1
            )

    path = changed(saved["Filtered"][0], tmp_path / "turned.h5", turn)
    whole = load(path, MAP).observations[0]
    for name in ("boresight_azel", "boresight_radec"):
        part = changed(
            path,
            tmp_path / f"without_{name}.h5",
            lambda file, name=name: file["shared"].__delitem__(name),
        )
        found = load(part, MAP).observations[0]
        for frame in ("boresight_azel", "boresight_radec"):
            assert turned(getattr(found, frame), getattr(whole, frame)) < 4.4e-8, (name, frame)


def test_flags_and_their_masks(saved: Any, tmp_path: Path) -> None:
    def flag(file: Any) -> None:
        file["shared/flags"][:100] = SUN_UP
        file["shared/flags"][100:150] = TURNAROUND
        flags = file["detdata/flags"][:]
        flags[3, 500:510], flags[4, 500:520] = 1, 64
        file["detdata/flags"][...] = flags
        file.attrs.modify(
            "observation_detector_flags",
            json.dumps({f"d{k:02d}": 1 if k == 6 else 0 for k in range(19)}),
        )

    path = changed(saved["Filtered"][0], tmp_path / "flagged.h5", flag)
    with h5py.File(path) as file:
        names = json.loads(file.attrs["observation_detectors"])
        n = file["shared/times"].size
    assert names == [f"d{k:02d}" for k in range(19)]
    data = load(path, MAP)
    assert data["map"].hits.sum() == 18 * (n - 50) - 10
    assert ("LoadTOD", "samples of single detectors that the file flags", "10") in [
        (a, b, c.split()[0]) for a, b, c in data.log
    ]
    every = load(path, MAP, load={"flag_mask": 4 | 32, "detector_mask": 64 | 7})
    assert every["map"].hits.sum() == 18 * (n - 50) - 30
    assert load(path, MAP, load={"flag_mask": 0, "detector_mask": 0})["map"].hits.sum() == 19 * n


@pytest.mark.parametrize("memory", [5_000_000, 1 << 30])
def test_flagged_samples_are_counted_whatever_the_blocks(
    saved: Any, tmp_path: Path, memory: int
) -> None:
    """All of a detector's, where the file flags each of its samples but not the detector; none of
    those of an excluded one.
    """

    def flag(file: Any) -> None:
        flags = np.zeros(file["detdata/flags"].shape, np.uint8)
        flags[3, 500:510], flags[4], flags[6] = 1, 1, 1
        file["detdata/flags"][...] = flags
        file.attrs.modify(
            "observation_detector_flags",
            json.dumps({f"d{k:02d}": 1 if k == 6 else 0 for k in range(19)}),
        )

    path = changed(saved["Filtered"][0], tmp_path / "flagged.h5", flag)
    data = load(path, MAP, memory=memory)
    n = data.observations[0].n_samples
    assert data.log.get("LoadTOD", "samples of single detectors that the file flags") == 10 + n


@pytest.mark.parametrize("format", ["hdf5", "fits"])
@pytest.mark.parametrize("how", ["SaveTOD", "save_tod"])
def test_flags_of_single_samples_go_through_either_format(
    saved: Any, tmp_path: Path, format: str, how: str
) -> None:
    """As NaN in the streams. A sample of a detector that is flagged as a whole keeps its number."""

    def flag(file: Any) -> None:
        flags = np.zeros(file["detdata/flags"].shape, np.uint8)
        flags[3, 500:510], flags[4, 100:200], flags[5, 200:300], flags[6] = 1, 4, 64, 1
        file["detdata/flags"][...] = flags
        file.attrs.modify(
            "observation_detector_flags",
            json.dumps({f"d{k:02d}": 1 if k == 6 else 0 for k in range(19)}),
        )

    flagged = changed(saved["Filtered"][0], tmp_path / "flagged.h5", flag)
    if how == "SaveTOD":
        expected = load(flagged, zonda.SaveTOD(format=format), MAP, output=tmp_path / "out")["map"]
        path = next((tmp_path / "out").glob("tod_*"))
    else:
        expected = load(flagged, MAP)["map"]
        path = save_tod(
            tmp_path / f"copy.{'h5' if format == 'hdf5' else 'fits'}", load_tod(flagged)
        )
        np.testing.assert_array_equal(
            np.isnan(load_tod(path).streams["signal"]).sum(axis=1)[:7], [0, 0, 0, 10, 100, 0, 0]
        )
    found = load(path, MAP)["map"]
    for plane in ("signal", *PLANES):
        np.testing.assert_array_equal(
            getattr(found, plane), getattr(expected, plane), err_msg=plane
        )
    assert (
        found.hits.sum()
        == load(saved["Filtered"][0], MAP)["map"].hits.sum()
        - load(flagged).observations[0].n_samples
        - 110
    )


def test_a_file_of_either_format_may_lack_azimuth_and_elevation(saved: Any, tmp_path: Path) -> None:
    """They are computed on loading; in FITS an absent column is no column of zeros."""
    whole, found = load_tod(saved["Raw"][0]), []
    for name in ("a.fits", "a.h5"):
        save_tod(tmp_path / name, replace(whole, boresight_azel=np.zeros((0, 4))))
        assert load_tod(tmp_path / name).boresight_azel.shape == (0, 4)
        found.append(load(tmp_path / name, MAP).observations[0].boresight_azel)
    np.testing.assert_array_equal(*found)
    np.testing.assert_allclose(np.abs((found[0] * whole.boresight_azel).sum(axis=1)), 1, atol=1e-12)


def test_other_units_are_kelvin(saved: Any, tmp_path: Path) -> None:
    def milli(file: Any) -> None:
        file["detdata/signal"][...] = 1e3 * file["detdata/signal"][:]
        file["detdata/signal"].attrs["units"] = "mK"

    path = changed(saved["Filtered"][0], tmp_path / "mk.h5", milli)
    one, other = (load(p, MAP)["map"].signal for p in (saved["Filtered"][0], path))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        load_tod(path).streams["signal"],
        load_tod(saved["Filtered"][0]).streams["signal"],
        rtol=1e-12,
    )
    volts = changed(
        path,
        tmp_path / "v.h5",
        lambda file: file["detdata/signal"].attrs.__setitem__("units", "pW"),
    )
    with pytest.raises(InputError, match="in 'pW', not in kelvin"):
        load(volts, MAP)


def test_a_compressed_stream(saved: Any, tmp_path: Path, monkeypatch: Any) -> None:
    flacarray = pytest.importorskip(
        "flacarray", reason="flacarray is not installed (the extra flac)"
    )
    from flacarray.hdf5 import write_array

    original = load_tod(saved["Filtered"][0]).streams["signal"]

    def compress(file: Any) -> None:
        del file["detdata/signal"]
        group = file.create_group("detdata/signal")
        write_array(original, group, quanta=1e-9, use_threads=False)
        group.attrs.update(units="K", dtype="float64")

    path = changed(saved["Filtered"][0], tmp_path / "flac.h5", compress)
    one, other = (load(p, MAP)["map"] for p in (saved["Filtered"][0], path))
    np.testing.assert_array_equal(one.hits, other.hits)
    np.testing.assert_allclose(
        one.signal, other.signal, rtol=0, atol=5e-9
    )  # samples of 0.05 K, rounded to 1e-9 K and to float32
    again = load(path, MAP, threads=2, memory=5_000_000)["map"]
    np.testing.assert_array_equal(other.signal, again.signal)
    monkeypatch.setitem(__import__("sys").modules, "flacarray.hdf5", None)
    with pytest.raises(InputError, match="compressed with FLAC") as caught:
        load(path, MAP)
    assert caught.value.cure == "pip install flacarray"
    assert flacarray


# ---- what is wrong with files


def without(name: str) -> Any:
    return lambda file: file.__delitem__(name)


def second_name(file: Any) -> None:
    names = json.loads(file.attrs["observation_detectors"])
    file.attrs.modify("observation_detectors", json.dumps([names[0], names[0], *names[2:]]))


def put(name: str, index: Any, value: float) -> Any:
    def change(file: Any) -> None:
        values = file[name][:]
        values[index] = value
        file[name][...] = values

    return change


def table(name: str, value: float) -> Any:
    def change(file: Any) -> None:
        rows = file["instrument/focalplane"][:]
        rows[name][2] = value
        file["instrument/focalplane"][...] = rows

    return change


def as_text(name: str) -> Any:
    def change(file: Any) -> None:
        shape = file[name].shape
        del file[name]
        file[name] = np.full(shape, b"text", "S4")

    return change


def unpointed(file: Any) -> None:
    del file["shared/boresight_azel"], file["shared/boresight_radec"]


BAD = {
    "no version": (
        lambda file: file.attrs.__delitem__("toast_format_version"),
        "toast_format_version is None, not 2",
    ),
    "text": (as_text("detdata/signal"), "detdata/signal is 19 x 2000 of |S4"),
    "times are text": (as_text("shared/times"), "shared/times holds no numbers (|S4)"),
    "no boresight": (
        unpointed,
        "there is no pointing (shared/boresight_azel, shared/boresight_radec)",
    ),
    "no detectors": (
        lambda file: file.attrs.__delitem__("observation_detectors"),
        "is incomplete or corrupt",
    ),
    "no focal plane": (without("instrument/focalplane"), "there is no focal plane"),
    "no times": (without("shared/times"), "there is no times of the samples"),
    "no stream": (without("detdata/signal"), "has no stream 'signal'"),
    "older": (
        lambda file: file.attrs.modify("toast_format_version", 1),
        "toast_format_version is 1, not 2",
    ),
    "twice": (second_name, "detector 'd00' is there twice"),
    "NaN times": (put("shared/seconds", 7, np.nan), "NaN or impossible values in seconds"),
    "NaN pointing": (
        put("shared/boresight_radec", (7, 1), np.nan),
        "NaN or impossible values in boresight_radec",
    ),
    "no rotation": (
        put("shared/boresight_azel", (7, slice(None)), 0.0),
        "boresight_azel is no rotation at sample 7",
    ),
    "back in time": (put("shared/seconds", 7, 0.0), "the times do not increase at sample 7"),
    "NaN beam": (table("fwhm", np.nan), "fwhm of detector d02 is nan"),
    "no beam": (table("fwhm", 0.0), "fwhm of detector d02 is 0"),
    "NaN noise": (table("psd_net", np.nan), "net of detector d02 is nan"),
    "NaN position": (table("quat", np.nan), "NaN or impossible values in quats"),
    "impossible band": (table("bandwidth", 1e9), None),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_named_with_a_cure(saved: Any, tmp_path: Path, what: str) -> None:
    change, message = BAD[what]
    path = changed(saved["Filtered"][0], tmp_path / "bad.h5", change)
    if message is None:  # the median of all detectors is what counts
        load(path, MAP)
        return
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load(path, MAP)
    assert "bad.h5" in caught.value.place
    assert caught.value.cure


def attribute(path: Path, where: str, name: str, value: Any) -> Path:
    """A copy of a file with another attribute, or card of the extension ``where``."""
    made = path.with_name(f"bad{path.suffix}")
    shutil.copy(path, made)
    if path.suffix == ".fits":
        with fits.open(made, mode="update") as hdus:
            hdus[where].header[name] = value
        return made
    with h5py.File(made, "r+") as file:
        del file[where].attrs[name]
        file[where].attrs[name] = value
    return made


@pytest.mark.parametrize(
    ("where", "name", "value", "match"),
    [
        ("PRIMARY", "SAMPRATE", "fast", "sample_rate is 'fast', not 1e-09 to 1e+09"),
        ("PRIMARY", "SAMPRATE", -1.0, "sample_rate is -1.0"),
        ("PRIMARY", "OBJECT", 7, "name is 7"),
        ("PRIMARY", "DATE-OBS", "now", "start: cannot read 'nowZ' as a time"),
        ("PRIMARY", "SITELAT", 91.0, "latitude is "),
        ("PRIMARY", "SITEALT", True, "altitude is True"),
        ("TOD", "TTYPE1", "", "cannot be read as FITS"),
        ("TOD", "TUNIT2", 7, "signal is in '7', not in kelvin"),
        ("metadata/other", "zonda_centre_ra", -np.inf, "centre_ra is -inf"),
        ("metadata/other", "zonda_centre_ra", np.array([1.0, 2.0]), "centre_ra is array("),
        ("metadata/other", "zonda_telescope_diameter", "wide", "telescope_diameter is 'wide'"),
        ("metadata/other", "zonda_seed", np.zeros(2), "seed is array("),
        ("metadata/other", "zonda_start_utc", 5.0, "start: cannot read '5.0' as a time"),
        ("instrument", "weather_time", np.nan, "weather time is nan"),
        ("instrument", "weather_pwv", "1 10**9999999 m", "cannot be read as HDF5"),
        ("instrument", "site_lat_deg", np.array([1.0, 2.0]), "cannot be read as HDF5"),
    ],
)
def test_what_a_file_states_is_checked(
    saved: Any, where: str, name: str, value: Any, match: str
) -> None:
    of_fits = where in ("PRIMARY", "TOD")
    path = attribute(saved["Fits" if of_fits else "Filtered"][0], where, name, value)
    with pytest.raises(InputError, match=re.escape(match)) as caught:
        load(path, MAP)
    assert path.name in caught.value.place
    path.unlink()


@pytest.mark.parametrize("column", ["net", "fwhm", "knee", "slope", "polarization_angle"])
def test_what_is_not_known_of_a_flagged_detector_does_not_matter(
    saved: Any, tmp_path: Path, column: str
) -> None:
    """As the message about one that is not flagged advises."""
    tod = load_tod(saved["Filtered"][0])
    tod.detector_flags[2] |= INVALID
    whole = load(save_tod(tmp_path / "flagged.h5", tod), MAP)
    tod.columns[column][2] = np.nan
    found = load(save_tod(tmp_path / "unknown.h5", tod), MAP)
    np.testing.assert_array_equal(found["map"].signal, whole["map"].signal)
    np.testing.assert_array_equal(found["map"].noise, whole["map"].noise)


def test_a_scan_of_which_nothing_is_used(saved: Any, tmp_path: Path) -> None:
    """It adds nothing to the map of the others."""
    tod = load_tod(saved["Filtered"][0])
    tod.detector_flags |= INVALID
    none = save_tod(tmp_path / "none.h5", tod)
    assert load(none, MAP)["map"].hits.sum() == 0
    found, whole = load([saved["Filtered"][0], none], MAP), load(saved["Filtered"][0], MAP)
    np.testing.assert_array_equal(found["map"].signal, whole["map"].signal)


@pytest.mark.parametrize("suffix", [".h5", ".fits"])
@pytest.mark.parametrize("share", [0.1, 0.6, 0.99])
def test_truncated_files(saved: Any, tmp_path: Path, suffix: str, share: float) -> None:
    whole = saved["Filtered" if suffix == ".h5" else "Fits"][0].read_bytes()
    path = tmp_path / f"short{suffix}"
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError) as caught:
        load(path, MAP)
    assert path.name in caught.value.place
    assert caught.value.cure


def test_nan_in_a_stream_is_dropped_and_counted(saved: Any, tmp_path: Path) -> None:
    path = changed(
        saved["Filtered"][0], tmp_path / "nan.h5", put("detdata/signal", (3, slice(20, 31)), np.nan)
    )
    data, whole = load(path, MAP), load(saved["Filtered"][0], MAP)
    assert whole["map"].hits.sum() - data["map"].hits.sum() == 11


def test_two_scans_of_one_name_and_two_instruments(saved: Any, tmp_path: Path) -> None:
    tod = load_tod(saved["Filtered"][0])
    tod.start = tod.start.replace("T07:00", "T08:00")
    later = save_tod(tmp_path / "later.h5", tod)
    data = load([saved["Filtered"][0], later], MAP)
    assert [o.name for o in data.observations] == ["scan-000", "scan-000.2"]
    other = changed(
        later,
        tmp_path / "o.h5",
        lambda file: file["instrument"].attrs.__setitem__("telescope_name", "other"),
    )
    with pytest.raises(InputError, match="was recorded with other"):
        load([saved["Filtered"][0], other], MAP)


# ---- pipeline files

LOADED = "operators:\n  - LoadTOD: {{file: {file}}}\n  - BinMap: {{pixel: 5 arcsec}}\n  - SaveMap\n"


def test_a_pipeline_file_needs_neither_site_nor_instrument(saved: Any, tmp_path: Path) -> None:
    text = LOADED.format(file=saved["Filtered"][0])
    file = parse(text)
    assert file.scene().instrument.telescope.diameter == 100
    assert str(file.scene().time) == "2024-11-25T07:00:00Z"
    again = parse(file.resolved_yaml())
    assert again.scene().model_dump() == file.scene().model_dump()
    data = file.pipeline().run(file.scene(), output=tmp_path, threads=1)
    assert data["map"].hits.sum() == 19 * 2000
    camera = data.observations[0].instrument
    assert camera == parse(text).scene().instrument
    assert camera != camera.model_copy(update={"name": "another"})
    reported = parse(text + "  - Report\n")
    reported.pipeline().run(reported.scene(), output=tmp_path, threads=1)
    assert "mustang2" in (tmp_path / "report.html").read_text()
    with pytest.warns(
        UserWarning,
        match="instrument is that of the recorded data, .*; atlast of this file gives what",
    ):
        other = parse("instrument: atlast\nsite: green_bank\n" + text)
    assert other.scene().instrument.telescope.diameter == 100


def test_mistakes_of_such_a_file_have_their_place(saved: Any, tmp_path: Path) -> None:
    short = tmp_path / "short.h5"
    short.write_bytes(saved["Filtered"][0].read_bytes()[:5000])
    with pytest.raises(ZondaError, match=r"short.h5.*\n"):
        parse(LOADED.format(file=short))
    file = parse("time: 2024-11-26T07:00\n" + LOADED.format(file=saved["Filtered"][0]))
    with pytest.raises(
        ZondaError, match="begins 2024-11-25T07:00:00Z, the scene 2024-11-26"
    ) as caught:
        file.pipeline().run(file.scene(), output=tmp_path)
    assert "nights" in str(caught.value)


def test_it_keeps_the_contract(tmp_path: Path) -> None:
    zonda.Pipeline([Points(), Given(), zonda.SaveTOD()]).run(
        made_up_scene(), output=tmp_path, threads=1
    )
    (path,) = tmp_path.glob("tod_*.h5")
    zonda.testing.check_operator(zonda.LoadTOD(file=path))


def test_a_campaign_of_two_nights_refuses_recorded_data(
    saved: Any, tmp_path: Path, capsys: Any
) -> None:
    from zonda.core import cli

    path = tmp_path / "nights.yaml"
    path.write_text(LOADED.format(file=saved["Filtered"][0]) + "campaign: {nights: {count: 2}}\n")
    assert cli.main(["run", str(path), "--output", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert "recorded data are of one night" in err
    assert "leave time out of the pipeline, and nights out of a campaign" in err


def test_realizations_of_recorded_data_are_refused(saved: Any, tmp_path: Path, capsys: Any) -> None:
    """They would have the same bits; those of a twin are drawn anew."""
    from zonda.core import cli

    path = tmp_path / "many.yaml"
    text = LOADED.format(file=saved["Filtered"][0]) + "campaign: {realizations: 2}\n"
    path.write_text(text)
    for command in (["check", str(path)], ["run", str(path), "--output", str(tmp_path / "out")]):
        assert cli.main(command) == 2
        err = capsys.readouterr().err
        assert "the same in every realization" in err
        assert "leave realizations out, or simulate a twin" in err
    path.write_text(
        text.replace(".h5}", ".h5, signal: none}").replace(
            "  - BinMap", "  - WhiteNoise\n  - Efficiency\n  - BinMap"
        )
    )
    assert cli.main(["check", str(path)]) == 0


def test_what_is_no_number_is_flagged_in_the_file(saved: Any, tmp_path: Path) -> None:
    """TOAST's map makers and filters know flags, and no NaN."""
    bad = changed(
        saved["Filtered"][0], tmp_path / "nan.h5", put("detdata/signal", (3, slice(20, 31)), np.nan)
    )
    step = zonda.LoadTOD(file=bad)
    zonda.Pipeline([step, zonda.SaveTOD()]).run(step.scene(), output=tmp_path / "out", threads=1)
    with h5py.File(next((tmp_path / "out").glob("tod_*"))) as file:
        flags, signal = file["detdata/flags"][:], file["detdata/signal"][:]
    expected = np.zeros_like(flags)
    expected[3, 20:31] = 1
    np.testing.assert_array_equal(flags, expected)
    np.testing.assert_array_equal(np.isnan(signal), expected == 1)


@pytest.mark.parametrize("what", sorted(name for name in BAD if BAD[name][1]))
def test_the_command_line_refuses_bad_files(
    saved: Any, tmp_path: Path, capsys: Any, what: str
) -> None:
    """Exit code 2, with file, cause and cure, and no traceback."""
    from zonda.core import cli

    change, message = BAD[what]
    changed(saved["Filtered"][0], tmp_path / "bad.h5", change)
    (tmp_path / "p.yaml").write_text(LOADED.format(file="bad.h5"))
    assert cli.main(["check", str(tmp_path / "p.yaml")]) == 2
    err = " ".join(capsys.readouterr().err.split())
    assert message in err
    assert "bad.h5" in err
    assert "= " in err
    assert "Traceback" not in err


def test_the_command_line_shows_the_step_of_a_bad_file(
    saved: Any, tmp_path: Path, capsys: Any
) -> None:
    from zonda.core import cli

    (tmp_path / "short.h5").write_bytes(saved["Filtered"][0].read_bytes()[:9000])
    (tmp_path / "p.yaml").write_text(LOADED.format(file="short.h5"))
    assert cli.main(["check", str(tmp_path / "p.yaml")]) == 2
    err = capsys.readouterr().err
    assert "p.yaml:2:5" in err
    assert "truncated" in err
    assert "Traceback" not in err


def test_a_stream_that_is_no_temperature_is_refused(saved: Any, tmp_path: Path) -> None:
    """In any part of the scan, with the file, the detector and the sample; not where the file flags
    it.
    """
    import h5py

    path = Path(shutil.copy(saved["Filtered"][0], tmp_path / "bad.h5"))
    with h5py.File(path, "a") as file:
        file["detdata/signal"][2, 777] = -1e102
    with pytest.raises(
        InputError, match=r"bad\.h5: the stream signal is -1e\+102 K at sample 777 of detector"
    ):
        load(path, MAP)
    with h5py.File(path, "a") as file:
        file["shared/flags"][777] = 1
    assert np.isfinite(load(path, MAP)["map"].signal).any()


@pytest.mark.parametrize(
    ("unit", "kelvin"),
    [
        ("K", 1.0),
        ("mK", 1e-3),
        (" K_CMB ", 1.0),
        ("mK_CMB", 1e-3),
        ("uK_RJ", 1e-6),
        ("mJy", None),
        ("pW", None),
        ("", None),
    ],
)
def test_prefixes_of_kelvin_count_on_either_scale(unit: str, kelvin: float | None) -> None:
    assert kelvin_per(unit) == (None if kelvin is None else pytest.approx(kelvin, rel=1e-12))
