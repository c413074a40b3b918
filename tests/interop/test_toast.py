"""Our scans as TOAST's Observations and back, TOAST's map-makers on them, and our operators in a
pipeline of TOAST.

`.ci/toast` runs these in an environment with TOAST (the extra ``toast``), where none may be skipped
(ZONDA_TOAST=required).
"""

import dataclasses

import astropy.units as u
import healpy
import numpy as np
import pytest

import zonda
from zonda.core.errors import InputError, PipelineError
from zonda.operators.io.save_tod import load_tod

from ..scenes import skip_without

pytestmark = [
    pytest.mark.toast,
    pytest.mark.filterwarnings("ignore:Pointing", "ignore:LoadTOD", "ignore::DeprecationWarning"),
]

skip_without("toast")

import toast
import toast.io
import toast.ops

from zonda.interop.toast import Simulate, from_toast, to_toast


@pytest.fixture
def data(survey):
    """Both bands in TOAST's Data."""
    found = toast.Data(toast.Comm())
    found.obs.extend(to_toast(survey, scan=number, comm=found.comm) for number in (0, 1))
    return found


def same(one, other):
    """Two scans agree: what TOAST keeps in degrees and GHz to rounding, all else to the last
    bit.
    """
    for field in dataclasses.fields(one):
        a, b = (getattr(tod, field.name) for tod in (one, other))
        if field.name == "site":
            assert a[0] == b[0]
            np.testing.assert_allclose(a[1:], b[1:], rtol=1e-9)
        elif field.name == "intervals":
            assert {name: len(spans) for name, spans in a.items()} == {
                name: len(spans) for name, spans in b.items()
            }
            for name, spans in a.items():  # times are POSIX in TOAST: 0.24 us
                np.testing.assert_allclose(spans, b[name], rtol=0, atol=1e-6)
        elif field.name in ("columns", "streams"):
            assert set(a) == set(b)
            for name, values in a.items():
                np.testing.assert_allclose(values, b[name], rtol=1e-14)
        elif field.name == "metadata":
            assert {k: b[k] for k in a if k in b} == {k: a[k] for k in a if k in b}
            assert {"band", "centre_ra", "telescope_diameter"} <= set(a) & set(b)
        elif field.name == "weather":
            assert (a is None) == (b is None)
            if a is not None:
                np.testing.assert_allclose(
                    dataclasses.astuple(a), dataclasses.astuple(b), rtol=1e-12
                )
        elif isinstance(a, np.ndarray):
            np.testing.assert_allclose(a, b, rtol=0)
        elif isinstance(a, float):
            assert a == pytest.approx(b, rel=1e-14)
        else:
            assert a == b, field.name


def test_there_and_back(survey, data):
    for number, ob in enumerate(data.obs):
        same(from_toast(ob), load_tod(survey.products["tod_file"][number]))
    assert data.obs[0].session.uid == data.obs[1].session.uid  # bands of one scan
    assert data.obs[0].uid != data.obs[1].uid


def test_it_is_what_toast_reads_from_our_file(survey, data):
    comm = toast.Comm()
    for number, ours in enumerate(data.obs):
        read = toast.io.load_hdf5(str(survey.products["tod_file"][number]), comm)
        assert ours.local_detector_flags == read.local_detector_flags
        for name in read.detdata:
            np.testing.assert_array_equal(ours.detdata[name].data, read.detdata[name].data)
        assert set(read.shared.keys()) == set(ours.shared.keys())
        for name in read.shared:
            np.testing.assert_array_equal(ours.shared[name].data, read.shared[name].data)
        for name in survey.observations[number].intervals:
            assert [(i.first, i.last) for i in ours.intervals[name]] == [
                (i.first, i.last) for i in read.intervals[name]
            ]
        one, other = (
            ours.telescope.focalplane.detector_data,
            read.telescope.focalplane.detector_data,
        )
        assert one.colnames == other.colnames
        for detector in ours.local_detectors:  # float32 in the file
            np.testing.assert_allclose(
                ours["noise_model"].psd(detector).value,
                read["noise_model"].psd(detector).value,
                rtol=1e-6,
            )
            weights = [
                ob["noise_model"].detector_weight(detector).to_value("K-2") for ob in (ours, read)
            ]
            np.testing.assert_allclose(*weights, rtol=1e-6)


NSIDE = 1024


def full_sky(local):
    """The first column of a `toast.PixelData`, (12 nside^2,)."""
    found, size = np.zeros(local.distribution.n_pix), local.distribution.n_pix_submap
    for k, submap in enumerate(local.distribution.local_submaps):
        found[submap * size : (submap + 1) * size] = local.data[k, :, 0]
    return found


