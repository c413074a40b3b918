"""Simulating on a recorded scan: irregular times, gaps and rows that are not numbers."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

import zonda
from zonda.core.configuration.time import Instant
from zonda.core.data import Data
from zonda.core.errors import InputError, PointingError, ZondaError
from zonda.core.flags import INVALID, NOT_RECORDED
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.projection import rotation_matrices
from zonda.core.numerics.sphere import unit_vectors
from zonda.operators.pointing.daisy import PointingDaisy
from zonda.operators.pointing.recorded import PointingRecorded
from zonda.operators.pointing.recording import Recording, comb, longest_rising
from zonda.operators.pointing.recording_files import read_recording

UNIX = 1732518000.0  # 2024-11-25T07:00:00Z
NAN = np.nan


def recording(seconds: Any, flags: Any = None) -> Recording:
    t = np.array(seconds, float)
    return Recording(Instant.parse("2024-11-25T07:00Z"), t, 0.3 + 0.01 * t, 0.8 + 0 * t, "azel",
                     np.zeros(len(t), bool) if flags is None else np.asarray(flags))  # fmt: skip


def write_csv(
    path: Path, t: Any, az: Any, el: Any, header: str = "time [s], az [deg], el [deg]"
) -> Path:
    np.savetxt(
        path, np.transpose([t, az, el]), fmt="%.12f", delimiter=",", header=header, comments=""
    )
    return path


# ---- the comb


@settings(max_examples=60, deadline=None)
@given(
    st.integers(2, 300),
    st.floats(0, 0.2),
    st.floats(1e-3, 1.0),
    st.sets(st.integers(1, 298), max_size=100),
    st.integers(0, 2**31),
)
def test_every_row_keeps_its_time_and_direction(
    n: int, jitter: float, step: float, missing: set[int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    there = np.array([k for k in range(n) if k not in missing or k in (0, n - 1)])
    t = step * (there + jitter * rng.uniform(-1, 1, len(there)))
    given_rows = recording(t)
    if len(there) < 3 or np.median(np.diff(there)) != 1:
        return  # then the commonest interval is another
    scans = comb(given_rows, 1e9, "test").scans
    assert len(scans) == 1
    (scan,) = scans
    assert len(scan.seconds) == there[-1] - there[0] + 1
    slots = there - there[0]
    good = np.flatnonzero(scan.flags == 0)
    assert np.array_equal(good, slots)
    assert np.array_equal(scan.seconds[slots], given_rows.seconds)
    assert scan.longitude[slots] == pytest.approx(given_rows.longitude, abs=1e-14)
    assert (np.diff(scan.seconds) > 0).all()
    assert abs(1 / scan.rate - step) <= 2 * 0.2 * step / (len(scan.seconds) - 1) + 1e-12


def test_nothing_is_repaired_silently() -> None:
    t = np.arange(2000) / 100
    rows = recording(t)
    rows.longitude[[50, 51, 900]] = NAN
    rows.latitude[77] = NAN
    rows.seconds[300] = NAN  # its sample is missing, then
    rows.seconds[400] = 1.0  # back in time
    rows.seconds[500] = rows.seconds[499] + 1e-4  # far too early
    rows.flags[[10, 11]] = True
    keep = np.r_[0:1000, 1150:2000]  # a gap of 1.5 s
    cut = Recording(
        rows.start,
        rows.seconds[keep],
        rows.longitude[keep],
        rows.latitude[keep],
        "azel",
        rows.flags[keep],
    )
    found = comb(cut, 60.0, "test")
    (scan,) = found.scans
    assert len(scan.seconds) == 2000
    assert found.counts == {
        "rows without a time, dropped": 1,
        "rows out of order, dropped": 1,
        "rows repeated, dropped": 0,
        "rows closer than half a sample to the one before, dropped": 1,
        "rows alone between gaps, dropped": 0,
        "samples in gaps, flagged": 153,
        "samples whose row is not a number, flagged": 4,
        "samples flagged in the file": 2,
    }
    expected = np.zeros(2000, np.uint8)
    expected[[10, 11]] = INVALID
    expected[[50, 51, 900, 77, 300, 400, 500, *range(1000, 1150)]] = NOT_RECORDED
    assert np.array_equal(scan.flags, expected)
    assert scan.seconds == pytest.approx(t, abs=1e-12)
    assert np.isfinite(scan.longitude).all()
    # in two where the gap is too long to be bridged
    one, two = comb(cut, 1.0, "test").scans
    assert (len(one.seconds), len(two.seconds)) == (1000, 850)


def test_what_is_no_comb_is_refused() -> None:
    t = np.cumsum(np.random.default_rng(1).exponential(0.01, 1000))
    with pytest.raises(InputError, match=r"intervals between rows vary by \d+ % of a sample"):
        comb(recording(t), 60, "test")
    with pytest.raises(InputError, match="1 rows with increasing times"):
        comb(recording([0.0]), 60, "test")
    with pytest.raises(InputError, match="no two consecutive directions"):
        comb(
            Recording(
                None, np.arange(9.0), np.full(9, NAN), np.zeros(9), "azel", np.zeros(9, bool)
            ),
            60,
            "test",
        )


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(-9, 9), max_size=40))
def test_as_few_rows_as_possible_are_dropped(values: list[int]) -> None:
    found = longest_rising(np.array(values, float))
    assert (np.diff(found) > 0).all()
    assert (np.diff(np.array(values)[found]) > 0).all()
    longest: list[int] = []  # that ends at each value, by trying all that come before
    for k, value in enumerate(values):
        longest.append(1 + max((longest[j] for j in range(k) if values[j] < value), default=0))
    assert len(found) == max(longest, default=0)


@settings(max_examples=60, deadline=None)
@given(st.integers(10, 300), st.data())
def test_stamps_that_jump_are_dropped_alone(n: int, data: st.DataObject) -> None:
    """However far, ahead or back, as long as there are more good rows than such before and behind
    them.
    """
    jumps = data.draw(
        st.dictionaries(
            st.integers(4, n - 5),
            st.sampled_from([1e9, 3600.0, -3600.0, -1e9]),
            max_size=min(3, n // 8),
        )
    )
    t = np.arange(n) / 100
    rows = recording(t)
    for row, jump in jumps.items():
        rows.seconds[row] += jump
    found = comb(rows, 60.0, "test")
    (scan,) = found.scans
    assert found.counts["rows out of order, dropped"] == len(jumps)
    assert np.array_equal(np.flatnonzero(scan.flags == NOT_RECORDED), sorted(jumps))
    assert scan.seconds == pytest.approx(t, abs=1e-9)


def test_repeated_rows_are_dropped_without_a_word(
    observe: Callable[..., Data], tmp_path: Path
) -> None:
    t, angle = UNIX + np.repeat(np.arange(600), 2) / 10, np.repeat(np.arange(600), 2) / 6000
    file = write_csv(tmp_path / "twice.csv", t, 200 + angle, 40 + angle)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = observe(PointingRecorded(file=file))
    assert data.observations[0].n_samples == 600
    assert data.observations[0].log.get("PointingRecorded", "rows repeated, dropped") == 600


def test_a_stamp_ahead_of_its_time_is_dropped_and_said(
    observe: Callable[..., Data], tmp_path: Path
) -> None:
    """The rest stays: a year ahead, in the third row of 600."""
    t, angle = UNIX + np.arange(600) / 10, np.arange(600) / 600
    t[2] += 3e7
    file = write_csv(tmp_path / "jump.csv", t, 200 + angle, 40 + angle)
    with pytest.warns(
        UserWarning, match=r"1 rows of .*jump.csv were dropped: their times jump ahead or back"
    ):
        data = observe(PointingRecorded(file=file))
    (observation,) = data.observations
    assert observation.n_samples == 600
    assert np.array_equal(np.flatnonzero(observation.flags), [2])


# ---- files


def test_a_simulated_scan_read_back_is_the_same_scan(
    observe: Callable[..., Data], tmp_path: Path
) -> None:
    """SaveTOD's HDF5 and FITS files carry exact times: the boresight comes back to 1e-15, samples
    to the last bit of time.
    """
    import zonda

    made = observe(PointingDaisy(scan_duration="30 s"))
    (o,) = made.observations
    for fmt, suffix in (("hdf5", "h5"), ("fits", "fits")):
        steps = [
            PointingDaisy(scan_duration="30 s", jitter="0.5 ms"),
            zonda.WhiteNoise(),
            zonda.Efficiency(),
        ]
        from zonda.operators.io.save_tod import SaveTOD

        data = zonda.Pipeline([*steps, SaveTOD(format=fmt)]).run(
            made.scene, output=tmp_path / fmt, threads=1
        )
        (first,) = data.observations
        (again,) = observe(
            PointingRecorded(file=tmp_path / fmt / f"tod_scan-000.{suffix}")
        ).observations
        assert again.start == first.start.shifted(float(first.seconds[0]))
        assert again.seconds == pytest.approx(first.seconds - first.seconds[0], abs=1e-9)
        assert again.jitter == pytest.approx(0.5e-3, rel=0.05)  # of 3000: 1.3 % standard error
        assert again.centre == first.centre
        for name in ("boresight_azel", "boresight_radec"):
            a, b = (rotation_matrices(getattr(x, name)) for x in (again, first))
            assert (
                np.abs(a - b).max() < 1e-12
            )  # 1 ns of rounding of the start at 58 arcsec/s: 3e-13
        assert not again.flags.any()
    assert first.seconds == pytest.approx(o.seconds, abs=5e-3)


@pytest.mark.parametrize("kind", ["csv", "fits", "hdf5"])
def test_tables(kind: str, observe: Callable[..., Data], tmp_path: Path) -> None:
    t = np.arange(500) / 50
    az, el = 120 + 0.1 * np.sin(t), 45 + 0.05 * np.cos(t)
    path = tmp_path / f"scan.{kind}"
    if kind == "csv":
        write_csv(path, UNIX + t, az, el)
    elif kind == "fits":
        columns = [
            fits.Column("TIME", "D", unit="s", array=UNIX + t),
            fits.Column("AZ", "D", unit="deg", array=az),
            fits.Column("EL", "D", unit="deg", array=el),
            fits.Column("X", "3D", array=np.zeros((500, 3))),
        ]
        fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]).writeto(path)
    else:
        import h5py

        with h5py.File(path, "w") as file:
            for name, values, unit in (
                ("time", UNIX + t, "s"),
                ("azimuth", np.radians(az), "rad"),
                ("elevation", el, "deg"),
            ):
                file.create_dataset(name, data=values).attrs["units"] = unit
    (o,) = observe(PointingRecorded(file=path), target=None).observations
    assert str(o.start) == "2024-11-25T07:00:00Z"
    assert o.sample_rate == pytest.approx(50, rel=1e-8)
    assert o.seconds == pytest.approx(t, abs=3e-7)  # 0.24 us: all that a float64 holds at 1.7e9 s
    assert np.degrees(o.azimuth) == pytest.approx(az, abs=1e-8)
    assert np.degrees(o.elevation) == pytest.approx(el, abs=1e-8)
    distance = np.hypot((o.ra - o.centre[0]) * np.cos(o.dec), o.dec - o.centre[1])
    assert distance.max() < np.radians(0.15)


def test_clocks_and_celestial_rows(observe: Callable[..., Data], tmp_path: Path) -> None:
    t = np.arange(200) / 20
    ra, dec = 75 + 0.01 * np.sin(t), 20 + 0.01 * np.cos(t)
    mjd = write_csv(
        tmp_path / "mjd.csv", 60639 + (7 * 3600 + t) / 86400, ra, dec, "mjd, ra [deg], dec [deg]"
    )
    (o,) = observe(PointingRecorded(file=mjd, clock="mjd")).observations
    assert abs(o.start.seconds_since(Instant.parse("2024-11-25T07:00Z"))) < 2e-6
    assert np.degrees(o.ra) == pytest.approx(ra, abs=1e-9)
    assert np.degrees(o.dec) == pytest.approx(dec, abs=1e-9)
    since = write_csv(tmp_path / "since.csv", t, ra, dec, "# time [s], ra [deg], dec [deg]")
    (o,) = observe(PointingRecorded(file=since, clock="scene")).observations
    assert str(o.start) == "2024-11-25T07:00:00.123456789Z"
    assert np.array_equal(o.seconds, np.round(t, 12))
    with pytest.raises(InputError, match="is not a plausible date as seconds since 1970"):
        observe(PointingRecorded(file=since))
    with pytest.warns(UserWarning, match="the weather is that of 2024-11-29"):
        observe(PointingRecorded(file=mjd, clock="mjd"), time="2024-11-29T07:00Z")


def test_bad_files(tmp_path: Path) -> None:
    t = np.arange(10.0)
    for header, message in (
        ("time [s], az, el [deg]", "az has no unit"),
        ("time [s], az [s], el [deg]", "az has the unit 's'"),
        ("time [s], x [deg], y [deg]", "has no column ra and dec; columns: time, x, y"),
        ("time [s], az [deg]", "line 2: has 3 values, not 2"),
        ("time [s], az [deg], el [rad]", r"el is 2578.\d+ deg in row 0"),
    ):
        with pytest.raises(InputError, match=message):
            read_recording(
                write_csv(tmp_path / "bad.csv", UNIX + t, 10 * t, 45 + 0 * t, header), "unix"
            )
    (tmp_path / "ragged.csv").write_text("time [s], az [deg], el [deg]\n1,2,3\n1,2\n")
    with pytest.raises(InputError, match="line 3: has 2 values, not 3"):
        read_recording(tmp_path / "ragged.csv", "unix")
    (tmp_path / "half.h5").write_bytes(b"\x89HDF\r\n\x1a\nrest")
    with pytest.raises(InputError, match="cannot be read"):
        read_recording(tmp_path / "half.h5", "unix")
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)))
    with pytest.raises(ZondaError):
        read_recording(tmp_path / "binary.csv", "unix")


def test_a_rotated_boresight_is_refused(tmp_path: Path) -> None:
    import h5py

    from zonda.core.numerics.quaternions import from_angles, multiply

    t = np.arange(20) / 10
    turned = multiply(
        from_angles(-1 + 0 * t, 0.8 + 0 * t), np.tile([0, 0, np.sin(0.05), np.cos(0.05)], (20, 1))
    )
    with h5py.File(tmp_path / "turned.h5", "w") as file:
        for name, values in (
            ("times", UNIX + t),
            ("azimuth", 1 + 0 * t),
            ("elevation", 0.8 + 0 * t),
            ("boresight_azel", turned),
        ):
            file.create_dataset(f"shared/{name}", data=values)
    text = r"rotated by up to 5\.73 deg about itself(.|\n)*LoadTOD: {file: \.\.\., signal: none}"
    with pytest.raises(InputError, match=text):
        read_recording(tmp_path / "turned.h5", "unix")


def test_the_step_that_a_rotated_boresight_needs(tmp_path: Path) -> None:
    """A scheduled scan turned by 45 deg: refused from both formats, and followed by `LoadTOD`
    without a stream.
    """
    schedule = tmp_path / "s.txt"
    schedule.write_text(
        "# Site | Telescope | Latitude [deg] | Longitude [deg] | Elevation [m]\nATACAMA | LAT |"
        " -22.958 | -67.786 | 5200.0\n# Start time UTC | Stop time UTC | Rotation | Patch name | Az"
        " min. | Az max. | Elev. | Pass | Sub\n2025-08-01 05:12:30 | 2025-08-01 05:12:50 | 45.0 |"
        " field | 73.0 | 82.0 | 50.00 | 0 | 0\n"
    )
    camera = {"like": "act_150ghz", "detectors": 3, "sample_rate": "20 Hz"}
    scene = zonda.Scene(site="atacama", instrument=camera, time="2025-08-01T05:12", seed=1)
    rest = [zonda.WhiteNoise(), zonda.Efficiency()]
    saves = [zonda.SaveTOD(), zonda.SaveTOD(name="Fits", format="fits")]
    scan = zonda.PointingSchedule(schedule=schedule, check_limits="warn")
    first = zonda.Pipeline([scan, *rest, *saves]).run(scene, output=tmp_path)
    for path in (next(tmp_path.glob("*.h5")), next(tmp_path.glob("*.fits"))):
        with pytest.raises(InputError, match="rotated by up to 45 deg"):
            zonda.Pipeline([zonda.PointingRecorded(file=path), *rest]).run(scene)
        step = zonda.LoadTOD(file=path, signal=None)
        second = zonda.Pipeline([step, *rest]).run(step.scene(seed=1))
        one, other = second.observations[0], first.observations[0]
        np.testing.assert_array_equal(one.boresight_azel, other.boresight_azel)


def test_outside_the_telescopes_range_is_found_by_check(
    observe: Callable[..., Data], tmp_path: Path
) -> None:
    t = np.arange(100.0)
    high = PointingRecorded(file=write_csv(tmp_path / "high.csv", UNIX + t, 10 + 0 * t, 45 + 0 * t))
    low = PointingRecorded(file=write_csv(tmp_path / "low.csv", UNIX + t, 10 + 0 * t, 3 + 0 * t))
    data = Data(observe(high).scene)
    with pytest.raises(PointingError, match=r"the boresight goes down to elevation 3.00 deg"):
        low.check(data)
    assert high.check(data) == ["100 samples at 1 Hz, 99.0 s, elevation 45.00 to 45.00 deg"]
    assert [o.n_samples for o in data.observations] == [100]


def test_outside_the_telescopes_range(observe: Callable[..., Data], tmp_path: Path) -> None:
    t = np.arange(100.0)
    path = write_csv(tmp_path / "low.csv", UNIX + t, 10 + 0 * t, np.where(t == 60, 3, 45))
    with pytest.raises(
        PointingError,
        match=r"the boresight goes down to elevation 3.00 deg, 60 s after .*GBT reaches 5 deg to 90 deg",
    ):
        observe(PointingRecorded(file=path))
    write_csv(path, UNIX + t, 10 + 0 * t, np.where(t == 60, NAN, 45))
    (o,) = observe(PointingRecorded(file=path)).observations
    assert np.flatnonzero(o.flags).tolist() == [60]
    assert o.log.get("PointingRecorded", "samples whose row is not a number, flagged") == 1


# ---- jitter


def test_jitter_moves_the_pointing_by_speed_times_delay(observe: Callable[..., Data]) -> None:
    """The direction of every sample is that of the path at its own time, and the delays have the
    rms asked for.
    """
    scan = PointingDaisy(scan_duration="60 s", jitter="1 ms")
    (o,) = observe(scan).observations
    assert o.jitter == pytest.approx(1e-3, rel=0.03)  # of 6000: 0.9 % standard error
    assert abs(o.departures.mean()) < 1e-12
    assert np.array_equal(o.seconds, observe(scan).observations[0].seconds)
    assert not np.array_equal(o.seconds, observe(scan, seed=5).observations[0].seconds)
    transform = CelestialTransform(o.site, o.start, 60.0)
    x, y = scan.path(o.seconds)
    ra0, dec0 = o.centre
    east, north = np.array([-np.sin(ra0), np.cos(ra0), 0]), np.array(
        [-np.sin(dec0) * np.cos(ra0), -np.sin(dec0) * np.sin(ra0), np.cos(dec0)]
    )  # fmt: skip
    sky = unit_vectors(ra0, dec0) + x[:, None] * east + y[:, None] * north
    sky /= np.linalg.norm(sky, axis=1)[:, None]
    assert (
        np.abs(
            rotation_matrices(o.boresight_azel)[:, :, 2] - transform.horizontal(sky, o.seconds)
        ).max()
        < 1e-12
    )
    said = {what: text for _, what, text in o.log}
    assert "depart from a comb of 100 Hz by 1" in said["scan-000: times of the samples"]
    assert "of its rms" in said["scan-000: noise and filters take the samples as a comb"]


def test_too_much_jitter_is_refused(observe: Callable[..., Data]) -> None:
    with pytest.raises(
        PointingError, match="a jitter of 5 ms would reorder samples: they come every 10 ms"
    ):
        observe(PointingDaisy(scan_duration="60 s", jitter="5 ms"))


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path):
    """Spreadsheets write one."""
    path = write_csv(
        tmp_path / "bom.csv", UNIX + np.arange(20) / 10, np.full(20, 150.0), np.full(20, 45.0)
    )
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(read_recording(path, "unix").seconds) == 20


# ---- what TOAST's layout has beside times and directions


@pytest.fixture
def saved(observe: Callable[..., Data], tmp_path: Path) -> Callable[[str], Path]:
    """A scan back and forth in a file of SaveTOD; the format is asked for."""
    import zonda
    from zonda.operators.io.save_tod import SaveTOD
    from zonda.operators.pointing.azimuth_scan import PointingBackAndForth

    scan = {
        "throw": "1 deg",
        "speed": "0.5 deg/s",
        "acceleration": "1 deg/s2",
        "scan_duration": "21.5 s",
    }

    def write(form: str) -> Path:
        step = PointingBackAndForth(
            **scan, flag_turnarounds=True, check_limits="warn", target="az 200 deg el 50 deg"
        )
        scene = observe(PointingDaisy(scan_duration="1 s")).scene
        zonda.Pipeline([step, zonda.WhiteNoise(), zonda.Efficiency(), SaveTOD(format=form)]).run(
            scene, output=tmp_path / form, threads=1
        )
        (path,) = (tmp_path / form).glob("tod*")
        return path

    return write


def change(path: Path, turn: Any = None, flags: Any = None, drop: str = "") -> None:
    """Edit a file of SaveTOD: directions on the sky turned by ``turn`` [rad] about the poles,
    flags, an item left out.
    """
    import h5py

    with h5py.File(path, "a") as f:
        if turn is not None:
            x, y, z, w = f["shared/boresight_radec"][:].T
            s, c = np.sin(turn / 2), np.cos(turn / 2)
            f["shared/boresight_radec"][:] = np.stack(
                [c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z], 1
            )
        if flags is not None:
            f["shared/flags"][:] = flags
        if drop:
            del f[drop]


@pytest.mark.filterwarnings("ignore:Pointing")
@pytest.mark.parametrize("form", ["hdf5", "fits"])
def test_flags_and_intervals_come_back(form: str, saved: Any, observe: Callable[..., Data]) -> None:
    from zonda.operators.io.save_tod import load_tod

    path = saved(form)
    tod, (o,) = load_tod(path), observe(PointingRecorded(file=path)).observations
    assert (tod.flags == 4).sum() > 500  # of 2150: a turnaround of 2 s follows 2 s of scan
    assert np.array_equal(o.flags, tod.flags)
    assert o.intervals == tod.intervals
    assert len(o.intervals["throw_leftright"]) == 3
    assert np.array_equal(o.boresight_radec, tod.boresight_radec)


@pytest.mark.filterwarnings("ignore:Pointing")
def test_only_the_mask_excludes(saved: Any, observe: Callable[..., Data]) -> None:
    path = saved("hdf5")
    flags = np.zeros(2150, np.uint8)
    flags[:7] = [1, 2, 4, 8, 16, 32, 64]
    change(path, flags=flags)
    (o,) = observe(PointingRecorded(file=path)).observations
    assert o.flags[:8].tolist() == [1, 2, 4, 8, 16, 32, 0, 0]
    assert np.flatnonzero(~o.good_samples).tolist() == [0, 1, 2, 3]
    assert o.log.get("PointingRecorded", "samples flagged in the file") == 4
    (o,) = observe(PointingRecorded(file=path, flag_mask=1 | 32 | 64)).observations
    assert np.flatnonzero(~o.good_samples).tolist() == [0, 5, 6]
    assert o.flags[4] == 16


def test_any_flag_excludes_in_files_of_other_kinds(
    observe: Callable[..., Data], tmp_path: Path
) -> None:
    t = np.arange(200) / 10
    table = np.transpose(
        [
            UNIX + t,
            120 + 0.01 * t,
            45 + 0.01 * t,
            (np.arange(200) == 5) * 64 + (np.arange(200) == 9),
        ]
    )
    path = tmp_path / "flagged.csv"
    np.savetxt(
        path,
        table,
        fmt="%.9f",
        delimiter=",",
        header="time [s], az [deg], el [deg], flags",
        comments="",
    )
    for mask, expected in ((None, [5, 9]), (64, [5]), (1, [9])):
        (o,) = observe(PointingRecorded(file=path, flag_mask=mask)).observations
        assert np.flatnonzero(~o.good_samples).tolist() == expected


@pytest.mark.filterwarnings("ignore:Pointing")
def test_directions_on_the_sky_are_those_recorded(saved: Any, observe: Callable[..., Data]) -> None:
    """TOAST's own lie 45 arcsec from astropy's: a file that says so is believed, and the distance
    is stated.
    """
    path, turn = saved("hdf5"), np.radians(45 / 3600)
    (plain,) = observe(PointingRecorded(file=path)).observations
    change(path, turn=turn)
    (o,) = observe(PointingRecorded(file=path)).observations
    shift = (o.ra - plain.ra + np.pi) % (2 * np.pi) - np.pi
    assert shift == pytest.approx(turn, abs=1e-12)
    most = 45 * np.cos(o.dec).max()
    said = {what: text for _, what, text in o.log}["scan-000: directions on the sky"]
    assert said.startswith("as recorded, up to ")
    assert float(said.split()[4]) == pytest.approx(most, rel=5e-3)  # three digits are stated
    (again,) = observe(PointingRecorded(file=path, celestial="recomputed")).observations
    assert (
        np.abs(
            rotation_matrices(again.boresight_radec) - rotation_matrices(plain.boresight_radec)
        ).max()
        < 1e-10
    )
    assert (
        "recomputed from"
        in {what: text for _, what, text in again.log}["scan-000: directions on the sky"]
    )


@pytest.mark.filterwarnings("ignore:PointingBack")
def test_directions_far_from_azimuth_and_elevation_warn(
    saved: Any, observe: Callable[..., Data]
) -> None:
    path = saved("hdf5")
    change(path, turn=np.radians(1.0))
    with pytest.warns(
        UserWarning,
        match=r"as recorded, up to \d+(e\+03)? ?.*arcsec from .*are site and clock right\?",
    ):
        observe(PointingRecorded(file=path))
    change(path, drop="shared/boresight_radec")
    observe(PointingRecorded(file=path))
    with pytest.raises(InputError, match="has azimuth and elevation and no boresight_radec"):
        observe(PointingRecorded(file=path, celestial="recorded"))


@pytest.mark.filterwarnings("ignore:Pointing")
def test_a_gap_parts_the_intervals(saved: Any, observe: Callable[..., Data]) -> None:
    """Rows between 8 and 10 s are missing: with `split` there are two scans, each with its part;
    quaternions go on in a gap.
    """
    import h5py

    path = saved("hdf5")
    whole = observe(PointingRecorded(file=path)).observations[0]
    with h5py.File(path, "a") as f:
        keep = np.r_[0:800, 1000:2150]
        for name in list(f["shared"]):
            rows = f["shared"][name][:][keep]
            if name == "boresight_radec":
                rows[900:] *= -1  # the same rotations
            del f["shared"][name]
            f["shared"][name] = rows
    (o,) = observe(PointingRecorded(file=path)).observations
    assert np.flatnonzero(o.flags & NOT_RECORDED).tolist() == list(range(800, 1000))
    apart = rotation_matrices(o.boresight_radec) - rotation_matrices(whole.boresight_radec)
    assert np.abs(apart[o.good_samples]).max() < 1e-14
    assert np.linalg.norm(o.boresight_radec, axis=1) == pytest.approx(1, abs=1e-14)
    for (
        name,
        spans,
    ) in (
        whole.intervals.items()
    ):  # a time within the gap has the resolution of POSIX seconds, 0.24 us
        np.testing.assert_allclose(o.intervals[name], spans, rtol=0, atol=1e-6)
    first, second = observe(PointingRecorded(file=path, split="1 s")).observations
    assert sum(b - a for a, b in first.intervals["throw"]) == pytest.approx(7.99, abs=1e-9)
    assert sum(b - a for a, b in second.intervals["throw"]) == pytest.approx(11.49, abs=1e-9)
    assert second.intervals["throw"][0][0] == 0.0


@pytest.mark.filterwarnings("ignore:Pointing")
def test_odd_items_in_toasts_layout(saved: Any, observe: Callable[..., Data]) -> None:
    """What is not as it should be beside times and directions is left alone, or told."""
    import h5py

    path = saved("hdf5")
    with h5py.File(path, "a") as f:
        del f["intervals/throw"]
        f["intervals"].create_group("throw")
        f["intervals/words"] = "none"
        del f["shared/boresight_radec"]
        f["shared/boresight_radec"] = "none"
    (o,) = observe(PointingRecorded(file=path)).observations
    assert "scanning" in o.intervals
    assert not {"throw", "words"} & set(o.intervals)
    with h5py.File(path, "a") as f:
        f["intervals/elnod"] = np.zeros(3)
    with pytest.raises(InputError, match="the intervals elnod are no times"):
        observe(PointingRecorded(file=path))
    with h5py.File(path, "a") as f:
        del f["intervals"], f["shared/boresight_radec"]
        f["shared/boresight_radec"] = np.zeros((7, 4))
    with pytest.raises(InputError, match="boresight_radec is 7 x 4, not 2150 x 4"):
        observe(PointingRecorded(file=path))


@pytest.mark.parametrize(
    ("header", "comma", "time"),
    [
        ("time [s], az [deg], el [deg]", ",", "unix"),
        ("time, az [deg], el [deg]", ",", "iso"),
        ("UTC; Azimuth(deg); Elevation(deg)", ";", "iso"),
        ("time [s]\taz [deg]\tel [deg]", "\t", "unix"),
        ("timestamp\tAzimuth (degrees)\tElevation (degrees)", "\t", "unix"),
        ("# ctime az_deg el_deg", " ", "unix"),
        ("time [s] az [deg] el [deg]", "  ", "unix"),
        ("datetime,az_deg,el_deg,remark", ",", "z"),
        ("time; az [degrees]; el [deg]", ";", "+2"),
    ],
)
def test_logs_as_people_have_them(tmp_path: Path, header: str, comma: str, time: str) -> None:
    """Dates (ISO 8601), commas, semicolons, tabs and blanks, units in brackets or behind the name:
    the same pointing.
    """
    t = np.arange(30) / 10
    dates = {
        "unix": [f"{UNIX + s:.1f}" for s in t],
        "iso": [f"2024-11-25T07:00:{s:04.1f}" for s in t],
        "z": [f"2024-11-25 07:00:{s:04.1f}Z" for s in t],
        "+2": [f"2024-11-25T09:00:{s:04.1f}+02:00" for s in t],
    }[time]
    rows = [
        comma.join([d, f"{180 + s:.4f}", "50", *(["ok"] if "remark" in header else [])])
        for d, s in zip(dates, t, strict=True)
    ]
    path = tmp_path / "log.txt"
    path.write_text("\n".join([header, *rows]) + "\n")
    found = read_recording(path, "unix")
    assert found.start is not None
    seconds = np.array(
        [(found.start.seconds_since(Instant.parse("2024-11-25T07:00Z"))) + s for s in found.seconds]
    )
    np.testing.assert_allclose(
        seconds, t, rtol=0, atol=3e-7 if time == "unix" else 1e-12
    )  # doubles since 1970
    np.testing.assert_allclose(np.degrees(found.longitude), 180 + t, rtol=1e-12)
    np.testing.assert_allclose(np.degrees(found.latitude), 50, rtol=1e-12)


@pytest.mark.parametrize("text", ["yesterday", "2024-13-25T07:00:00", "25/11/2024 07:00"])
def test_what_is_no_date_in_utc_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time, az [deg], el [deg]\n" + "".join(f"{text},180,50\n" for _ in range(3)))
    with pytest.raises(InputError, match=r"log\.csv") as caught:
        read_recording(path, "unix")
    assert "2024-11-25T07:00:00.5" in str(caught.value)
