"""Streams in files: every number comes back, TOAST finds what it requires, and a failure leaves
nothing.
"""

from __future__ import annotations

import errno
import json
import threading
from typing import ClassVar

import h5py
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from zonda.core.data import Block
from zonda.core.errors import InputError, OutputError
from zonda.core.flags import (
    DEAD,
    INVALID,
    IRREGULAR,
    NOT_RECORDED,
    OPAQUE,
    PROCESSING,
    SOLAR_SYSTEM_OBJECT,
    SUN_CLOSE,
    SUN_UP,
    TURNAROUND,
)
from zonda.core.numerics.quaternions import detector_quaternions
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.core.weather import GroundWeather
from zonda.operators.io import fits_table, toast_hdf5
from zonda.operators.io.save_tod import SaveTOD, load_tod, save_tod


def blocks(observation, streams, mean, detectors=16, samples=2048):
    for d in range(0, observation.n_detectors, detectors):
        for s in range(0, observation.n_samples, samples):
            ds, ss = (
                slice(d, min(d + detectors, observation.n_detectors)),
                slice(s, min(s + samples, observation.n_samples)),
            )
            yield Block(
                observation,
                ds,
                ss,
                {k: v[ds, ss].copy() for k, v in streams.items()},
                {"signal": mean},
            )


@pytest.fixture
def streams():
    noise = np.random.default_rng(1)
    return {
        k: noise.normal(0, 1e-3, (19, 5000)).astype(np.float32)
        for k in ("signal", "sky", "transmission")
    }


@pytest.fixture
def mean():
    return SmoothField.constant(np.linspace(70.0, 75.0, 19), 5000)


def write(operator, observation, data, streams, mean, threads=False, **sizes):
    state = operator.prepare(observation)
    if threads:
        workers = [
            threading.Thread(target=operator.exec, args=(b, state))
            for b in reversed(list(blocks(observation, streams, mean, **sizes)))
        ]
        for w in workers:
            w.start()
        for w in workers:
            w.join()
    else:
        for block in blocks(observation, streams, mean, **sizes):
            operator.exec(block, state)
    observation.detector_flags[3] = 1  # set while the chain ran: must be in the file
    operator.collect(data, observation, state)
    operator.finalize(data)
    (path,) = data.products["tod_file"]
    return path


def equal(a, b):
    for name, x in vars(a).items():
        y = getattr(b, name)
        if isinstance(x, dict):
            assert list(x) == list(y) or set(x) == set(y), name
            for k in x:
                np.testing.assert_array_equal(x[k], y[k], err_msg=f"{name}[{k}]")
        else:
            np.testing.assert_array_equal(x, y, err_msg=name)


@pytest.mark.parametrize("format", ["hdf5", "fits"])
@pytest.mark.parametrize("threads", [False, True])
def test_what_is_written_is_what_was_there(format, threads, make_observation, data, streams, mean):
    observation = make_observation()
    observation.log.count("SkyMap", "samples outside the input map", 3)
    operator = SaveTOD(format=format, streams=["signal", "sky", "transmission"])
    path = write(operator, observation, data, streams, mean, threads)
    tod = load_tod(path)
    np.testing.assert_array_equal(
        tod.streams["signal"],
        streams["signal"].astype(float) + mean.evaluate(slice(0, 19), slice(0, 5000)),
    )
    for name in ("sky", "transmission"):
        np.testing.assert_array_equal(tod.streams[name], streams[name])
    assert tod.streams["signal"].dtype == np.float64
    np.testing.assert_array_equal(tod.seconds, observation.seconds)
    assert tod.start == "2024-11-25T07:00:00.123456789Z"
    np.testing.assert_array_equal(tod.flags, observation.flags)
    assert tod.detector_flags.tolist() == [0, 0, 0, 1] + [0] * 15
    np.testing.assert_array_equal(tod.boresight_radec, observation.boresight_radec)
    fp = observation.focalplane
    # Directions are unit vectors rounded to 1e-16; nothing is lost beyond that
    np.testing.assert_allclose(tod.xi, fp.xi, rtol=0, atol=4e-16)
    np.testing.assert_allclose(tod.eta, fp.eta, rtol=0, atol=4e-16)
    np.testing.assert_allclose(tod.columns["net"], fp.net, rtol=1e-15)
    np.testing.assert_allclose(tod.columns["fwhm"], fp.fwhm, rtol=1e-15)
    assert tod.metadata["resolved_yaml"] == "a: 1\nb: 'é'\n"
    assert "SkyMap: samples outside the input map: 3" in tod.metadata["tally"].splitlines()
    assert tod.metadata["seed"] == 7
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("format", ["hdf5", "fits"])
def test_the_file_does_not_depend_on_blocks(format, make_observation, data, streams, mean):
    observation = make_observation()
    first = load_tod(
        write(SaveTOD(format=format), observation, data, streams, mean, detectors=16, samples=2048)
    )
    data.products.clear()
    second = load_tod(
        write(SaveTOD(format=format), observation, data, streams, mean, detectors=19, samples=5000)
    )
    equal(first, second)


