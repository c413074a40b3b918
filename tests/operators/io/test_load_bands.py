"""Recorded data of cameras with several bands: one run gives the maps of all of them, each as it is
alone.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from astropy.io import fits

import zonda
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.pipeline_file import parse
from zonda.core.errors import InputError, PipelineError
from zonda.core.flags import INVALID
from zonda.operators.io.save_tod import load_tod, save_tod

pytestmark = pytest.mark.filterwarnings("ignore:Pointing")

CAMERA = {
    "name": "camera",
    "telescope": {"name": "dish", "diameter": "6 m"},
    "bands": [
        {
            "name": "f090",
            "low": "77 GHz",
            "high": "106 GHz",
            "net": "300 uK s(1/2)",
            "detectors": 7,
            "knee": "0.3 Hz",
        },
        {
            "name": "f150",
            "low": "130 GHz",
            "high": "170 GHz",
            "net": "360 uK s(1/2)",
            "detectors": 12,
            "fwhm": "1.5 arcmin",
        },
    ],
    "pixels": "overlaid",
    "field_of_view": "1 deg",
    "main_beam_efficiency": 0.7,
    "illumination_efficiency": 0.9,
    "sample_rate": "40 Hz",
}
SCENE = {
    "site": "atacama",
    "instrument": CAMERA,
    "time": "2024-06-25T07:00",
    "target": "az 180 deg el 50 deg",
    "seed": 1,
}
SCAN = {
    "throw": "4 deg",
    "speed": "1 deg/s",
    "acceleration": "1 deg/s2",
    "scan_duration": "30 s",
    "check_limits": "warn",
}
MAP = zonda.BinMap(pixel="5 arcmin")
PLANES = ("signal", "hits", "weights", "noise")


@pytest.fixture(scope="module")
def night(tmp_path_factory: Any) -> Any:
    """Two scans of two bands, each saved to a file of its own, behind a filter."""
    folder = tmp_path_factory.mktemp("night")
    steps = [
        zonda.PointingBackAndForth(scans=2, **SCAN),
        zonda.AtmosphereLayers(layers=1),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="0.2 Hz"),
        zonda.SaveTOD(),
        MAP,
    ]
    data = zonda.Pipeline(steps).run(zonda.Scene(**SCENE), output=folder, threads=1)
    return data, sorted(folder.glob("tod_*"))


def load(file: Any, *steps: Any, scene: Any = None, threads: int = 1, **load: Any) -> Any:
    step = zonda.LoadTOD(file=file, **load)
    return zonda.Pipeline([step, *(steps or (MAP,))]).run(scene or step.scene(), threads=threads)


def one_file(files: list[Path], to: Path) -> Path:
    """A scan's bands in one file, as other packages write them."""
    tods = [load_tod(path) for path in files]
    first = tods[0]
    for name in ("quats", "offsets", "detector_flags"):
        setattr(first, name, np.concatenate([getattr(tod, name) for tod in tods]))
    first.names = [name for tod in tods for name in tod.names]
    first.columns = {
        name: np.concatenate([tod.columns[name] for tod in tods]) for name in first.columns
    }
    first.streams = {"signal": np.concatenate([tod.streams["signal"] for tod in tods])}
    first.name, first.metadata = "whole", {k: v for k, v in first.metadata.items() if k != "band"}
    return save_tod(to, first)


def same(one: Any, other: Any, planes: tuple[str, ...] = PLANES) -> None:
    for plane in planes:
        np.testing.assert_array_equal(getattr(one, plane), getattr(other, plane), err_msg=plane)


def test_the_saved_night_gives_the_maps_of_both_bands(night: Any) -> None:
    data, files = night
    found = load(files)
    assert [o.name for o in found.observations] == [o.name for o in data.observations]
    for band in ("f090", "f150"):
        one, other = found[f"map_{band}"], data[f"map_{band}"]
        same(one, other, PLANES[1:])
        assert one.wcs.to_header_string() == other.wcs.to_header_string()
        np.testing.assert_allclose(
            one.signal, other.signal, rtol=0, atol=1e-8
        )  # filtered samples of millikelvins in float32
        assert np.nanstd(other.signal) > 1e-5
    camera = found.scene.instrument
    assert {name: (c.band.low, c.band.high) for name, c in camera.cameras.items()} == {
        "f090": (77e9, 106e9),
        "f150": (130e9, 170e9),
    }
    assert {name: (c.detectors, c.knee, c.fwhm) for name, c in camera.cameras.items()} == {
        name: (c.detectors, c.knee, pytest.approx(c.beam_fwhm))
        for name, c in data.scene.instrument.cameras.items()
    }


