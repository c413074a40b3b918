"""sotodlib and so3g on our scans: names, flags, pointing, and so3g's map beside ours.

`.ci/sotodlib` runs these in an environment with sotodlib (the extra ``sotodlib``), where none may
be skipped (ZONDA_SOTODLIB=required).
"""

import numpy as np
import pytest

import zonda
from zonda.core.errors import InputError, ZondaError
from zonda.core.numerics.quaternions import detector_quaternions, multiply
from zonda.interop.sotodlib import sight_line, to_axismanager
from zonda.operators.io.save_tod import load_tod

from ..scenes import skip_without
from .conftest import INSTRUMENT, SCAN, SCENE

pytestmark = [
    pytest.mark.sotodlib,
    pytest.mark.filterwarnings("ignore:Pointing", "ignore::DeprecationWarning"),
]

skip_without("sotodlib")

import so3g.proj
import sotodlib.coords
import sotodlib.core


@pytest.fixture(scope="module")
def aman(survey):
    return to_axismanager(survey, scan="scan-000-f150")


@pytest.fixture(scope="module")
def observation(survey):
    return survey.observations[1]


def own_directions(o):
    """(n_det, n_samp, 4): the direction (3) and the polarization's angle psi of each detector, of
    the observation itself.
    """
    f = o.focalplane
    found = []
    for detector in detector_quaternions(f.xi, f.eta, f.polarization_angle):
        x, y, z, w = multiply(o.boresight_radec, np.broadcast_to(detector, (o.n_samples, 4))).T
        psi = np.arctan2(w * x + y * z, w * y - x * z)
        found.append([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), psi])
    return np.array(found)


def directions(sight, aman):
    """The same by so3g, from sotodlib's names."""
    plane = so3g.proj.FocalPlane.from_xieta(
        aman.focal_plane.xi, aman.focal_plane.eta, aman.focal_plane.gamma
    )
    found = []
    for lon, lat, c, s in (np.array(each).T for each in sight.coords(plane)):
        found.append(
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat), np.arctan2(s, c)]
        )
    return np.array(found)


def apart(a, b):
    """Largest separation [arcsec], and largest difference of polarization angles modulo 180 deg
    [arcsec].
    """
    psi = np.abs((a[:, 3] - b[:, 3] + np.pi / 2) % np.pi - np.pi / 2)
    chord = np.sqrt(((a[:, :3] - b[:, :3]) ** 2).sum(axis=1))
    return np.degrees([2 * np.arcsin(chord.max() / 2), psi.max()]) * 3600