@pytest.mark.parametrize("suffix", [".h5", ".fits"])
def test_load_save_load_is_equal(suffix, make_observation, data, streams, mean, tmp_path):
    format = "hdf5" if suffix == ".h5" else "fits"
    first = load_tod(
        write(
            SaveTOD(format=format, streams=["signal", "sky"]),
            make_observation(),
            data,
            streams,
            mean,
        )
    )
    second = load_tod(save_tod(tmp_path / f"again{suffix}", first))
    for exact in (
        "seconds",
        "times",
        "quats",
        "boresight_azel",
        "boresight_radec",
        "flags",
        "detector_flags",
    ):
        np.testing.assert_array_equal(getattr(first, exact), getattr(second, exact))
    for name in first.streams:
        np.testing.assert_array_equal(first.streams[name], second.streams[name])
    for name in first.columns:  # deg <-> rad and GHz <-> Hz may cost a last bit
        np.testing.assert_allclose(first.columns[name], second.columns[name], rtol=4e-16)
    assert (first.name, first.start, first.names, first.metadata) == (
        second.name,
        second.start,
        second.names,
        second.metadata,
    )
    assert first.site[0] == second.site[0]
    np.testing.assert_allclose(first.site[1:], second.site[1:], rtol=4e-16)


WEATHER = GroundWeather(1732518000.0, 1.25e-3, 57123.5, 268.25, 267.5, 1.5e-3, 5.5, -2.25)


@pytest.mark.parametrize("format", ["hdf5", "fits"])
def test_flags_intervals_and_weather(format, make_observation, data, streams, mean, tmp_path):
    """What TOAST has no bit for is invalid in the file; intervals and weather come back."""
    observation = make_observation()
    observation.flags[:] = 0
    observation.flags[:8] = [
        INVALID,
        PROCESSING,
        TURNAROUND,
        IRREGULAR,
        SUN_UP,
        SUN_CLOSE,
        OPAQUE,
        NOT_RECORDED | TURNAROUND,
    ]
    observation.detector_flags[:3] = OPAQUE, DEAD, SOLAR_SYSTEM_OBJECT
    t = observation.seconds
    observation.intervals = {
        "scanning": [(t[0], t[70]), (t[90], t[-1])],
        "turnaround": [(t[70], t[90])],
        "elnod": [],
    }
    observation.weather = WEATHER
    path = write(SaveTOD(format=format), observation, data, streams, mean)
    tod = load_tod(path)
    assert tod.flags[:9].tolist() == [1, 2, 4, 8, 16, 32, 1, 1 | 4, 0]
    assert tod.detector_flags[:5].tolist() == [1, 1, 4, 1, 0]
    assert {name: spans for name, spans in tod.intervals.items() if spans} == {
        name: spans for name, spans in observation.intervals.items() if spans
    }
    again = load_tod(save_tod(tmp_path / f"again{path.suffix}", tod))
    for name, value in vars(WEATHER).items():  # mm <-> m costs a last bit
        assert getattr(tod.weather, name) == pytest.approx(value, rel=4e-16), name
        assert getattr(again.weather, name) == pytest.approx(value, rel=8e-16), name
    assert again.intervals == tod.intervals
    assert again.flags.tolist() == tod.flags.tolist()


@pytest.mark.parametrize("format", ["hdf5", "fits"])
def test_flags_of_an_earlier_zonda(format, make_observation, data, streams, mean):
    """Its 4 was opaque, 8 dead, 16 not recorded; 2 trimmed or in a turnaround."""
    path = write(SaveTOD(format=format), make_observation(), data, streams, mean)
    sample, detector = [0, 1, 2, 4, 16, 18], [0, 1, 4, 8]
    if format == "hdf5":
        with h5py.File(path, "a") as f:
            del f["metadata/other"].attrs["zonda_flags"]
            f["shared/flags"][:6] = sample
            flags = json.loads(f.attrs["observation_detector_flags"]) | dict(
                zip(["d00", "d01", "d02", "d03"], detector, strict=True)
            )
            f.attrs["observation_detector_flags"] = json.dumps(flags)
    else:
        with fits.open(path, mode="update") as f:
            del f["SAMPLES"].header["FLAGBITS"]
            f["SAMPLES"].data["FLAGS"][:6] = sample
            f["DETECTORS"].data["FLAGS"][:4] = detector
    tod = load_tod(path)
    assert tod.flags[:6].tolist() == [0, 1, 2, 1, 1, 3]
    assert tod.detector_flags[:4].tolist() == [0, 1, 1, 1]


