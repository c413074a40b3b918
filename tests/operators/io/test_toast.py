"""TOAST itself on our files: it bins the samples that zonda bins, its filters find their intervals,
its atmosphere the weather.

`.ci/toast` runs these in an environment with TOAST (the extra ``toast``), where none may be skipped
(ZONDA_TOAST=required).
"""

import numpy as np
import pytest

import zonda
from zonda.core.flags import samples_in
from zonda.core.operator import Operator
from zonda.core.polarization import PolarizationAngles
from zonda.operators.io.load_tod import LoadTOD
from zonda.operators.io.save_tod import SaveTOD, load_tod

from ...scenes import Marks, skip_without

pytestmark = [
    pytest.mark.toast,
    pytest.mark.filterwarnings("ignore:Pointing", "ignore::DeprecationWarning"),
]

skip_without("toast")

from datetime import UTC, datetime, timedelta

import astropy.units as u
import toast
import toast.instrument
import toast.instrument_sim
import toast.io
import toast.ops
import toast.schedule
from astropy.table import vstack

NSIDE = 512
INSTRUMENT = {
    "name": "camera",
    "telescope": {"name": "dish", "diameter": "6 m"},
    "band": {"name": "b", "low": "130 GHz", "high": "170 GHz"},
    "detectors": 7,
    "field_of_view": "1 deg",
    "main_beam_efficiency": 0.7,
    "illumination_efficiency": 0.9,
    "net": "300 uK s(1/2)",
    "sample_rate": "40 Hz",
}
SCENE = {
    "site": "atacama",
    "instrument": INSTRUMENT,
    "time": "2024-06-25T07:00",
    "target": "az 180 deg el 50 deg",
    "seed": 1,
}
SCAN = {
    "throw": "4 deg",
    "speed": "1 deg/s",
    "acceleration": "1 deg/s2",
    "scan_duration": "61.3 s",
    "check_limits": "warn",
}


def toast_data(path):
    data = toast.Data(toast.Comm())
    data.obs.append(toast.io.load_hdf5(str(path), data.comm))
    return data


def pixels():
    return toast.ops.PixelsHealpix(
        nside=NSIDE, nest=False, detector_pointing=toast.ops.PointingDetectorSimple()
    )


def full_sky(local):
    """The first column of a `toast.PixelData`, (12 nside^2,)."""
    found, size = np.zeros(local.distribution.n_pix), local.distribution.n_pix_submap
    for k, submap in enumerate(local.distribution.local_submaps):
        found[submap * size : (submap + 1) * size] = local.data[k, :, 0]
    return found


def toast_maps(path):
    """Hits and map with TOAST's defaults: all that is asked for is the pixels."""
    data, where = toast_data(path), pixels()
    weights = toast.ops.StokesWeights(mode="I", detector_pointing=where.detector_pointing)
    toast.ops.CovarianceAndHits(
        pixel_dist="dist",
        covariance="cov",
        hits="hits",
        rcond="rcond",
        pixel_pointing=where,
        stokes_weights=weights,
    ).apply(data)
    toast.ops.BinMap(
        pixel_dist="dist",
        covariance="cov",
        pixel_pointing=where,
        stokes_weights=weights,
        binned="map",
    ).apply(data)
    return full_sky(data["hits"]), full_sky(data["map"])


def zonda_maps(product):
    hits, signal = np.zeros((2, 12 * NSIDE**2))
    hits[product.pixels], signal[product.pixels] = product.hits, product.signal
    return hits, np.nan_to_num(signal)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """Turnarounds, trimmed ends, dead and opaque detectors, opaque samples."""
    folder = tmp_path_factory.mktemp("scan")
    steps = [
        zonda.PointingBackAndForth(**SCAN, flag_turnarounds=True),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        Marks(),
        zonda.HighpassFilter(frequency="0.1 Hz", trim="1.5 s"),
        zonda.BinMap(nside=NSIDE),
        SaveTOD(),
    ]
    data = zonda.Pipeline(steps).run(zonda.Scene(**SCENE), output=folder, threads=1)
    return folder / "tod_scan-000.h5", data


