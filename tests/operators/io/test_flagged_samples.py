"""Samples that a file flags enter no fit of any filter, whatever their value; what our own filters
trim does.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import zonda
from zonda.core.flags import INVALID, IRREGULAR, PROCESSING, TRIMMED, TURNAROUND
from zonda.operators.io.save_tod import load_tod, save_tod

pytestmark = pytest.mark.filterwarnings("ignore")

SCENE = {
    "site": "green_bank",
    "instrument": {"like": "mustang2", "detectors": 7, "sample_rate": "50 Hz"},
    "time": "2024-11-25T07:00",
    "target": {"az": "100 deg", "el": "50 deg"},
    "seed": 3,
}
THROWS = {
    "throw": "2 deg",
    "speed": "0.5 deg/s",
    "acceleration": "1 deg/s2",
    "scan_duration": "40 s",
    "check_limits": "warn",
}
SCAN = zonda.PointingBackAndForth(**THROWS, flag_turnarounds=True)
AIR = [zonda.AtmosphereLayers(pwv="5 mm", layers=2), zonda.WhiteNoise(), zonda.Efficiency()]
MAP = zonda.BinMap(pixel="2 arcmin")
FILTERS = {
    "detrend": [zonda.Detrend()],
    "despline": [zonda.Despline(knots="5 s")],
    "polynomial": [zonda.PolynomialFilter(order=3, interval="throw")],
    "brick wall": [zonda.HighpassFilter(frequency="0.2 Hz")],
    "bessel": [zonda.HighpassFilter(frequency="0.2 Hz", response="bessel", degree=1)],
    "masked": [zonda.HighpassFilter(frequency="0.2 Hz", mask={"radius": "2 arcmin"})],
    "ground": [zonda.GroundFilter(bin="6 arcmin")],
    "singular modes": [zonda.HighpassFilter(frequency="0.05 Hz"), zonda.CommonModeFilter()],
    "unit rms": [zonda.HighpassFilter(frequency="0.05 Hz"), zonda.CommonModeFilter(scale="rms")],
    "mean": [zonda.HighpassFilter(frequency="0.05 Hz"), zonda.CommonModeFilter(method="mean")],
    "all": [
        zonda.Detrend(),
        zonda.GroundFilter(bin="6 arcmin"),
        zonda.HighpassFilter(frequency="0.1 Hz"),
        zonda.CommonModeFilter(),
    ],
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: Any) -> Path:
    """A scan with turnarounds, tens of kelvin of mean."""
    folder = tmp_path_factory.mktemp("recorded")
    zonda.Pipeline([SCAN, *AIR, zonda.SaveTOD()]).run(zonda.Scene(**SCENE), output=folder)
    return next(folder.glob("tod_*.h5"))


def load(path: Path, steps: list[Any], **more: Any) -> Any:
    step = zonda.LoadTOD(file=path, **more.pop("load", {}))
    return zonda.Pipeline([step, *steps], **more).run(step.scene(seed=3), threads=1)


def spoilt(recorded: Path, bit: int, value: float, name: str) -> Path:
    """A file with 40 samples flagged, alone and together, between and within passes, to which
    ``value`` is added.
    """
    tod = load_tod(recorded)
    at = np.r_[3, 200:230, 777, 1200:1207, len(tod.seconds) - 1]
    tod.flags[at] |= bit
    tod.streams["signal"][:, at] += value
    return save_tod(recorded.with_name(name), tod)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", FILTERS)
def test_no_filter_uses_what_a_file_flags(recorded: Path, name: str, precision: Any) -> None:
    maps = {
        value: load(
            spoilt(recorded, PROCESSING, value, f"{value}.h5"),
            [*FILTERS[name], MAP],
            precision=precision,
        )["map"]
        for value in (0.0, 1e6, np.nan)
    }
    assert np.nanstd(maps[0.0].signal) > 1e-5
    for value in (1e6, np.nan):
        np.testing.assert_array_equal(maps[value].hits, maps[0.0].hits)
        # the same samples in the same order; a row with NaN is fitted by itself, where sums may be
        # formed in another order
        tolerance = {"float32": 3e-7, "float64": 1e-12}[precision]  # of some kelvin, rounded
        np.testing.assert_allclose(
            maps[value].signal, maps[0.0].signal, rtol=0, atol=tolerance, err_msg=f"{value}"
        )


@pytest.mark.parametrize(
    ("bit", "mask"), [(INVALID, 15), (IRREGULAR, 15), (64, 15 | 64), (PROCESSING, 2)]
)
@pytest.mark.parametrize("format", ["h5", "fits"])
def test_every_bit_of_the_mask(recorded: Path, bit: int, mask: int, format: str) -> None:
    """All but turnarounds, whose signal filters use."""
    one, other = (
        load(
            spoilt(recorded, bit, value, f"{bit}-{value}.{format}"),
            [*FILTERS["all"], MAP],
            load={"flag_mask": mask},
        )["map"]
        for value in (0.0, 1e6)
    )
    np.testing.assert_allclose(other.signal, one.signal, rtol=0, atol=3e-7)


def test_no_spectrum_holds_what_a_file_flags(recorded: Path) -> None:
    """Power spectra and comparisons of streams see straight lines there, as filters do."""
    steps = [
        zonda.PowerSpectrum(segment="8 s"),
        zonda.CompareStreams(stream="signal", reference="recorded", segment="8 s"),
    ]
    found = [
        load(spoilt(recorded, PROCESSING, value, f"spectrum-{value}.h5"), steps)
        for value in (0.0, 1e6, np.nan)
    ]
    for other in found[1:]:
        for name, psd in found[0]["spectrum"].psd.items():
            np.testing.assert_allclose(other["spectrum"].psd[name], psd, rtol=1e-5, err_msg=name)
        np.testing.assert_allclose(
            other["stream_comparison"].power, found[0]["stream_comparison"].power, rtol=1e-5
        )


def test_turnarounds_are_used(recorded: Path) -> None:
    one, other = (
        load(spoilt(recorded, TURNAROUND, value, f"turn-{value}.h5"), [zonda.Detrend(), MAP])["map"]
        for value in (0.0, 1.0)
    )
    assert np.nanmax(np.abs(other.signal - one.signal)) > 1e-3


def test_single_samples_that_a_file_flags(recorded: Path) -> None:
    """``detdata/flags`` of TOAST: of one detector, whatever the value."""
    import h5py

    maps = []
    for value in (0.0, 1e6):
        path = save_tod(recorded.with_name(f"single-{value}.h5"), load_tod(recorded))
        with h5py.File(path, "a") as file:
            file["detdata/flags"][2, 300:340] |= PROCESSING
            file["detdata/signal"][2, 300:340] += value
        maps.append(load(path, [*FILTERS["all"][:-1], MAP])["map"])
    np.testing.assert_array_equal(maps[0].signal, maps[1].signal)


TRIMS = {
    "ends": zonda.HighpassFilter(frequency="0.05 Hz", trim="2 s"),
    "between": zonda.PolynomialFilter(order=1, interval="scanning"),
}


@pytest.mark.parametrize("format", ["hdf5", "fits"])
@pytest.mark.parametrize("trim", TRIMS)
def test_what_a_filter_trims_keeps_its_signal_in_a_file(
    trim: str, format: Any, tmp_path: Path
) -> None:
    """It is written as *processing*; filters of a second run use it, as they do in one run."""
    later, scene = (
        [zonda.Detrend(order=4), zonda.HighpassFilter(name="B", frequency="0.1 Hz"), MAP],
        zonda.Scene(**SCENE),
    )
    save = zonda.SaveTOD(format=format)
    one = zonda.Pipeline(
        [used_turnarounds(), *AIR, TRIMS[trim], save, *later], precision="float64"
    ).run(scene, output=tmp_path)
    path = next(tmp_path.glob("tod_*"))
    trimmed = (one.observations[0].flags & TRIMMED) != 0
    assert trimmed.sum() > 100
    np.testing.assert_array_equal((load_tod(path).flags & 15) == PROCESSING, trimmed)
    other = load(path, later, precision="float64")
    np.testing.assert_array_equal(other.observations[0].flags, one.observations[0].flags)
    assert other.observations[0].intervals == one.observations[0].intervals
    np.testing.assert_allclose(other["map"].signal, one["map"].signal, rtol=0, atol=1e-12)
    again = zonda.LoadTOD(file=path)
    second = tmp_path / "second"
    zonda.Pipeline([again, zonda.SaveTOD(format=format)]).run(again.scene(seed=3), output=second)
    np.testing.assert_array_equal(
        load_tod(next(second.glob("tod_*"))).sample_flags(15), one.observations[0].flags
    )
    pointed = zonda.Pipeline(
        [zonda.PointingRecorded(file=path), zonda.WhiteNoise(), zonda.Efficiency()]
    ).run(scene)
    np.testing.assert_array_equal(pointed.observations[0].flags, one.observations[0].flags)


def used_turnarounds() -> Any:
    """The scan, whose turnarounds are used."""
    return zonda.PointingBackAndForth(**THROWS)


def test_what_a_file_flags_within_trimmed_ends_stays_out(tmp_path: Path) -> None:
    """Both become *processing* in a second file: the intervals tell one from the other."""
    scene = zonda.Scene(**SCENE)
    zonda.Pipeline([SCAN, *AIR, zonda.SaveTOD()]).run(scene, output=tmp_path)
    first = spoilt(next(tmp_path.glob("tod_*")), PROCESSING, 1e6, "flagged.h5")
    step = zonda.LoadTOD(file=first)
    zonda.Pipeline([step, TRIMS["ends"], zonda.SaveTOD()]).run(
        step.scene(seed=3), output=tmp_path / "second"
    )
    found = load_tod(next((tmp_path / "second").glob("tod_*"))).sample_flags(15)
    assert found[3] == PROCESSING
    assert found[4] == TRIMMED
    assert (found[200:230] & (PROCESSING | TRIMMED) == PROCESSING).all()


@pytest.mark.parametrize("format", ["h5", "fits"])
def test_the_recorded_azimuth_is_kept(recorded: Path, format: str) -> None:
    """Beside quaternions that depart from it by rounding; one that is no number or in degrees is
    not taken.
    """
    tod = load_tod(recorded)
    own = tod.azimuth
    assert own is not None
    tod.azimuth = own + 3e-15
    path = save_tod(recorded.with_name(f"azimuth.{format}"), tod)
    np.testing.assert_array_equal(load(path, [MAP]).observations[0].azimuth, own + 3e-15)
    np.testing.assert_array_equal(load(path, [MAP]).observations[0].recorded_azimuth, own + 3e-15)
    pointed = zonda.Pipeline(
        [zonda.PointingRecorded(file=path), zonda.WhiteNoise(), zonda.Efficiency()]
    )
    scan = pointed.run(zonda.Scene(**SCENE)).observations[0]
    np.testing.assert_allclose(scan.recorded_azimuth, own + 3e-15, rtol=0, atol=1e-15)
    tod.azimuth = np.where(np.arange(len(own)) == 7, np.nan, own + 3e-15)
    o = load(save_tod(path, tod), [MAP]).observations[0]
    assert o.recorded_azimuth is not None
    assert o.azimuth[7] == pytest.approx(own[7], abs=1e-15)
    tod.azimuth = np.degrees(own)
    assert load(save_tod(path, tod), [MAP]).observations[0].recorded_azimuth is None