def test_weather_of_the_scene_where_no_step_makes_air(make_observation, data, streams, mean):
    from zonda.core.registry import sites

    for given, expected in (({"pwv": "2 mm"}, 2e-3), (None, None)):
        observation = make_observation()
        data.products.clear()
        data.scene = data.scene.model_copy(update={"site": sites.create("atacama")})
        if given:
            data.scene = data.scene.model_validate({**dict(data.scene), "weather": given})
        weather = load_tod(write(SaveTOD(), observation, data, streams, mean)).weather
        assert weather is not None
        if expected:
            assert weather.pwv == pytest.approx(
                expected, rel=1e-6
            )  # water is scaled until its column is that
        assert 5.3e4 < weather.pressure < 5.8e4  # Pa: 5060 m above the sea
        assert 0 < weather.humidity < 0.02
        assert weather.time == data.scene.time.posix


def test_weather_is_that_of_the_simulated_air(scene, tmp_path):
    """Its water, and the wind that drives its layers, not what the scene's weather would have
    had.
    """
    from zonda.core.pipeline import Pipeline
    from zonda.operators.atmosphere.layers import AtmosphereLayers
    from zonda.operators.optics.efficiency import Efficiency
    from zonda.operators.pointing.base import PointingStare

    stare = PointingStare(target={"az": "120 deg", "el": "60 deg"}, scan_duration="2 s")
    air = AtmosphereLayers(pwv="1.5 mm", wind={"speed": "10 m/s", "direction": "270 deg"}, layers=1)
    Pipeline([stare, air, Efficiency(), SaveTOD()]).run(scene, output=tmp_path, threads=1)
    weather = load_tod(tmp_path / "tod_scan-000.h5").weather
    assert weather.pwv == pytest.approx(1.5e-3, rel=1e-9)
    assert (weather.wind_east, weather.wind_north) == pytest.approx(
        (10.0, 0.0), abs=1e-12
    )  # a west wind
    assert weather.time == scene.time.posix


def test_xi_and_eta_of_sotodlib():
    """so3g's rotation_xieta: xi = -sin(theta) sin(phi), eta = -sin(theta) cos(phi), gamma = psi +
    phi. Ours are tangents.
    """
    from zonda.operators.io.time_ordered_data import TimeOrderedData

    xi, eta, angle = np.radians([[0.5, 4, -17, 0], [0, -1, 3, 0.2], [0, 30, 100, -45]])
    tod = TimeOrderedData(**dict.fromkeys(TimeOrderedData.__dataclass_fields__))
    tod.quats = detector_quaternions(np.tan(xi), np.tan(eta), angle)
    theta, phi = np.arctan(np.hypot(np.tan(xi), np.tan(eta))), np.arctan2(-np.tan(xi), -np.tan(eta))
    found = tod.xieta_sotodlib()
    expected = -np.sin(theta) * np.sin(phi), -np.sin(theta) * np.cos(phi), angle
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)
    np.testing.assert_allclose(tod.xi, np.tan(xi), rtol=1e-14, atol=1e-16)
    apart = tod.xi - found[0]  # as the docstring of `xi` states: theta^3 / 2 for small angles
    assert apart[0] == pytest.approx(3.3e-7, rel=0.01)
    assert np.degrees(apart[1]) * 3600 == pytest.approx(35, rel=0.1)
    assert np.degrees(abs(apart[2])) * 60 == pytest.approx(46, rel=0.1)


def test_float32_says_what_it_rounds(make_observation, data, streams, mean):
    observation = make_observation()
    path = write(SaveTOD(dtype="float32"), observation, data, streams, mean)
    with h5py.File(path) as f:
        assert f["detdata/signal"].dtype == np.float32
        truth = streams["signal"].astype(float) + np.linspace(70.0, 75.0, 19)[:, None]
        worst = np.abs(f["detdata/signal"][:] - truth).max()
    rows = {what: value for who, what, value in observation.log if who == "SaveTOD"}
    stated = float(rows["largest rounding to float32 [K]"])
    assert worst <= stated * 1.05  # two digits are stated
    assert stated < 1e-5