@pytest.fixture(scope="module")
def recorded(scan, tmp_path_factory):
    """The same scan recorded with a gap, rows that are no numbers, and a clock that jitters."""
    import h5py

    folder = tmp_path_factory.mktemp("recorded")
    tod = load_tod(scan[0])
    keep = np.r_[0:1000, 1100 : tod.n_samples]
    with h5py.File(folder / "recording.h5", "w") as f:
        jitter = np.random.default_rng(3).normal(0, 5e-4, len(keep))
        azimuth = scan[1].observations[0].azimuth[keep]
        azimuth[1500:1520] = np.nan
        for name, values, unit in (
            ("time", tod.times[keep] + jitter, "s"),
            ("az", azimuth, "rad"),
            ("el", 0 * azimuth, "rad"),
        ):
            f[name] = values if name != "el" else scan[1].observations[0].elevation[keep]
            f[name].attrs["units"] = unit
    recording = zonda.PointingRecorded(file=folder / "recording.h5")
    steps = [
        recording,
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        Marks(),
        zonda.BinMap(nside=NSIDE),
        SaveTOD(),
    ]
    data = zonda.Pipeline(steps).run(zonda.Scene(**SCENE), output=folder, threads=1)
    return folder / "tod_scan-000.h5", data


@pytest.mark.parametrize("which", ["scan", "recorded"])
def test_toast_bins_what_zonda_bins(which, request):
    path, data = request.getfixturevalue(which)
    (o,) = data.observations
    used = int(o.good_samples.sum()) * int(o.good_detectors.sum())
    assert used < 0.95 * o.n_samples * 5  # of 7 detectors 5 are good, and not all samples
    hits, signal = toast_maps(path)
    ours, brightness = zonda_maps(data.products["map"])
    assert hits.sum() == used
    np.testing.assert_array_equal(hits, ours)
    # Both add the same numbers; TOAST's weights come from a noise model in float32 and are equal:
    # they cancel to rounding
    np.testing.assert_allclose(signal, brightness, rtol=0, atol=1e-6 * np.abs(brightness).max())


def test_toasts_intervals_hold_our_samples(scan):
    path, data = scan
    kept = toast_data(path)  # TOAST clears its observations with their owner
    (o,), observation = kept.obs, data.observations[0]
    turning = np.zeros(o.n_local_samples, bool)
    for interval in o.intervals["turnaround"]:
        turning[interval.first : interval.last] = True
    np.testing.assert_array_equal(turning, (o.shared["flags"].data & 4) != 0)
    for name, spans in observation.intervals.items():
        assert len(o.intervals[name]) == len(spans)
    throws = o.intervals["throw"]
    assert [int(throws[0].first), int(throws[-1].last)] == [0, o.n_local_samples]
    assert [int(a.last) for a in throws[:-1]] == [int(b.first) for b in throws[1:]]


def test_toasts_filters_run(scan):
    data = toast_data(scan[0])
    before = data.obs[0].detdata["signal"].data.copy()
    good = ~(data.obs[0].shared["flags"].data & 15).astype(bool)
    toast.ops.PolyFilter(order=3, view="throw").apply(data)
    after = data.obs[0].detdata["signal"].data.copy()
    for interval in data.obs[0].intervals["throw"][1:-1]:  # a cubic is gone in each throw by itself
        t = np.linspace(-1, 1, interval.last - interval.first)
        inside = good[interval.first : interval.last]
        left = np.polynomial.legendre.legfit(
            t[inside], after[0, interval.first : interval.last][inside], 3
        )
        assert np.abs(left).max() < 1e-6 * np.abs(before[0][good]).max()
    toast.ops.GroundFilter(split_template=True, trend_order=2, filter_order=3).apply(data)
    assert np.isfinite(data.obs[0].detdata["signal"].data).all()
    assert (data.obs[0].detdata["signal"].data[0] != after[0]).any()
    assert not any(data.obs[0].local_detector_flags[d] & 2 for d in data.obs[0].local_detectors)