def test_toasts_mapmaker_beside_ours(survey, data):
    """MapMaker without templates is a binned map; ours of the same scan, whose stream was read back
    by `from_toast`.
    """
    from zonda.operators.io.save_tod import save_tod

    chosen = toast.Data(toast.Comm())
    chosen.obs.append(data.obs[1])
    pixels = toast.ops.PixelsHealpix(
        nside=NSIDE, nest=False, detector_pointing=toast.ops.PointingDetectorSimple()
    )
    weights = toast.ops.StokesWeights(mode="I", detector_pointing=pixels.detector_pointing)
    binning = toast.ops.BinMap(
        pixel_dist="dist", pixel_pointing=pixels, stokes_weights=weights, noise_model="noise_model"
    )
    maker = toast.ops.MapMaker(
        name="theirs",
        det_data="signal",
        binning=binning,
        template_matrix=None,
        keep_final_products=True,
        write_binmap=False,
        write_map=False,
        write_hits=False,
        write_cov=False,
        write_rcond=False,
        write_invcov=False,
        save_cleaned=False,
    )
    maker.apply(chosen)
    product = next(key for key in ("theirs_map", "theirs_binmap") if key in chosen)
    hits, signal = full_sky(chosen["theirs_hits"]), full_sky(chosen[product])

    folder = survey.products["tod_file"][0].parent
    again = zonda.LoadTOD(file=save_tod(folder / "back.h5", from_toast(data.obs[1])))
    ours = zonda.Pipeline([again, zonda.BinMap(nside=NSIDE)]).run(again.scene(seed=1))["map"]
    chosen.obs.clear()
    counted, brightness = np.zeros((2, 12 * NSIDE**2))
    counted[ours.pixels], brightness[ours.pixels] = ours.hits, np.nan_to_num(ours.signal)
    o = survey.observations[1]
    assert hits.sum() == o.good_samples.sum() * o.good_detectors.sum()
    np.testing.assert_array_equal(hits, counted)
    difference = np.abs(signal - brightness).max()
    print(f"\nTOAST's map minus ours: {difference:.1e} K of {np.abs(brightness).max():.1e} K")
    # both add the same float64 numbers, and ours rounds each to float32 about a level that is the
    # filtered stream's (about 0)
    assert difference < 2e-7 * np.abs(o.detdata["signal"]).max()


def pointed(data):
    """The observations without their signal, as after SimGround."""
    for ob in data.obs:
        del ob.detdata["signal"]
    return data


def test_our_atmosphere_in_a_pipeline_of_toast(survey, data):
    ops = [zonda.AtmosphereLayers(pwv="1 mm", pwv_rms="3 %"), zonda.Efficiency()]
    simulate, noise = (
        Simulate(ops, seed=3),
        toast.ops.SimNoise(noise_model="noise_model", det_data="signal"),
    )
    toast.ops.Pipeline(operators=[simulate, noise]).apply(pointed(data))
    made = [ob.detdata["signal"].data.copy() for ob in data.obs]
    assert all(np.isfinite(each).all() for each in made)
    assert all(
        5 < each.mean() < 100 for each in made
    )  # emission at 90 and 150 GHz, elevation 50 deg and 1 mm: kelvins
    for ob in data.obs:
        ob.detdata["signal"][:] = 0.0
    simulate.apply(data)
    alone = [ob.detdata["signal"].data.copy() for ob in data.obs]
    for ob, both, without, net in zip(data.obs, made, alone, (300e-6, 360e-6), strict=True):
        noise = (
            both - without
        )  # what SimNoise added; its law has NET^2 at all frequencies, two-sided
        assert ob.detdata["signal"].units == u.K
        # zonda's atmosphere holds float32 about its mean: the same bits in both. Standard error of
        # an rms of n samples 1/sqrt(2n)
        expected = net * np.sqrt(100.0)
        assert np.median(noise.std(axis=1)) == pytest.approx(
            expected, rel=5 / np.sqrt(2 * noise.shape[1]) + 0.01
        )
    # two bands of one session see one turbulence; 6 m beams at 90 and 150 GHz differ a little
    waves = [each - each.mean(axis=1, keepdims=True) for each in alone]
    for detector in (0, 3):
        assert np.corrcoef(waves[0][detector], waves[1][detector])[0, 1] > 0.999


def test_simulate_is_what_zonda_makes_on_the_same_file(survey, data, tmp_path):
    pointing = zonda.LoadTOD(file=survey.products["tod_file"][0], signal=None)
    step = zonda.GroundPickup()
    scene = pointing.scene(seed=5)
    expected = (
        zonda.Pipeline([pointing, step, zonda.Efficiency()])
        .run(scene, keep=["signal"])
        .tod("signal")
    )
    simulate = Simulate([zonda.GroundPickup(), zonda.Efficiency()], seed=7, scene={"seed": 5})
    before = data.obs[0].detdata["signal"].data.copy()
    simulate.apply(data)
    found = data.obs[0].detdata["signal"].data - before
    good = survey.observations[0].good_detectors
    assert np.abs(expected[good]).max() > 0
    np.testing.assert_allclose(
        found[good], expected[good], rtol=0, atol=1e-6 * np.abs(expected).max()
    )


def test_errors_name_cause_and_cure(survey, data):
    with pytest.raises(InputError, match=r"no stream 'sky'\n.*choose from: signal"):
        from_toast(data.obs[0], "sky")
    with pytest.raises(InputError, match="was not kept"):
        to_toast(survey, "sky", scan=0)
    with pytest.raises(PipelineError, match="points the telescope"):
        Simulate([zonda.PointingStare()])
    data.obs[0].detdata.create("power", units=u.W)
    with pytest.raises(InputError, match="in 'W', not in kelvin"):
        from_toast(data.obs[0], "power")