def test_order_of_files_and_threads_change_nothing(night: Any) -> None:
    _, files = night
    one = load(files)
    for other in (load(files[::2] + files[1::2]), load(files, threads=2)):
        for band in ("f090", "f150"):
            same(one[f"map_{band}"], other[f"map_{band}"])


def test_a_band_has_the_bits_that_it_has_alone(night: Any, tmp_path: Path) -> None:
    _, files = night
    whole = [one_file(files[2 * k : 2 * k + 2], tmp_path / f"{k}.h5") for k in range(2)]
    steps = [zonda.HighpassFilter(frequency="0.5 Hz"), zonda.CommonModeFilter(), MAP]
    both, apart = load(whole, *steps), load(files, *steps)
    for number, (name, centre) in enumerate(
        {"f092": "92 GHz", "f150": "150 GHz"}.items()
    ):  # named by their centres
        alone = load(whole, *steps, band=centre)
        same(alone["map"], both[f"map_{name}"])
        own = ("f090", "f150")[number]
        same(alone["map"], apart[f"map_{own}"])
        same(alone["map"], load(files, *steps, band=centre)["map"])
        same(alone["map"], load(files[number::2], *steps)["map"])


def test_a_beam_of_a_band_that_is_not_used_may_be_unknown(night: Any, tmp_path: Path) -> None:
    _, files = night
    whole = load_tod(one_file(files[:2], tmp_path / "whole.h5"))
    whole.columns["fwhm"][whole.columns["band_centre"] < 100e9] = np.nan
    same(
        load(save_tod(tmp_path / "unknown.h5", whole), band="150 GHz")["map"], load(files[1])["map"]
    )


def test_filtered_streams_go_on_into_the_next_filter(night: Any) -> None:
    """No mean of tens of kelvin is in them."""
    _, files = night
    found = load(files, zonda.CommonModeFilter(), MAP)
    assert found["map_f090"].hits.sum() == load(files)["map_f090"].hits.sum()


def test_scans_that_state_no_band_are_all_used(night: Any, tmp_path: Path) -> None:
    """Whatever band is chosen: it is the scene's."""
    _, files = night
    bare = []
    for k, file in enumerate(files[1::2]):
        tod = load_tod(file)
        for name in ("band_centre", "band_width"):
            del tod.columns[name]
        bare.append(save_tod(tmp_path / f"bare{k}.h5", tod))
    scene = zonda.Scene(**{**SCENE, "instrument": zonda.Scene(**SCENE).instrument.cameras["f150"]})
    assert len(load(bare, scene=scene, band="150 GHz").observations) == 2


def test_two_bands_of_one_name(night: Any, tmp_path: Path) -> None:
    _, files = night
    whole = load_tod(one_file(files[:2], tmp_path / "whole.h5"))
    centre = whole.columns["band_centre"]
    centre[:] = np.where(centre < 100e9, np.where(np.arange(len(centre)) < 3, 20e9, 26.6e9), 27.4e9)
    whole.columns["band_width"][:] = 0.1e9
    with pytest.raises(InputError, match="several bands are called f027"):
        load(save_tod(tmp_path / "alike.h5", whole))


def test_another_instrument_in_the_scene_is_not_used(night: Any) -> None:
    _, files = night
    scene = zonda.Scene(site="green_bank", instrument="mustang2", time="2024-06-25T07:00")
    found = load(files, scene=scene)
    same(found["map_f150"], load(files)["map_f150"])
    assert (
        "LoadTOD",
        "instrument",
        "camera, the file's; the scene's mustang2 gives what it does not state",
    ) in list(found.log)


def test_every_band_has_the_flags_of_its_file(night: Any, tmp_path: Path) -> None:
    _, files = night
    tod = load_tod(files[1])
    tod.flags[200:300] |= INVALID
    flagged = save_tod(tmp_path / "flagged.h5", tod)
    found, whole = load([files[0], flagged]), load(files[:2])
    same(found["map_f090"], whole["map_f090"])
    assert whole["map_f150"].hits.sum() - found["map_f150"].hits.sum() == 100 * 12
    what = "samples that the file's flags exclude"
    assert [found.log.get(f"LoadTOD {band}", what) for band in ("f090", "f150")] == [0, 100]
    twin = load([files[0], flagged], zonda.WhiteNoise(), zonda.Efficiency(), MAP, signal="none")
    for band in ("f090", "f150"):
        same(twin[f"map_{band}"], found[f"map_{band}"], ("hits",))