def test_toast_finds_the_weather(scan):
    import astropy.units as u

    tod, data = load_tod(scan[0]), toast_data(scan[0])
    weather = data.obs[0].telescope.site.weather
    for theirs, unit, ours in (
        ("pwv", u.m, tod.weather.pwv),
        ("surface_pressure", u.Pa, tod.weather.pressure),
        ("air_temperature", u.K, tod.weather.temperature),
        ("surface_temperature", u.K, tod.weather.ground_temperature),
        ("humidity", u.dimensionless_unscaled, tod.weather.humidity),
        ("west_wind", u.m / u.s, tod.weather.wind_east),
        ("south_wind", u.m / u.s, tod.weather.wind_north),
    ):
        assert getattr(weather, theirs).to_value(unit) == pytest.approx(ours, rel=1e-14)
    assert weather.time.timestamp() == pytest.approx(tod.times[0], abs=1e-3)
    azel = toast.ops.PointingDetectorSimple(boresight="boresight_azel", quats="quats_azel")
    before = data.obs[0].detdata["signal"].data.copy()
    toast.ops.SimAtmosphere(
        detector_pointing=azel,
        field_of_view=2 * u.deg,
        lmin_center=100 * u.m,
        lmax_center=300 * u.m,
        xstep=50 * u.m,
        ystep=50 * u.m,
        zstep=50 * u.m,
        zmax=500 * u.m,
    ).apply(data)
    assert (data.obs[0].detdata["signal"].data[0] != before[0]).any()


def test_directions_make_the_round_trip(scan, tmp_path):
    """Through TOAST's own writer, with its directions on the sky in place of ours: zonda simulates
    on those.
    """
    data = toast_data(scan[0])
    (o,) = data.obs
    turn = toast.qarray.rotation(np.array([0.0, 0.0, 1.0]), np.radians(45 / 3600))
    o.shared["boresight_radec"].set(
        toast.qarray.mult(turn, o.shared["boresight_radec"].data), offset=(0, 0), fromrank=0
    )
    path = toast.io.save_hdf5(o, str(tmp_path), detdata=["signal", "flags"])
    found = zonda.Data(zonda.Scene(**SCENE))
    zonda.PointingRecorded(file=path).observe(found)
    (again,) = found.observations
    np.testing.assert_array_equal(again.boresight_radec, o.shared["boresight_radec"].data)
    first = scan[1].observations[0]
    np.testing.assert_array_equal(again.good_samples, first.good_samples)
    assert {name: len(spans) for name, spans in again.intervals.items()} == {
        n: len(s) for n, s in first.intervals.items()
    }
    tod = load_tod(path)
    np.testing.assert_array_equal(tod.detector_flags, load_tod(scan[0]).detector_flags)
    assert tod.weather == load_tod(scan[0]).weather