def test_names_and_values(aman, observation):
    o = observation
    assert aman.dets.vals.tolist() == o.focalplane.names
    assert (aman.signal.shape, aman.signal.dtype) == ((o.n_detectors, o.n_samples), np.float32)
    np.testing.assert_array_equal(aman.signal, o.detdata["signal"].astype(np.float32))
    np.testing.assert_array_equal(aman.timestamps, o.start.posix + o.seconds)
    # azimuth and elevation are recovered from quaternions: to rounding
    np.testing.assert_allclose(aman.boresight.az % (2 * np.pi), o.azimuth, rtol=0, atol=1e-14)
    np.testing.assert_allclose(aman.boresight.el, o.elevation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(aman.boresight.roll, 0, rtol=0, atol=1e-14)
    tangent = np.hypot(o.focalplane.xi, o.focalplane.eta)
    np.testing.assert_allclose(
        np.hypot(aman.focal_plane.xi, aman.focal_plane.eta), np.sin(np.arctan(tangent)), rtol=1e-12
    )
    assert (
        np.degrees(tangent.max() - np.hypot(aman.focal_plane.xi, aman.focal_plane.eta).max()) * 3600
        > 20
    )  # at almost 4 deg
    assert set(aman.det_info.band) == set(aman.det_info.wafer.bandpass) == {"f150"}
    assert aman.det_info.wafer_slot.tolist() == [f"ws{number}" for number in o.focalplane.wafer]
    assert aman.obs_info.obs_id == "scan-000-f150"


def test_flags_are_ranges_matrices(aman, observation):
    o, flags = observation, aman.flags
    for name in (
        "invalid",
        "processing",
        "irregular",
        "sun_up",
        "detectors",
        "samples",
        "excluded",
    ):
        assert isinstance(flags[name], so3g.proj.RangesMatrix)
        assert flags[name].shape == (o.n_detectors, o.n_samples)
    np.testing.assert_array_equal(
        ~flags.excluded.mask(), o.good_detectors[:, None] & o.good_samples
    )
    np.testing.assert_array_equal(flags.turnarounds.mask(), (o.flags & 4) != 0)
    assert flags.sun_up.mask()[3, 420:600].all()
    assert flags.detectors.mask().all(axis=1).nonzero()[0].tolist() == [1, 5]
    before = flags.excluded.mask()
    flags.sun_up.buffer(1)  # in place: rows are independent, and no other flag changes
    widened = flags.sun_up.mask().sum(axis=1)
    assert (widened == widened[0]).all()
    np.testing.assert_array_equal(flags.excluded.mask(), before)


def test_sotodlibs_own_steps_take_it(observation):
    """Subscans by the directions of the throws, preprocessing, and the detectors that are not
    dark.
    """
    from sotodlib.preprocess import Pipeline
    from sotodlib.tod_ops import flags

    aman = to_axismanager(observation)
    found = flags.get_subscans(aman, merge=False)
    inside = found.subscan_flags.mask()
    good = (observation.flags & 4) == 0
    np.testing.assert_array_equal(inside.any(axis=0), good)
    rate = np.gradient(np.unwrap(observation.azimuth))
    for direction, one in zip(found.direction, inside, strict=True):
        assert (np.sign(np.median(rate[one])) > 0) == (direction == "right")
    flags.get_turnaround_flags(to_axismanager(observation), merge=False)
    assert not flags.get_dark_dets(aman, merge=False).mask().any()
    steps = [{"name": "glitches", "glitch_name": "g", "calc": {"n_sig": 10}, "save": True}]
    Pipeline(steps).run(to_axismanager(observation))


def test_a_file_gives_what_the_run_gives(survey, aman):
    path = survey.products["tod_file"][1]
    for other in (
        to_axismanager(path),
        to_axismanager(load_tod(path)),
        to_axismanager(survey.observations[1]),
    ):
        for name in (
            "timestamps",
            "signal",
            "boresight.az",
            "boresight_equ.psi",
            "focal_plane.xi",
            "det_info.band",
        ):
            np.testing.assert_array_equal(other[name], aman[name])
        np.testing.assert_array_equal(other.flags.excluded.mask(), aman.flags.excluded.mask())
        assert (other.det_info.wafer_slot == aman.det_info.wafer_slot).all()


def test_so3g_points_where_zonda_points(survey, aman, observation):
    """Both transform above the atmosphere by IAU models with the Earth's orientation of the IERS,
    and agree to 0.001 arcsec. Polar motion, which so3g leaves out by itself, is 0.48 arcsec on this
    day; with the wrong sign it would be twice that."""
    ours = own_directions(observation)
    recorded = so3g.proj.CelestialSightLine.for_lonlat(
        aman.boresight_equ.ra, aman.boresight_equ.dec, aman.boresight_equ.psi
    )
    assert apart(directions(recorded, aman), ours)[0] < 0.01
    separation, angle = apart(directions(sight_line(survey, scan=1), aman), ours)
    print(f"\nso3g's pointing: {separation:.3f} arcsec, polarization angle {angle:.2f} arcsec")
    assert separation < 0.02
    assert angle < 0.05


def test_so3g_maps_what_zonda_maps(survey, aman, observation):
    """so3g's projection of our pointing onto pixell's pixels: what lies on an edge of pixels may
    fall to either side.
    """
    from pixell import enmap

    ours = survey.products["map_f150"]
    header = ours.wcs.to_header()
    geometry = enmap.zeros(ours.hits.shape, ours.wcs)
    assert header["CTYPE1"].endswith("CAR")
    matrix = sotodlib.coords.P.for_tod(
        aman, geom=geometry.geometry, comps="T", cuts=aman.flags.excluded
    )
    hits = np.asarray(matrix.to_weights()[0, 0])
    total = np.asarray(matrix.to_map(tod=aman)[0])
    moved = np.abs(hits - ours.hits).sum() / ours.hits.sum()
    print(f"\nhits that are in another pixel: {moved / 2:.1e}")
    assert hits.sum() == ours.hits.sum()
    assert moved < 2e-4  # two for each sample that moved
    same = (hits == ours.hits) & (hits > 0)
    # all detectors weigh the same; float32 signals of 1e-2 K
    found = total[same] / hits[same]
    np.testing.assert_allclose(
        found, ours.signal[same], rtol=0, atol=1e-6 * np.abs(ours.signal[same]).max()
    )


def test_bands_are_joined_by_sotodlib(survey):
    both = [to_axismanager(survey, scan=number) for number in (0, 1)]
    whole = sotodlib.core.AxisManager.concatenate(both, axis="dets", other_fields="first")
    assert whole.signal.shape == (28, survey.observations[0].n_samples)
    assert sorted(set(whole.det_info.band)) == ["f090", "f150"]
    assert whole.flags.excluded.shape == whole.signal.shape


def test_errors_name_cause_and_cure(survey, tmp_path):
    with pytest.raises(InputError, match=r"the stream 'sky' was not kept.*\n.*keep="):
        to_axismanager(survey, "sky", scan=0)
    with pytest.raises(InputError, match=r"there are 2 scans: scan-000-f090, scan-000-f150"):
        to_axismanager(survey)
    with pytest.raises(InputError, match=r"no stream 'sky'\n.*choose from: signal"):
        to_axismanager(survey.products["tod_file"][0], "sky")
    with pytest.raises(InputError, match="leave it out"):
        to_axismanager(survey.observations[0], scan=1)
    (tmp_path / "no.h5").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"no\.h5"):
        to_axismanager(tmp_path / "no.h5")