def test_the_page_does_what_it_says(examples, tmp_path):
    """All code of docs/interop.md on TOAST; its map, in a file, is that of the data that were read
    back.
    """
    names = examples("TOAST", {"nside": 1024})
    theirs = healpy.read_map(tmp_path / "theirs_hits.fits", dtype=None)
    assert theirs.sum() == names["data"]["map"].hits.sum() > 0
    # the last block adds the atmosphere's emission, kelvins, and noise
    assert names["found"].obs[0].detdata["signal"].data.mean() > 1


def of_toast(made, centre):
    """xi and eta as tangents and gamma of a layout that TOAST made, moved to a quaternion
    ``centre``.
    """
    from toast import qarray
    from toast.instrument_coords import quat_to_xieta

    quats = qarray.mult(centre, np.array([made[name]["quat"] for name in sorted(made)]))
    xi, eta, gamma = quat_to_xieta(quats)
    z = np.sqrt(1 - xi**2 - eta**2)
    return xi / z, eta / z, gamma


def test_published_layouts_are_those_that_toast_makes():
    """As sotodlib/toast/sim_focalplane.py composes the wafers of an SO SAT: seven in hexagons, each
    of three rhombi, turned.
    """
    from toast import qarray
    from toast.instrument_sim import hex_layout, rhomb_xieta_row_col, rhombus_hex_layout

    from zonda.plugins.layouts import LAYOUTS

    scale, axis = np.radians(0.09668), np.array([0.0, 0.0, 1.0])
    found = LAYOUTS["so_sat"](7 * 430)
    places = hex_layout(
        7,
        2 * 128.4 * scale * u.rad,
        "",
        "",
        np.zeros(7) * u.rad,
        center=qarray.from_axisangle(axis, np.radians(150)),
    )
    angles = [22.5 + 45 * (rhomb_xieta_row_col(144, p)[0] % 2) for p in range(144)] * u.deg
    for wafer, turn in enumerate((240, 0, 300, 180, 120, 60, 60)):
        centre = qarray.mult(
            places[f"{wafer}"]["quat"], qarray.from_axisangle(axis, np.radians(turn))
        )
        xi, eta, gamma = of_toast(
            rhombus_hex_layout(144, 11 * 5.3 * scale * u.rad, "", "", pol=angles), centre
        )
        pins = [144 + 66, 144 + 66 + 10]
        own = found.wafer == wafer
        np.testing.assert_allclose(found.x[own], np.delete(xi, pins), atol=1e-12)
        np.testing.assert_allclose(found.y[own], np.delete(eta, pins), atol=1e-12)
        np.testing.assert_allclose(
            np.sin(found.angle[own] - np.delete(gamma, pins)), 0, atol=1e-12
        )  # an axis, not a direction


def test_its_focal_planes_make_cameras(tmp_path):
    """`Focalplane.save_hdf5`: TOAST's own directions, angles and NETs are the camera's."""
    import h5py
    from toast.instrument_coords import quat_to_xieta
    from toast.instrument_sim import fake_hexagon_focalplane

    from zonda.core.array_table import read_array
    from zonda.core.numerics.radiation import to_kelvin_rj

    plane = fake_hexagon_focalplane(
        n_pix=19,
        width=6 * u.deg,
        fwhm=10 * u.arcmin,
        psd_net=300 * u.uK * u.s**0.5,
        psd_fknee=50 * u.mHz,
        sample_rate=50 * u.Hz,
        bandcenter=150 * u.GHz,
        bandwidth=40 * u.GHz,
        epsilon=0.02,
    )
    with h5py.File(tmp_path / "plane.h5", "w") as file:
        plane.save_hdf5(file)
    found = read_array(tmp_path / "plane.h5")
    theirs = plane.detector_data
    xi, eta, gamma = quat_to_xieta(np.asarray(theirs["quat"]))  # sines
    away = np.hypot(xi, eta)
    tangent = np.tan(np.arcsin(away)) / np.where(away > 0, away, 1.0)
    columns = found.columns
    assert list(found.names) == list(theirs["name"])
    np.testing.assert_allclose(columns["xi"], xi * tangent, rtol=0, atol=1e-12)
    np.testing.assert_allclose(columns["eta"], eta * tangent, rtol=0, atol=1e-12)
    for angle in (gamma, theirs["gamma"].to_value("rad")):
        turned = np.exp(2j * (columns["polarization_angle"] - angle))
        np.testing.assert_allclose(turned, 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(columns["polarization_efficiency"], 0.98 / 1.02, rtol=1e-12)
    band = zonda.Band(name="f150", low="130 GHz", high="170 GHz")
    factor = to_kelvin_rj("K_CMB", band)
    np.testing.assert_allclose(columns["net"], 300e-6 * factor, rtol=1e-9)
    np.testing.assert_allclose(columns["knee"], 0.05, rtol=1e-12)