def test_detector_quaternions_follow_the_frame():
    rng = np.random.default_rng(2)
    xi, eta, angle = rng.uniform(-0.02, 0.02, (3, 50))
    x, y, z, w = detector_quaternions(xi, eta, angle * 50).T
    np.testing.assert_allclose(np.linalg.norm([x, y, z, w], axis=0), 1, rtol=4e-16)
    direction = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    expected = np.array([-eta, -xi, np.ones(50)])
    np.testing.assert_allclose(direction, expected / np.linalg.norm(expected, axis=0), atol=3e-16)
    # The polarization axis is X turned about Z by the angle, up to the tilt of the tangent plane
    # (xi^2 = 4e-4)
    axis = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)])
    np.testing.assert_allclose(axis, [np.cos(angle * 50), np.sin(angle * 50)], atol=5e-4)


ROOT = [
    "toast_format_version",
    "observation_name",
    "observation_uid",
    "observation_samples",
    "observation_detectors",
    "observation_detector_flags",
    "observation_detector_sets",
    "observation_sample_sets",
]
INSTRUMENT = [
    "toast_format_version",
    *(f"telescope_{k}" for k in ("class", "name", "uid")),
    *(f"site_{k}" for k in ("class", "name", "uid", "lat_deg", "lon_deg", "alt_m")),
]


def test_everything_that_toast_requires_is_there(make_observation, data, streams, mean):
    path = write(SaveTOD(), make_observation(), data, streams, mean)
    with h5py.File(path) as f:
        assert set(ROOT) <= set(f.attrs)
        assert f.attrs["toast_format_version"] == 2
        assert f.attrs["observation_samples"] == 5000
        assert set(INSTRUMENT) <= set(f["instrument"].attrs)
        for item in (
            "instrument/focalplane",
            "instrument/focalplane.__table_column_meta__",
            "metadata/other",
            "attr",
            "intervals/scanning",
        ):
            assert item in f
        assert f["metadata/other"].attrs["python_data_type"] == "dict"
        assert f["intervals"].attrs["times"] == "times"
        for name in ("times", "azimuth", "elevation", "boresight_azel", "boresight_radec", "flags"):
            assert f["shared"][name].attrs["comm_type"] == "column"
        assert f["shared/times"].dtype == np.float64
        assert f["detdata/signal"].attrs["units"] == "K"
        assert f["detdata/signal"].dtype == np.float64
        assert f["detdata/signal"].compression is None
        assert f["detdata/flags"].attrs["units"] == ""
        assert {"name", "quat"} <= set(f["instrument/focalplane"].dtype.names)
        meta = b"\n".join(f["instrument/focalplane.__table_column_meta__"][:]).decode()
        assert "sample_rate" in meta
        assert "field_of_view" in meta
        noise = f["metadata/noise_model"]
        frequency = noise["psds"][0]
        assert frequency[0] <= 1 / 100.0  # at or below the lowest bin of a 100 s scan
        assert frequency[-1] == pytest.approx(25.0, rel=0.01)  # within 1 % of Nyquist
        # Two-sided: NET^2 at the high end, twice that at the knee of 1 Hz
        assert np.interp(1.0, frequency, noise["psds"][1]) == pytest.approx(2e-6, rel=0.02)


def test_azimuth_and_elevation_in_the_file(make_observation, data, streams, mean):
    observation = make_observation()
    with h5py.File(write(SaveTOD(), observation, data, streams, mean)) as f:
        np.testing.assert_allclose(f["shared/azimuth"][:], observation.azimuth, atol=1e-14)
        np.testing.assert_allclose(f["shared/elevation"][:], observation.elevation, atol=1e-14)


def test_the_fits_file_opens_in_astropy(make_observation, data, streams, mean):
    path = write(SaveTOD(format="fits"), make_observation(), data, streams, mean)
    with fits.open(path) as file:
        file.verify("exception")
        assert [h.name for h in file] == [
            "PRIMARY",
            "TOD",
            "SAMPLES",
            "DETECTORS",
            "PROVENANCE",
            "INTERVALS",
        ]
        assert file[0].header["TEMPSCAL"] == "K_RJ"
        assert file["TOD"].columns["SIGNAL"].unit == "K"
    table = Table.read(path, hdu="TOD")
    assert table["SIGNAL"].shape == (19, 5000)
    assert list(table["DETECTOR"])[:2] == ["d00", "d01"]