def test_the_page_does_what_it_says(examples):
    """All code of docs/interop.md on sotodlib; its map is zonda's where so3g counts the same
    hits.
    """
    names = examples("sotodlib", {"projection": "CAR", "pixel": "2 arcmin"})
    assert sorted(set(names["whole"].det_info.band)) == ["f090", "f150"]
    ours, hits = names["data"]["map"], np.asarray(names["matrix"].to_weights()[0, 0])
    same = (hits == ours.hits) & (hits > 0)
    assert np.abs(hits - ours.hits).sum() < 2e-4 * ours.hits.sum()
    largest = np.nanmax(np.abs(ours.signal))
    # the file's signal, rounded to float32, of the same samples
    np.testing.assert_allclose(
        names["signal"][same], ours.signal[same], rtol=0, atol=1e-6 * largest
    )


def test_its_hardware_makes_cameras(tmp_path):
    """`Hardware.dump` with the nominal bands; detectors as `sim_detectors_toast` writes them."""
    from sotodlib.sim_hardware import sim_nominal

    from zonda.core.array_table import read_array

    hardware = sim_nominal()
    gamma = np.radians([0.0, 90.0, 45.0, 135.0])
    q = so3g.proj.quat.rotation_xieta(np.full(4, 0.01), np.full(4, -0.02), gamma)
    for k, quat in enumerate(q):
        of = {"wafer_slot": f"w{k // 2}", "band": ("SAT_f090", "SAT_f150")[k // 2], "fwhm": 30.0}
        wxyz = [float(getattr(quat, letter)) for letter in "abcd"]
        of |= {"quat": [*wxyz[1:], wxyz[0]], "gamma": float(np.degrees(gamma[k]))}
        hardware.data["detectors"] = hardware.data.get("detectors", {}) | {f"d{k}": of}
    hardware.dump(str(tmp_path / "hw.toml.gz"), compress=True)
    found = read_array(tmp_path / "hw.toml.gz")
    assert found.bands == ["f090", "f090", "f150", "f150"]
    np.testing.assert_allclose(np.sin(np.arctan(found.reach)), np.hypot(0.01, 0.02), rtol=1e-12)
    np.testing.assert_allclose(found.columns["xi"] / found.columns["eta"], -0.5, rtol=1e-12)
    turned = np.exp(2j * (found.columns["polarization_angle"] - gamma))
    np.testing.assert_allclose(turned, 1.0, rtol=0, atol=1e-12)
    assert found.columns["wafer"].tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize("encoding", [None, "flacarray"])
def test_what_it_saves_is_loaded(survey, tmp_path, encoding):
    """`AxisManager.save`, then LoadTOD: the pointing to rounding, flags, and the map of the run."""
    paths = []
    for band in ("f090", "f150"):
        aman = to_axismanager(survey, scan=f"scan-000-{band}", dtype="float64")
        paths.append(tmp_path / f"{band}.h5")
        if encoding:
            flac = {"signal": {"type": encoding, "args": {"quanta": 1e-10}}}
            aman.save(str(paths[-1]), encodings=flac)
        else:
            aman.save(str(paths[-1]), group="obs", compression="gzip")
    recorded = zonda.LoadTOD(file=paths, unit="K_RJ")
    mapped = zonda.BinMap(projection="CAR", pixel="2 arcmin")
    scene = recorded.scene(seed=1, instrument=survey.scene.instrument)
    again = zonda.Pipeline([recorded, mapped]).run(scene)
    found, ours = again.observations[1], survey.observations[1]
    np.testing.assert_array_equal(found.detector_flags != 0, ours.detector_flags != 0)
    np.testing.assert_array_equal(found.good_samples, ours.good_samples)
    np.testing.assert_array_equal(found.flags & 4, ours.flags & 4)
    assert set(found.intervals) >= {"throw_leftright", "throw_rightleft"}
    for name in ("boresight_azel", "boresight_radec"):
        one, other = getattr(found, name), getattr(ours, name)
        np.testing.assert_allclose(np.abs((one * other).sum(axis=1)), 1, rtol=0, atol=1e-14)
    for band in ("f090", "f150"):
        own, other = survey.products[f"map_{band}"], again.products[f"map_{band}"]
        assert own.hits.sum() == other.hits.sum()
        moved = np.abs(own.hits - other.hits).sum() / own.hits.sum()
        assert moved < 1e-4  # POSIX times, 0.24 us, move what lies on an edge of pixels
        same = (own.hits == other.hits) & (own.hits > 0)
        # FLAC rounds samples of 1e-2 K to 1e-10 K, float64 to 1e-18 K
        np.testing.assert_allclose(other.signal[same], own.signal[same], rtol=0, atol=2e-10)


Q, U = 1e-3, 4e-4
"""K, of the sky that a camera with a half-wave plate sees."""


@pytest.fixture(scope="module")
def modulated(tmp_path_factory):
    """A scan of a sky of uniform Q and U through a plate of 2 Hz: 14 detectors, 100 s at 200 Hz."""
    import healpy

    folder = tmp_path_factory.mktemp("modulated")
    sky = [np.full(healpy.nside2npix(16), value) for value in (0.0, Q, U)]
    more = {"extra_header": [("POLCCONV", "COSMO")], "dtype": np.float64}
    healpy.write_map(folder / "sky.fits", sky, column_units="K_RJ", coord="C", **more)
    camera = {key: value for key, value in INSTRUMENT.items() if key != "bands"}
    camera |= {"band": INSTRUMENT["bands"][1], "sample_rate": "200 Hz", "fwhm": "30 arcmin"}
    camera["band"] = {key: camera["band"][key] for key in ("name", "low", "high")}
    camera |= {"net": "1 uK s(1/2)", "main_beam_efficiency": 1.0}
    steps = [
        zonda.PointingBackAndForth(
            **SCAN | {"throw": "20 deg", "scan_duration": "100 s"}, flag_turnarounds=True
        ),
        zonda.HalfWavePlate(frequency="2 Hz"),
        zonda.SkyMap(file=folder / "sky.fits"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.SaveTOD(),
    ]
    scene = zonda.Scene(**SCENE | {"instrument": camera})
    return zonda.Pipeline(steps).run(scene, output=folder, keep=["signal"], threads=1)


def test_a_chain_of_its_preprocessing(modulated):
    """Cuts by det_cal and wafer.type, trimming, detrending, turnarounds, glitches, calibration,
    polynomials in subscans and demodulation, one after the other.
    """
    from sotodlib.preprocess import Pipeline

    steps = [
        {"name": "det_bias_flags", "calc": {"rfrac_range": [0.1, 0.7]}, "save": True},
        {"name": "dark_dets", "calc": True, "save": True},
        {"name": "fft_trim", "process": {"prefer": "center"}},
        {"name": "detrend", "process": {"method": "linear"}},
        {"name": "flag_turnarounds", "process": {"method": "scanspeed", "t_buffer": 1.0}},
        {"name": "glitches", "glitch_name": "glitches", "calc": {"n_sig": 10}, "save": True},
        {"name": "calibrate", "process": {"kind": "array", "cal_array": "det_cal.phase_to_pW"}},
        {"name": "sub_polyf", "process": {"degree": 1, "method": "polyfit", "in_place": True}},
        {"name": "demodulate", "process": {"trim_samps": 1000, "demod_cfgs": {}}},
    ]
    aman = to_axismanager(modulated)
    before = aman.samps.count
    found, _ = Pipeline(steps).run(aman)
    assert found.darks.darks.mask().sum() == found.det_bias_flags.det_bias_flags.mask().sum() == 0
    assert before - 3000 < aman.samps.count < before
    assert np.isfinite(aman.demodQ).all()
    assert aman.subscan_info.subscans.count > 1


@pytest.mark.parametrize("file", [False, True])
def test_its_demodulation_finds_the_sky(modulated, file):
    """The signs of Q, U, the plate and gamma are sotodlib's: its map of the demodulated streams."""
    from sotodlib.coords import demod
    from sotodlib.preprocess import Pipeline

    aman = to_axismanager(modulated.products["tod_file"][0] if file else modulated)
    steps = [
        {"name": "detrend", "process": {"method": "mean"}},
        {"name": "demodulate", "process": {"trim_samps": 2000, "demod_cfgs": {}}},
    ]
    Pipeline(steps).run(aman)
    found = demod.make_map(aman, res=np.radians(1.0))
    whole = np.asarray(found["weight"])[1, 1]
    seen = whole > 0.1 * whole.max()
    for number, value in ((1, Q), (2, U)):
        mean = np.average(np.asarray(found["map"])[number][seen], weights=whole[seen])
        # 1 uK s(1/2) of 14 detectors in 80 s: sqrt(2) x 1 uK / sqrt(14 x 80) = 0.04 uK; the filters'
        # ends and the apodized band leave 1e-4 of 1 mK
        np.testing.assert_allclose(mean, value, rtol=0, atol=5e-7)


def test_damaged_flac_is_refused(tmp_path):
    """A scan compressed with FLAC in which bytes, starts or types of the streams are others."""
    import json
    import random

    import flacarray.hdf5
    import h5py

    from ..axismanagers import saved
    from ..fuzz.test_values import in_array, mapped

    refused = 0
    for seed in range(20):
        rng, path = random.Random(seed), saved(tmp_path / "a.h5")
        with h5py.File(path, "a") as file:
            values = file["signal"][:]
            del file["signal"]
            group = file.create_group("signal")
            flacarray.hdf5.write_array(values, group, quanta=1e-7)
            about = json.loads(file.attrs["_axisman"])
            about["schema"][1]["encoding"] = "flacarray"
            file.attrs["_axisman"] = json.dumps(about)
            name = rng.choice(list(group))
            item = group[name]
            made, kept = np.array(item[()]), dict(item.attrs)
            if seed == 0:
                pass
            elif rng.random() < 0.5 and made.size:
                made.flat[rng.randrange(made.size)] = rng.randrange(128)
            else:
                made = in_array(made, rng)
            del group[name]
            group[name] = made
            for key, value in kept.items():
                group[name].attrs[key] = value
        try:
            mapped(path)
        except ZondaError:
            refused += 1
            assert seed
    assert refused > 5