def test_every_band_has_intervals_weather_and_plate_of_its_file(night: Any, tmp_path: Path) -> None:
    """Whichever file is first; what a filter makes of its intervals has the bits of the band
    alone.
    """
    files, changed = list(night[1][:2]), list[Path]()
    for k, file in enumerate(files):
        tod = load_tod(file)
        middle = float(tod.seconds[500 + 100 * k])
        tod.intervals = {"scanning": [(0.0, middle), (middle, float(tod.seconds[-1]))]} if k else {}
        tod.weather = replace(tod.weather, pwv=(1 + k) * 1e-3)
        tod.hwp_angle = tod.seconds * (1 + k)
        changed.append(save_tod(tmp_path / f"{k}.h5", tod))
    steps = [zonda.PolynomialFilter(order=2, interval="scanning"), MAP]
    alone = [load(file, *steps) for file in changed]
    for order in (changed, changed[::-1]):
        found = load(order, *steps)
        for k, name in enumerate(("f090", "f150")):
            one, other = found.observations[k], alone[k].observations[0]
            assert len(one.intervals["scanning"]) == 1 + k
            assert one.intervals == other.intervals
            assert one.weather == other.weather
            np.testing.assert_array_equal(one.hwp_angle, one.seconds * (1 + k))
            same(found[f"map_{name}"], alone[k]["map"])


@pytest.mark.parametrize("what", ["site", "sample rate"])
def test_bands_of_one_scan_state_the_same_place_and_rate(
    night: Any, tmp_path: Path, what: str
) -> None:
    tod = load_tod(night[1][1])
    if what == "site":
        name, latitude, longitude, altitude = tod.site
        tod.site = name, latitude, longitude, altitude + 1
    else:
        tod.sample_rate *= 1 + 1e-5
    other = save_tod(tmp_path / "other.h5", tod)
    with pytest.raises(
        InputError, match=rf"other\.h5: states another {what} than .*, not "
    ) as caught:
        load([night[1][0], other])
    assert "choose a band" in caught.value.cure
    load([night[1][0], other], band="150 GHz")


def test_every_band_says_where_its_noise_comes_from(night: Any, tmp_path: Path) -> None:
    _, files = night
    tod = load_tod(files[1])
    del tod.columns["net"]
    with_model = save_tod(tmp_path / "model.h5", tod)
    with h5py.File(with_model, "a") as file, h5py.File(files[1]) as source:
        source.copy("metadata/noise_model", file["metadata"])
    found = load([files[0], with_model])
    stated = {who: text for who, what, text in found.log if what == "noise of the detectors"}
    assert stated == {
        "LoadTOD f090": "the file's",
        "LoadTOD f150": "fitted to the file's noise_model",
    }


def test_a_twin_of_both_bands(night: Any) -> None:
    """On the recorded pointing, with the NETs of the file; a band's numbers are those that it draws
    alone.
    """
    _, files = night
    steps = [zonda.WhiteNoise(), zonda.Efficiency(), MAP]
    twin, alone = load(files, *steps, signal="none"), load(files[1::2], *steps, signal="none")
    same(twin["map_f150"], alone["map"])
    for band, net in (("f090", 3e-4), ("f150", 3.6e-4)):
        found = twin[f"map_{band}"]
        good = found.hits > 20
        np.testing.assert_allclose(
            found.noise[good], net * np.sqrt(40 / found.hits[good]), rtol=1e-6
        )


def test_a_pipeline_file_is_checked_planned_and_run(night: Any, tmp_path: Path) -> None:
    from zonda.core import cli

    _, files = night
    listed = ", ".join(map(str, files))
    path = tmp_path / "bands.yaml"
    path.write_text(
        f"operators:\n  - LoadTOD: {{file: [{listed}]}}\n  - BinMap: {{pixel: 5 arcmin}}\n  -"
        " SaveMap\n"
    )
    file = parse(path.read_text())
    assert parse(file.resolved_yaml()).scene().model_dump() == file.scene().model_dump()
    for command in ("check", "plan", "run"):
        more = ["--output", str(tmp_path / "out")] if command == "run" else []
        assert cli.main([command, str(path), *more]) == 0, command
    assert (
        cli.main(["run", str(path), "--output", str(tmp_path / "workers"), "--workers", "2"]) == 0
    )
    for band in ("f090", "f150"):
        one, other = (
            fits.getdata(tmp_path / folder / f"map_{band}.fits") for folder in ("out", "workers")
        )
        np.testing.assert_array_equal(one, other)
        assert np.isfinite(one).any()