@pytest.mark.parametrize("format", ["hdf5", "fits"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_run_leaves_nothing(format, error, make_observation, data, streams, mean):
    observation, operator = make_observation(), SaveTOD(format=format)
    state = operator.prepare(observation)
    with pytest.raises(error):  # noqa: PT012
        for k, block in enumerate(blocks(observation, streams, mean)):
            operator.exec(block, state)
            if k == 2:
                raise error
    assert list(observation.output.iterdir())  # there is a temporary file while it runs ...
    operator.discard(observation, state)
    assert list(observation.output.iterdir()) == []  # ... and none afterwards
    operator.discard(observation, state)  # a second time is harmless


@pytest.mark.parametrize("format", ["hdf5", "fits"])
def test_a_full_disk_is_an_error_with_a_cure(
    format, make_observation, data, streams, mean, monkeypatch
):
    observation, operator = make_observation(), SaveTOD(format=format)
    state = operator.prepare(observation)
    real = state.writer._file

    class Full:
        def __getattr__(self, name):
            return getattr(real, name)

        def write(self, _):
            raise OSError(errno.ENOSPC, "No space left on device")

        def __getitem__(self, _):
            raise OSError(
                "Can't write data (file write failed: errno = 28, error message = 'No space left on"
                " device')"
            )

    state.writer._file = Full()
    with pytest.raises(OutputError, match="no space left on the disk") as caught:
        operator.exec(next(iter(blocks(observation, streams, mean))), state)
    assert "free some space" in caught.value.cure
    operator.discard(observation, state)
    assert list(observation.output.iterdir()) == []


def test_a_file_in_place_of_the_folder(make_observation, tmp_path):
    observation = make_observation()
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError, match="there is a file of that name"):
        SaveTOD().prepare(observation)


def test_no_output_folder(make_observation):
    observation = make_observation()
    observation.output = None
    with pytest.raises(OutputError, match="no output folder"):
        SaveTOD().prepare(observation)


def test_a_stream_that_is_not_there(make_observation, streams, mean):
    observation, operator = make_observation(), SaveTOD(streams=["white"])
    state = operator.prepare(observation)
    with pytest.raises(OutputError, match="no stream 'white'") as caught:
        operator.exec(next(iter(blocks(observation, streams, mean))), state)
    assert "signal, sky, transmission" in caught.value.cure
    operator.discard(observation, state)


@pytest.mark.parametrize("module", [toast_hdf5, fits_table])
def test_files_that_cannot_be_read(module, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        module.Reader(tmp_path / "absent")
    (tmp_path / "text").write_text("this is neither HDF5 nor FITS\n" * 200)
    with pytest.raises(InputError, match="cannot be read as"):
        module.Reader(tmp_path / "text")


def test_an_incomplete_hdf5_file(tmp_path, make_observation, data, streams, mean):
    path = write(SaveTOD(), make_observation(), data, streams, mean)
    with h5py.File(path, "a") as f:
        del f["shared/times"]
    with pytest.raises(InputError, match="incomplete"):
        load_tod(path)
    with h5py.File(path, "a") as f:
        f.attrs["toast_format_version"] = 1
    with pytest.raises(InputError, match="toast_format_version is 1"):
        load_tod(path)


def test_one_detector_one_sample(make_observation, data):
    observation = make_observation(1)
    for format in ("hdf5", "fits"):
        data.products.clear()
        one = {"signal": np.ones((19, 1), np.float32)}
        path = write(
            SaveTOD(format=format), observation, data, one, SmoothField.constant(np.zeros(19), 1)
        )
        assert load_tod(path).streams["signal"].tolist() == [[1.0]] * 19


class Fails(Operator):
    """Raises in the middle of the second scan."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    how: str = ""

    def exec(self, block, state):
        if block.observation.index == 1 and block.detectors.start > 0:
            raise {"interrupt": KeyboardInterrupt, "fault": RuntimeError}[self.how]("stop")


@pytest.mark.parametrize(
    ("how", "error"), [("interrupt", KeyboardInterrupt), ("fault", RuntimeError)]
)
def test_a_pipeline_that_stops_leaves_whole_files_only(how, error, scene, tmp_path):
    from zonda.core.pipeline import Pipeline
    from zonda.operators.noise.white import WhiteNoise
    from zonda.operators.optics.efficiency import Efficiency
    from zonda.operators.pointing.base import PointingStare

    stare = PointingStare(target={"az": "120 deg", "el": "60 deg"}, scan_duration="20 s", scans=2)
    pipeline = Pipeline([stare, WhiteNoise(), Efficiency(), SaveTOD(), Fails(how=how)])
    with pytest.raises(error):
        pipeline.run(scene, output=tmp_path, threads=2)
    (whole,) = tmp_path.glob("tod_*")  # the first scan was complete
    assert load_tod(whole).streams["signal"].shape == (19, 1000)