def test_intervals_without_any(scan, tmp_path):
    """A scan of half a leg has no turnaround: TOAST reads an empty list of that name."""
    steps = [
        zonda.PointingBackAndForth(**{**SCAN, "scan_duration": "2 s"}),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        SaveTOD(),
    ]
    zonda.Pipeline(steps).run(zonda.Scene(**SCENE), output=tmp_path, threads=1)
    kept = toast_data(tmp_path / "tod_scan-000.h5")
    (o,) = kept.obs
    assert len(o.intervals["turnaround"]) == 0
    assert len(o.intervals["throw"]) == 1


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A scan that TOAST made itself: SimGround with its own transformation to the sky, weather, Sun
    and intervals.
    """
    from datetime import datetime

    import astropy.units as u
    from astropy.table import QTable

    site = toast.instrument.GroundSite("atacama", -22.958 * u.deg, -67.786 * u.deg, 5200 * u.m)
    table = QTable(
        {"name": ["d0"], "quat": [[0.0, 0.0, 0.0, 1.0]], "psd_net": [1e-3] * u.K * u.s**0.5}
    )
    table["fwhm"], table["psd_fknee"], table["psd_fmin"], table["psd_alpha"] = (
        [10] * u.arcmin,
        [0.1] * u.Hz,
        [1e-5] * u.Hz,
        [1.0],
    )
    plane = toast.instrument.Focalplane(
        detector_data=table, sample_rate=40 * u.Hz, field_of_view=1 * u.deg
    )
    start, stop = (datetime(2024, 6, 25, 14, minute, tzinfo=UTC) for minute in (0, 2))
    row = toast.schedule.GroundScan(
        "patch", start, stop, az_min=100 * u.deg, az_max=110 * u.deg, el=50 * u.deg
    )
    schedule = toast.schedule.GroundSchedule(
        [row], site.name, "dish", -22.958 * u.deg, -67.786 * u.deg, 5200 * u.m
    )
    data = toast.Data(toast.Comm())
    telescope = toast.instrument.Telescope("dish", focalplane=plane, site=site)
    toast.ops.SimGround(
        telescope=telescope, schedule=schedule, weather="atacama", detset_key=None
    ).apply(data)
    (o,) = data.obs
    o.detdata.ensure("signal", create_units=u.K)
    folder = tmp_path_factory.mktemp("simulated")
    return toast.io.save_hdf5(o, str(folder), detdata=["signal"]), data


def test_zonda_looks_where_toast_looked(simulated):
    """TOAST's SimGround lies some 45 arcsec from astropy on the sky; its flags, Sun and intervals
    come along.
    """
    path, data = simulated
    (theirs,) = data.obs
    found = zonda.Data(zonda.Scene(**{**SCENE, "time": "2024-06-25T14:00"}))
    zonda.PointingRecorded(file=path).observe(found)
    (o,) = found.observations
    np.testing.assert_array_equal(o.boresight_radec, theirs.shared["boresight_radec"].data)
    said = {what: text for _, what, text in o.log}[f"{o.name}: directions on the sky"]
    assert said.startswith("as recorded, up to ")
    assert (
        20 < float(said.split()[4]) < 70
    )  # arcsec; precession, nutation and aberration of an older kind
    flags = theirs.shared["flags"].data
    np.testing.assert_array_equal(o.good_samples, (flags & 15) == 0)
    np.testing.assert_array_equal(o.flags, flags)
    assert (flags & 16).all()  # the Sun is up
    for name in ("scanning", "turnaround", "throw_leftright", "scan_rightleft"):
        inside = np.zeros(o.n_samples, bool)
        for interval in theirs.intervals[name]:
            inside[interval.first : interval.last] = True
        np.testing.assert_array_equal(samples_in(o.intervals[name], o.seconds), inside)


@pytest.mark.parametrize("edge", [105.0, 104.5, 103.0])
def test_ground_templates_of_processed_samples_are_toasts(edge, tmp_path):
    """A throw that begins on the edge of a bin; 40 samples that TOAST flags as *processing*, 10 K
    higher or not: the streams of TOAST's GroundFilter, with turnarounds in the fit as in ours, and
    one map for both."""
    from datetime import datetime

    import astropy.units as u
    from astropy.table import QTable

    site = toast.instrument.GroundSite("atacama", -22.958 * u.deg, -67.786 * u.deg, 5200 * u.m)
    names = [f"d{k}" for k in range(3)]
    table = QTable(
        {"name": names, "quat": [[0.0, 0.0, 0.0, 1.0]] * 3, "psd_net": [1e-3] * 3 * u.K * u.s**0.5}
    )
    table["fwhm"], table["psd_fknee"], table["psd_fmin"] = (
        [10] * 3 * u.arcmin,
        [1.0] * 3 * u.Hz,
        [1e-5] * 3 * u.Hz,
    )
    table["psd_alpha"], table["bandcenter"], table["bandwidth"] = (
        [1.0] * 3,
        [150] * 3 * u.GHz,
        [40] * 3 * u.GHz,
    )
    plane = toast.instrument.Focalplane(
        detector_data=table, sample_rate=40 * u.Hz, field_of_view=1 * u.deg
    )
    start, stop = (datetime(2024, 6, 25, 4, minute, tzinfo=UTC) for minute in (0, 3))
    row = toast.schedule.GroundScan(
        "patch", start, stop, az_min=edge * u.deg, az_max=(edge + 12) * u.deg, el=50 * u.deg
    )
    schedule = toast.schedule.GroundSchedule(
        [row], site.name, "dish", -22.958 * u.deg, -67.786 * u.deg, 5200 * u.m
    )
    data = toast.Data(toast.Comm())
    telescope = toast.instrument.Telescope("dish", focalplane=plane, site=site)
    toast.ops.SimGround(
        telescope=telescope, schedule=schedule, weather="atacama", detset_key=None
    ).apply(data)
    toast.ops.DefaultNoiseModel().apply(data)
    toast.ops.SimNoise(det_data="signal").apply(data)
    (o,) = data.obs
    at = np.r_[200:230, 900:910]
    o.shared["flags"].set(
        np.asarray(o.shared["flags"].data)
        | np.isin(np.arange(o.n_local_samples), at).astype(np.uint8) * 2
    )
    files = []
    for value in (0.0, 10.0):
        for name in names:
            o.detdata["signal"][name][at] += value
        (tmp_path / f"{value}").mkdir()
        files.append(toast.io.save_hdf5(o, str(tmp_path / f"{value}"), detdata=["signal"]))
    steps = [zonda.GroundFilter(bin="0.5 deg", trend=1), zonda.BinMap(pixel="20 arcmin")]
    found = []
    for path in files:
        step = zonda.LoadTOD(file=path)
        found.append(
            zonda.Pipeline([step, *steps], precision="float64").run(
                step.scene(seed=1), keep=["signal"], threads=1
            )
        )
    np.testing.assert_allclose(found[1]["map"].signal, found[0]["map"].signal, rtol=0, atol=1e-12)
    traits = {
        "trend_order": 1,
        "filter_order": None,
        "bin_width": 0.5 * u.deg,
        "detrend": True,
        "shared_flag_mask": 11,
    }
    toast.ops.GroundFilter(**traits).apply(data)
    good = found[1].observations[0].good_samples
    theirs = np.array([o.detdata["signal"][name] for name in names])
    np.testing.assert_allclose(found[1].tod("signal")[:, good], theirs[:, good], rtol=0, atol=1e-11)


class Imperfect(Operator):
    """Detectors of polarization efficiencies of their own."""

    def configure(self, observation):
        plane = observation.focalplane
        plane.polarization_efficiency[:] = np.linspace(0.6, 1, len(plane))


@pytest.fixture(scope="module", params=[False, True], ids=["no plate", "half-wave plate"])
def polarized(request, tmp_path_factory):
    """Pairs at 0 and 45 deg over a sky of I, Q and U with noise, with and without a half-wave
    plate.
    """
    folder = tmp_path_factory.mktemp("polarized")
    camera = INSTRUMENT | {"polarization": "pairs", "detectors": 12, "field_of_view": "3 deg"}
    values = np.random.default_rng(5).normal(size=(3, 256, 256))
    header = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "CDELT1": -0.05,
        "CDELT2": 0.05,
    }
    sky = zonda.SkyMap(
        map=values,
        wcs=header,
        centre="target",
        unit="mK_RJ",
        polarization_convention="iau",
        fwhm="0.2 deg",
    )
    steps = [
        zonda.PointingBackAndForth(**SCAN, flag_turnarounds=True),
        Imperfect(),
        *([zonda.HalfWavePlate(frequency="2 Hz", angle="20 deg")] if request.param else []),
        sky,
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(nside=128, stokes="IQU"),
        SaveTOD(),
    ]
    data = zonda.Pipeline(steps).run(
        zonda.Scene(**(SCENE | {"instrument": camera})), output=folder, threads=1
    )
    return folder / "tod_scan-000.h5", data, request.param


def iqu_steps(plate):
    where = toast.ops.PixelsHealpix(
        nside=128, nest=False, detector_pointing=toast.ops.PointingDetectorSimple()
    )
    plate = {"hwp_angle": "hwp_angle"} if plate else {}
    return where, toast.ops.StokesWeights(
        mode="IQU", detector_pointing=where.detector_pointing, **plate
    )


def test_weights_are_those_of_toasts_compiled_kernel(polarized):
    path, data, plate = polarized
    (o,) = data.observations
    loaded = toast_data(path)
    assert ("hwp_angle" in loaded.obs[0].shared) == plate
    _, weights = iqu_steps(plate)
    weights.apply(loaded)
    found = loaded.obs[0].detdata["weights"]
    theirs = np.array([found[name] for name in o.focalplane.names])
    ours = np.empty((2, o.n_detectors, o.n_samples))
    PolarizationAngles.of(o, o.boresight_radec, np.array([0.0, 0.0, 1.0])).fill(
        np.arange(o.n_detectors), 0, *ours
    )
    ours *= o.focalplane.polarization_efficiency[:, None]
    np.testing.assert_array_equal(theirs[..., 0], 1.0)
    # rounding of angles up to 4 chi, 25 rad, in TOAST's kernel
    np.testing.assert_allclose(theirs[..., 1], ours[0], rtol=0, atol=3e-14)
    np.testing.assert_allclose(theirs[..., 2], ours[1], rtol=0, atol=3e-14)


def test_toasts_map_of_i_q_u_is_zondas(polarized):
    path, data, plate = polarized
    loaded, (where, weights) = toast_data(path), iqu_steps(plate)
    toast.ops.CovarianceAndHits(
        pixel_dist="dist",
        covariance="cov",
        hits="hits",
        rcond="rcond",
        pixel_pointing=where,
        stokes_weights=weights,
        rcond_threshold=1e-3,
    ).apply(loaded)
    pointing = {"pixel_pointing": where, "stokes_weights": weights}
    toast.ops.BinMap(pixel_dist="dist", covariance="cov", binned="map", **pointing).apply(loaded)
    product = data.products["map"]
    own = product.polarization
    hits = np.zeros(12 * 128**2)
    hits[product.pixels] = own.hits
    np.testing.assert_array_equal(full_sky(loaded["hits"]), hits)
    solved = product.known
    assert solved.sum() > 20
    local = loaded["map"]
    theirs, size = np.zeros((12 * 128**2, 3)), local.distribution.n_pix_submap
    for k, submap in enumerate(local.distribution.local_submaps):
        theirs[submap * size : (submap + 1) * size] = local.data[k]
    theirs = theirs[product.pixels[solved]]
    scale = np.abs(theirs).max()
    # ours rounds cosines and weights to 2^-31, times condition numbers of some tens
    for k, plane in enumerate((product.signal, own.q, own.u)):
        np.testing.assert_allclose(plane[solved], theirs[:, k], rtol=0, atol=1e-7 * scale)


BANDS = {"f090": (90, 27, 10, 0.3), "f150": (150, 40, 6, 0.4)}
"""By name: centre and width [GHz], FWHM [arcmin], NET [mK s(1/2)]."""


@pytest.fixture(scope="module")
def two_bands():
    """Two scans of SimGround with two bands: SimAtmosphere, SimNoise, dead detectors, flags of
    samples and detectors.
    """
    tables = []
    for name, (centre, width, fwhm, net) in BANDS.items():
        band = {"bandcenter": centre * u.GHz, "bandwidth": width * u.GHz, "fwhm": fwhm * u.arcmin}
        noise = {
            "psd_net": net * u.mK * u.s**0.5,
            "psd_fknee": 0.2 * u.Hz,
            "psd_fmin": 1e-4 * u.Hz,
            "psd_alpha": 1.3,
        }
        plane = toast.instrument_sim.fake_hexagon_focalplane(
            n_pix=7, width=2 * u.deg, sample_rate=20 * u.Hz, **band, **noise
        )
        tables.append(plane.detector_data.copy())
        tables[-1]["name"] = [f"{detector}-{name}" for detector in tables[-1]["name"]]
    table = vstack(tables, metadata_conflicts="silent")
    plane = toast.instrument.Focalplane(
        detector_data=table, sample_rate=20 * u.Hz, field_of_view=2.2 * u.deg
    )
    place = {"lat": -22.958 * u.deg, "lon": -67.786 * u.deg, "alt": 5200 * u.m}
    telescope = toast.instrument.Telescope(
        "dish", focalplane=plane, site=toast.instrument.GroundSite("here", *place.values())
    )
    begin = [datetime(2024, 6, 25, 7, minute, tzinfo=UTC) for minute in (0, 4)]
    limits = {"el": 50 * u.deg, "az_min": 170 * u.deg, "az_max": 190 * u.deg}
    scans = [
        toast.schedule.GroundScan(
            name="CES", start=start, stop=start + timedelta(minutes=3), scan_indx=k, **limits
        )
        for k, start in enumerate(begin)
    ]
    where = {f"site_{name}": value for name, value in place.items()}
    schedule = toast.schedule.GroundSchedule(
        scans=scans, site_name="here", telescope_name="dish", **where
    )
    data = toast.Data(toast.Comm())
    toast.ops.SimGround(
        telescope=telescope, schedule=schedule, weather="atacama", detset_key="pixel"
    ).apply(data)
    toast.ops.DefaultNoiseModel().apply(data)
    toast.ops.SimNoise().apply(data)
    coarse = {"xstep": 50 * u.m, "ystep": 50 * u.m, "zstep": 50 * u.m, "zmax": 500 * u.m}
    toast.ops.SimAtmosphere(
        detector_pointing=toast.ops.PointingDetectorSimple(
            boresight="boresight_azel", quats="quats_azel"
        ),
        field_of_view=3 * u.deg,
        lmin_center=100 * u.m,
        lmax_center=300 * u.m,
        **coarse,
    ).apply(data)
    draw = np.random.default_rng(1)
    for o in data.obs:
        names = list(o.local_detectors)
        o.update_local_detector_flags({names[1]: 1, names[-2]: 2})
        o.detdata.ensure("flags", dtype=np.uint8)
        for name in names:
            for first, length, bit in zip(
                draw.integers(0, 3000, 20),
                draw.integers(1, 40, 20),
                draw.integers(0, 8, 20),
                strict=True,
            ):
                o.detdata["flags"][name][first : first + length] |= np.uint8(1 << bit)
        o.detdata["signal"][names[3]][1500:1600] = 1e3  # a glitch that is flagged
        o.detdata["flags"][names[3]][1500:1600] |= 1
        shared = o.shared["flags"].data.copy()
        shared[1000:1100] |= 8
        shared[2000:2050] |= 1
        o.shared["flags"].set(shared, fromrank=0)
    return data


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "flac"])
def test_toasts_own_files_of_two_bands_give_toasts_own_maps(two_bands, tmp_path, packed):
    """One run of LoadTOD over both scans: hits equal TOAST's in both bands, maps to rounding."""
    detdata = (
        [("signal", {"type": "flac", "level": 5, "quanta": 1e-9}), ("flags", {"type": "flac"})]
        if packed
        else ["signal", "flags"]
    )
    files = [
        toast.io.save_hdf5(o, str(tmp_path), detdata=detdata, force_serial=True)
        for o in two_bands.obs
    ]
    step = LoadTOD(file=files)
    found = zonda.Pipeline([step, zonda.BinMap(nside=NSIDE)]).run(step.scene(), threads=1)
    where = pixels()
    weights = toast.ops.StokesWeights(mode="I", detector_pointing=where.detector_pointing)
    pointing = {"pixel_pointing": where, "stokes_weights": weights}
    for band in BANDS:
        chosen = [name for name in two_bands.obs[0].local_detectors if name.endswith(band)]
        names = {
            key: f"{key}_{band}" for key in ("pixel_dist", "covariance", "hits", "rcond", "binned")
        }
        counted = {key: names[key] for key in ("pixel_dist", "covariance", "hits", "rcond")}
        toast.ops.CovarianceAndHits(**counted, **pointing).apply(two_bands, detectors=chosen)
        mapped = {key: names[key] for key in ("pixel_dist", "covariance", "binned")}
        toast.ops.BinMap(**mapped, **pointing).apply(two_bands, detectors=chosen)
        hits, expected = full_sky(two_bands[names["hits"]]), full_sky(two_bands[names["binned"]])
        ours, signal = zonda_maps(found[f"map_{band}"])
        np.testing.assert_array_equal(ours, hits)
        assert (
            0.5 * 7 * 2 * 3600 < hits.sum() < 12 * 2 * 3600
        )  # 2 scans of 3600 samples; of 14 detectors 13 are good
        # tenths of a kelvin of atmosphere: float32 keeps 3e-8 K a sample; what FLAC has rounded,
        # both have read
        np.testing.assert_allclose(signal, expected, rtol=0, atol=3e-8)
        assert np.std(expected[hits > 0]) > 1e-3