def test_a_mistake_in_the_step_does_not_ask_for_what_the_file_brings() -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse(
            "operators:\n  - LoadTOD: {file: night.h5, band: f150}\n  - BinMap: {pixel: 5 arcmin}\n"
        )
    assert [mistake.message.partition(":")[0] for mistake in caught.value.diagnostics] == [
        "LoadTOD, file",
        "LoadTOD, band",
    ]
    with pytest.raises(ConfigurationError) as caught:
        parse(
            f"operators:\n  - LoadTOD: {{file: [{__file__}, nothing.h5]}}\n  - BinMap: {{pixel: 5"
            " arcmin}\n"
        )
    assert [mistake.message.partition(":")[0] for mistake in caught.value.diagnostics] == [
        "LoadTOD, file.1"
    ]
    with pytest.raises(ConfigurationError, match="needs 'site', 'instrument', 'time'"):
        parse("operators:\n  - BinMap: {pixel: 5 kg}\n")


def test_what_does_not_fit_together(night: Any, tmp_path: Path) -> None:
    _, files = night
    with pytest.raises(InputError, match="first scan with camera at 150 GHz") as caught:
        load(files[:3])  # the second scan lacks a band
    assert "all bands of each scan" in caught.value.cure
    with pytest.raises(InputError, match="has the bands f090, f150, the first scan f090") as caught:
        load([files[0], *files[2:]])
    assert "begin with a scan of all bands" in caught.value.cure
    for second in (files[1], files[2]):
        with pytest.raises(
            InputError, match=r"LoadTOD\.2: stands behind a step that has made scans"
        ) as caught:
            load(files[0], zonda.LoadTOD(file=second), MAP)  # two bands would be in one map
        assert "give all files to one LoadTOD" in caught.value.cure
    tod = load_tod(files[1])
    tod.boresight_radec = tod.boresight_radec[:, [1, 0, 3, 2]]
    elsewhere = save_tod(tmp_path / "elsewhere.h5", tod)
    with pytest.raises(InputError, match="states another boresight_radec than"):
        load([files[0], elsewhere])
    with pytest.raises(InputError, match="at 220 GHz") as caught:
        load(files, band="220 GHz")
    assert "91.5 GHz" in caught.value.cure


def test_a_file_that_is_given_twice_is_refused(night: Any, tmp_path: Path) -> None:
    """Its samples would count twice, and the noise of the map would be too small. A copy under
    another name too.
    """
    files = night[1]
    copy = tmp_path / "copy.h5"
    copy.write_bytes(files[0].read_bytes())
    for twice in ([files[0], files[0]], [files[0], files[1], copy]):
        with pytest.raises(
            InputError, match=r"the same data would count twice(.|\n)*give each file once"
        ):
            load(twice, MAP)


def test_a_pointing_step_behind_recorded_data_is_refused(night: Any) -> None:
    """Its scans would be binned as zeros."""
    with pytest.raises(
        PipelineError, match=r"PointingDaisy would add scans(.|\n)*leave PointingDaisy out"
    ):
        zonda.Pipeline([zonda.LoadTOD(file=night[1]), zonda.PointingDaisy(radius="1 deg"), MAP])


def test_dead_detectors_are_no_part_of_a_plan(night: Any, tmp_path: Path) -> None:
    """The noise that is planned for is that of the others, whatever the file states of dead
    ones.
    """
    tod = load_tod(night[1][0])
    tod.columns["net"] = np.linspace(1.0, 2.0, len(tod.names)) * 1e-4
    tod.detector_flags[[0, 3]] = INVALID
    used = np.delete(tod.columns["net"], [0, 3])
    made = zonda.plan(
        parse(
            f"operators:\n  - LoadTOD: {{file: {save_tod(tmp_path / 'dead.h5', tod)}}}\n  - BinMap:"
            " {pixel: 5 arcmin}\n"
        )
    )
    np.testing.assert_allclose(made.noise[0], np.sqrt(np.mean(used**2) * 40), rtol=1e-6)
    np.testing.assert_allclose(
        made.noise[1], 1 / np.sqrt(np.mean(1 / (used**2 * 40))) / made.noise[2] ** 0.5, rtol=0.02
    )