def test_noise_models_of_toast_are_read(two_bands, tmp_path):
    """NET, knee and slope of the spectra that TOAST mixes and scales (ElevationNoise); the focal
    plane states others.
    """
    azel = toast.ops.PointingDetectorSimple(boresight="boresight_azel", quats="quats_azel")
    toast.ops.ElevationNoise(
        noise_model="noise_model",
        out_model="el_noise",
        detector_pointing=azel,
        noise_a=0.5,
        noise_c=0.9,
    ).apply(two_bands)
    o, *_ = two_bands.obs
    path = toast.io.save_hdf5(o, str(tmp_path), detdata=["signal"], force_serial=True)
    step = LoadTOD(file=path, noise_model="el_noise")
    plane = step.scene().instrument.focalplane()
    stated = LoadTOD(file=path).scene().instrument.focalplane()
    scaled = [np.sqrt(o["el_noise"].psd(d)[-1] / o["noise_model"].psd(d)[-1]) for d in plane.names]
    assert max(scaled) > 1.1  # that of a flagged detector is left as it is
    # of float32 spectra
    used = np.array([not o.local_detector_flags[d] & 7 for d in plane.names])
    assert 0 < used.sum() < used.size  # of others, which no map uses, zonda has the median of these
    np.testing.assert_allclose(
        plane.net[used], (stated.net * np.array(scaled, float))[used], rtol=1e-5
    )
    np.testing.assert_allclose(plane.knee[used], stated.knee[used], rtol=1e-4)
    np.testing.assert_allclose(plane.slope[used], stated.slope[used], rtol=1e-4)
