"""Maps of I, Q and U: recovery, exact sums, covariance, halves, files, and what is refused."""

import re
import warnings
from dataclasses import replace

import healpy
import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

import zonda
from zonda.core.data import Data
from zonda.core.errors import InputError, PipelineError
from zonda.core.maps.map_file import MapFile, Provenance
from zonda.core.numerics.projection import frame_rotation
from zonda.core.polarization import PolarizationAngles
from zonda.operators.diagnostics.plot_operators import Flat
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.maps.grid import TangentGrid
from zonda.operators.maps.map_sums import MapSums
from zonda.plugins.checks import scenes
from zonda.plugins.checks.scenes import run, scan
from zonda.plugins.metrics.common import covered

STOKES_I, Q, U = 1.0, 0.3, -0.2
PAIRS = np.radians([0.0, 90.0, 45.0, 135.0])
UNIT = 2.0**-30
"""To which cosines and weights are rounded."""


def observation(n_det=24, n=4000, efficiency=0.9, seed=0):
    """Circles of 1 arcmin, pairs at 0 and 45 deg."""
    o = scan(n_det, n, radius=1.0)
    o.focalplane.polarization_angle[:] = np.resize(PAIRS, n_det)
    o.focalplane.polarization_efficiency[:] = efficiency
    return o


def angles(o, frame="icrs"):
    found = np.empty((2, o.n_detectors, o.n_samples))
    PolarizationAngles.of(o, o.boresight_radec, frame_rotation(frame)[2]).fill(
        np.arange(o.n_detectors), 0, *found
    )
    return o.focalplane.polarization_efficiency[:, None] * found


def signal_of(o, i=STOKES_I, q=Q, u=U, frame="icrs"):
    cosine, sine = angles(o, frame)
    return i + q * cosine + u * sine


def mapped(o, signal, **parameters):
    how = {"pixel": "15 arcsec"} if not {"nside", "pixel"} & parameters.keys() else {}
    return run([BinMap(stokes="IQU", **how, **parameters)], o, signal).products["map"]


def planes(product):
    return np.stack([product.signal, product.polarization.q, product.polarization.u])


@pytest.mark.parametrize("frame", ["icrs", "galactic"])
@pytest.mark.parametrize(
    "how", [{"pixel": "15 arcsec"}, {"nside": 8192}, {"pixel": "15 arcsec", "projection": "CAR"}]
)
@pytest.mark.parametrize("plate", [False, True])
def test_noiseless_recovery_to_rounding(how, frame, plate):
    o = observation()
    if plate:
        o.hwp_angle = 11.0 * o.seconds
    product = mapped(o, signal_of(o, frame=frame), frame=frame, **how)
    found, solved = planes(product), product.known
    assert solved.sum() > 40
    # terms of the matrix and cosines are rounded to 2^-31: as much of I + |Q| + |U|, times the
    # condition number (pixels hit from all angles have about 2)
    limit = 4 * UNIT * np.maximum(product.polarization.condition[solved], 2)
    for plane, value in zip(found, (STOKES_I, Q, U), strict=True):
        assert (abs(plane[solved] - value) < limit).all()
        assert np.isnan(plane[~solved]).all()


def in_the_pixel(o, side):
    """(1, c, s) of the samples (n, 3) in a pixel of ``side`` arcsec in the middle, their noise
    (n,), and which they are.
    """
    inside, grid = (
        np.zeros((o.n_detectors, o.n_samples), np.int32),
        TangentGrid(o.centre, np.radians(side / 3600), (1, 1)),
    )
    grid.pixels(grid.pointing(o), 0, o.n_samples, o.focalplane.xi, o.focalplane.eta, inside)
    inside = inside == 0
    cosine, sine = angles(o)
    sigma = np.broadcast_to((o.focalplane.net * np.sqrt(o.sample_rate))[:, None], inside.shape)[
        inside
    ]
    return np.stack([np.ones(inside.sum()), cosine[inside], sine[inside]], axis=1), sigma, inside


def test_the_map_is_the_weighted_least_squares_fit():
    """Against numpy's least squares in the pixel with most samples, weights and all."""
    o = observation()
    rng = np.random.default_rng(5)
    o.focalplane.net[:] *= rng.uniform(0.7, 1.5, o.n_detectors)
    noisy = signal_of(o) + rng.normal(size=(o.n_detectors, o.n_samples))
    product = mapped(o, noisy, width="20 arcsec", pixel="20 arcsec")  # one pixel
    design, sigma, inside = in_the_pixel(o, 20.0)
    matrix = np.linalg.inv(design.T @ (design / sigma[:, None] ** 2))
    fit = matrix @ design.T @ (noisy[inside] / sigma**2)
    np.testing.assert_allclose(planes(product)[:, 0, 0], fit, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        product.polarization.covariance[:, 0, 0], matrix[np.triu_indices(3)], rtol=1e-6, atol=1e-12
    )
    np.testing.assert_allclose(product.noise, np.sqrt(matrix[0, 0]), rtol=1e-6)
    np.testing.assert_allclose(product.weights, 1 / matrix[0, 0], rtol=1e-6)


def test_uniform_weights_have_the_covariance_of_the_samples():
    """A^-1 N A^-1, against numpy."""
    o = observation()
    o.focalplane.net[:] *= np.random.default_rng(7).uniform(0.5, 2, o.n_detectors)
    product = mapped(o, signal_of(o), weights="uniform", width="40 arcsec", pixel="40 arcsec")
    design, sigma, _ = in_the_pixel(o, 40.0)
    inverse = np.linalg.inv(design.T @ design)
    expected = inverse @ (design.T @ (design * sigma[:, None] ** 2)) @ inverse
    np.testing.assert_allclose(
        product.polarization.covariance[:, 0, 0],
        expected[np.triu_indices(3)],
        rtol=1e-6,
        atol=1e-12,
    )


def test_noise_of_the_map_is_what_it_states():
    """(m - truth)^T C^-1 (m - truth) is chi squared with three degrees of freedom in each pixel."""
    o = observation(n=8000)
    rng = np.random.default_rng(6)
    sigma = o.focalplane.net[:, None] * np.sqrt(o.sample_rate)
    product = mapped(o, signal_of(o) + sigma * rng.normal(size=(o.n_detectors, o.n_samples)))
    solved = product.known
    rest = (planes(product) - np.array([STOKES_I, Q, U])[:, None, None])[:, solved]
    rows, columns = np.triu_indices(3)
    matrix = np.empty((solved.sum(), 3, 3))
    for k, (a, b) in enumerate(zip(rows, columns, strict=True)):
        matrix[:, a, b] = matrix[:, b, a] = product.polarization.covariance[k][solved]
    chi2 = np.einsum("in,nij,jn->n", rest, np.linalg.inv(matrix), rest)
    n = chi2.size  # mean 3, variance 6: five standard errors
    assert abs(chi2.mean() - 3) < 5 * np.sqrt(6 / n)
    for name, value in (("I", STOKES_I), ("Q", Q), ("U", U)):
        plane = product.stokes(name)
        pull = ((plane.signal - value) / plane.noise)[solved]
        assert abs(pull.std() - 1) < 5 / np.sqrt(2 * n)


def sums_of(o, signal, n_signals=1):
    operator = BinMap(stokes="IQU", pixel="15 arcsec", width="3 arcmin")
    kept = []
    operator_finalize = BinMap.finalize

    def keep(self, data):
        kept.append(data.partial[self.label])
        operator_finalize(self, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BinMap, "finalize", keep)
        run([operator], o, signal, threads=2)
    return kept[0]


def test_sums_that_are_merged_have_the_bits_of_one_run():
    """Two scans in one process, or each in a process of its own, written and read between."""
    o = observation()
    rng = np.random.default_rng(8)
    noisy = signal_of(o) + rng.normal(size=(o.n_detectors, o.n_samples))
    parts = [MapSums.of(dict(sums_of(o, signal).arrays())) for signal in (noisy, -2 * noisy)]
    whole = parts[0]
    whole += parts[1]
    data = whole.columns["data signal"]
    even, odd = whole.sums
    np.testing.assert_array_equal(even[:, : data.start], odd[:, : data.start])  # the same pointing
    np.testing.assert_array_equal(odd[:, data], sums_of(o, -2 * noisy).sums[0][:, data])
    assert len(whole.scans) == 2


@pytest.mark.parametrize("settings_of", [{"threads": 2}, {"memory": 6_000_000}])
def test_bits_do_not_depend_on_threads_or_blocks(settings_of):
    o = observation()
    noisy = signal_of(o) + np.random.default_rng(9).normal(size=(o.n_detectors, o.n_samples))
    step = {"stokes": "IQU", "pixel": "15 arcsec"}
    one = run([BinMap(**step)], o, noisy).products["map"]
    other = run([BinMap(**step)], observation(), noisy, **settings_of).products["map"]
    np.testing.assert_array_equal(planes(one), planes(other))
    np.testing.assert_array_equal(one.polarization.covariance, other.polarization.covariance)


@settings(deadline=None, max_examples=15)
@given(st.floats(-3, 3), st.floats(-3, 3), st.integers(0, 1000))
def test_linear(a, b, seed):
    """The map of a sum is the sum of the maps."""
    o = observation(8, 600)
    one, two = np.random.default_rng(seed).normal(size=(2, 8, 600))
    how = {"pixel": "60 arcsec", "condition_limit": 20.0}
    first, second, both = (planes(mapped(o, s, **how)) for s in (one, two, a * one + b * two))
    np.testing.assert_allclose(both, a * first + b * second, rtol=0, atol=1e-8)


def test_pixels_that_are_not_determined_are_nan_and_counted():
    o = observation(2, 2000)  # one pair, of one orientation on circles of 1 arcmin
    data = run([BinMap(stokes="IQU", pixel="15 arcsec")], o, signal_of(o))
    product = data.products["map"]
    hit = product.polarization.hits > 0
    assert np.isnan(planes(product)).all()
    assert np.isinf(product.polarization.condition[hit]).all()
    assert np.isnan(product.polarization.condition[~hit]).all()
    count = {what: value for who, what, value in data.log if who == "BinMap"}
    assert count["pixels whose samples do not determine I, Q and U: NaN"].startswith(
        str(int(hit.sum()))
    )
    assert not product.known.any()
    assert not product.weights.any()


def pairs_at(degrees, **changes):
    """One scan of pairs whose first detectors are at these angles [deg], as `BinMap.check` sees
    it.
    """
    o = observation(2 * len(degrees), 400)
    o.focalplane.polarization_angle[:] = np.radians([a + b for a in degrees for b in (0.0, 90.0)])
    return replace(o, **changes)


def warnings_of(*scans, **parameters):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        whole = Data(scene=scenes.scene(scans[0].instrument), observations=list(scans))
        BinMap(stokes="IQU", pixel="60 arcsec", **parameters).check(whole)
    return [str(w.message) for w in caught if "beam" not in str(w.message)]  # a wide pixel's


def test_too_few_angles_are_told_beforehand():
    """One pair determines I and Q of its own axes; behind a plate, or with one at 45 deg, all
    three.
    """
    (text,) = warnings_of(pairs_at([0.0, 90.0, 0.0]))
    assert "hardly a pixel will have I, Q and U" in text
    assert "HalfWavePlate" in text
    assert not warnings_of(pairs_at([0.0, 45.0]))
    assert not warnings_of(pairs_at([0.0], hwp_angle=11.0 * np.arange(400) / 100))
    one_of_two = pairs_at([0.0, 45.0])
    one_of_two.detector_flags[2:] = 1
    assert len(warnings_of(one_of_two)) == 1
    assert not warnings_of(pairs_at([0.0, 3.0]))
    assert (
        len(warnings_of(pairs_at([0.0, 3.0]), condition_limit=50.0)) == 1
    )  # 2 / (1 - cos 6 deg), and a little more
    o = pairs_at([0.0])
    assert not zonda.HalfWavePlate(frequency="2 Hz").check(
        Data(scene=scenes.scene(o.instrument), observations=[o])
    )
    assert not warnings_of(o)


@pytest.mark.parametrize("n", [1998, 2001, 2997, 3999, 6003])
def test_angles_that_repeat_from_detector_to_detector_are_seen(n):
    o = observation(n, 400)
    o.focalplane.polarization_angle[:] = np.radians(np.resize([0.0, 60.0, 120.0], n))
    assert not warnings_of(o)


@pytest.mark.parametrize("n", [8, 40, 96])
def test_angles_that_repeat_from_scan_to_scan_are_seen(n):
    """A plate that is stepped by 22.5 deg and back."""
    assert not warnings_of(
        *(pairs_at([0.0], hwp_angle=np.full(400, np.radians(22.5 * (k % 2)))) for k in range(n))
    )


def test_a_map_of_nan_is_told():
    for degrees, words in (([0.0], "BinMap: the whole map is NaN"), ([0.0, 45.0], "")):
        o = pairs_at(degrees)
        o.focalplane.xi[:], o.focalplane.eta[:] = 0.0, 0.0
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            product = mapped(o, np.ones((o.n_detectors, o.n_samples)), pixel="60 arcsec")
        told = [str(w.message) for w in caught if "angles of polarization" in str(w.message)]
        assert [text.startswith(words) for text in told] == [True] * bool(words)
        assert bool(product.known.any()) == (not words)


def test_a_lower_limit_of_the_condition_number_leaves_pixels_out():
    o = observation()
    product = mapped(o, signal_of(o))
    condition = product.polarization.condition[product.known]
    limit = float(np.median(condition))
    fewer = mapped(o, signal_of(o), condition_limit=limit)
    np.testing.assert_array_equal(
        fewer.known, product.known & (product.polarization.condition <= limit)
    )
    np.testing.assert_array_equal(fewer.hits, product.hits)  # the samples are there
    smooth = fewer.smoothed(
        np.radians(1 / 60)
    )  # what is not known neither contributes nor is filled
    np.testing.assert_array_equal(np.isfinite(planes(smooth)).all(axis=0), fewer.known)
    assert np.array_equal(np.isfinite(smooth.noise), fewer.known)
    assert not (Flat.of(fewer, {"signal": fewer.signal}).hits[~fewer.known]).any()
    assert np.array_equal(covered(fewer) & ~fewer.known, np.zeros(fewer.hits.shape, bool))


def test_half_differences_have_the_noise_of_the_map():
    o = observation(n=8000)
    sigma = o.focalplane.net[:, None] * np.sqrt(o.sample_rate)
    noise = sigma * np.random.default_rng(10).normal(size=(o.n_detectors, o.n_samples))
    product = mapped(o, signal_of(o) + noise, half_difference="halves")
    for name in "IQU":
        plane = product.stokes(name)
        pull = (plane.half_difference / plane.noise)[np.isfinite(plane.half_difference)]
        assert pull.size > 50
        assert abs(pull.mean()) < 5 / np.sqrt(pull.size)
        assert abs(pull.std() - 1) < 5 / np.sqrt(2 * pull.size)


@pytest.mark.parametrize("how", [{"pixel": "15 arcsec"}, {"nside": 256}])
def test_files(tmp_path, how):
    o = observation()
    product = mapped(o, signal_of(o), **how)
    path = MapFile.of("map", product).write(tmp_path / "map.fits", Provenance.of_a_map(product))
    if "nside" in how:
        i, q, u = healpy.read_map(path, field=(0, 1, 2), partial=True)
        for plane, value in ((i, STOKES_I), (q, Q), (u, U)):
            known = np.isfinite(plane) & (plane != healpy.UNSEEN)
            np.testing.assert_allclose(plane[known], value, rtol=0, atol=1e-5)
        header = fits.getheader(path, 1)
        assert [header[f"TTYPE{k}"] for k in (2, 3, 4)] == ["I", "Q", "U"]
        assert header["TUNIT7"] == "K2"
        assert header["TTYPE7"] == "COV_II"
    else:
        with fits.open(path) as file:
            for name, plane in zip("IQU", planes(product), strict=True):
                np.testing.assert_array_equal(file[name].data, plane)
            assert file["COV_QU"].header["BUNIT"] == "K2"
            np.testing.assert_array_equal(file["HITS"].data, product.hits)
            header = file["Q"].header
    assert header["POLCCONV"] == "COSMO"


def test_a_map_is_read_again_as_a_sky(tmp_path):
    o = observation()
    product = mapped(o, signal_of(o))
    path = MapFile.of("map", product).write(tmp_path / "map.fits", Provenance.of_a_map(product))

    found = zonda.SkyMap(file=path, missing="zero").read_input(True)
    np.testing.assert_array_equal(found.polarization, np.nan_to_num(planes(product)[1:]))


def test_smoothing_units_and_planes():
    o = observation()
    product = mapped(o, signal_of(o))
    product.band = o.instrument.band
    solved = product.known
    smooth = product.smooth("30 arcsec")
    for name, value in (("I", STOKES_I), ("Q", Q), ("U", U)):
        np.testing.assert_allclose(smooth.stokes(name).signal[solved], value, rtol=0, atol=1e-5)
    assert (smooth.stokes("Q").noise[solved] < product.stokes("Q").noise[solved]).all()
    micro = product.to("uK_RJ")
    np.testing.assert_allclose(micro.polarization.q[solved], Q * 1e6, rtol=1e-5)
    np.testing.assert_allclose(
        micro.polarization.covariance, product.polarization.covariance * 1e12, rtol=1e-12
    )
    np.testing.assert_allclose(product.stokes("P").signal[solved], np.hypot(Q, U), rtol=1e-5)
    assert product.smoothed_rms(1e-4) == pytest.approx(product.stokes("I").smoothed_rms(1e-4))
    with pytest.raises(InputError, match="none of I, Q, U and P"):
        product.stokes("V")
    with pytest.raises(InputError, match="no Q and U"):
        product.stokes("I").stokes("Q")


def test_the_cure_for_detectors_without_angles_names_what_states_them(tmp_path):
    table, data = tmp_path / "plane.csv", Data(scenes.scene())
    data.observations = [scan(7, 500)]
    with pytest.raises(
        PipelineError, match=r"is\n  = set polarization: pairs of the instrument, or set stokes: I"
    ):
        BinMap(stokes="IQU").check(data)
    for columns, cure in (
        ("", f"add the column polarization_angle to {table}"),
        (
            ", polarization_angle [deg], polarization_efficiency",
            "(polarization_efficiency, if it is there, must be above 0)",
        ),
    ):
        own = ", 45, 0" if columns else ""
        table.write_text(f"name, xi [arcmin], eta [arcmin]{columns}\na, 0, 0{own}\nb, 1, 0{own}\n")
        data.observations = [scan(instrument=scenes.camera().varied(focalplane=table, detectors=2))]
        with pytest.raises(PipelineError, match=re.escape(cure)):
            BinMap(stokes="IQU").check(data)


def test_what_is_refused():
    o = scan(7, 500)
    with pytest.raises(PipelineError, match="needs polarized detectors"):
        run([BinMap(stokes="IQU")], o, np.ones((7, 500)))
    data = Data(scenes.scene(o.instrument))
    data.observations = [o]
    with pytest.raises(
        PipelineError, match="needs polarized detectors"
    ):  # `zonda check` says so, too
        BinMap(stokes="IQU").check(data)
    for parameters, text in (
        ({"noise": "scatter"}, "noise: scatter is for maps of I"),
        ({"contents": "hits"}, "contents: hits needs no stokes"),
        ({"half_difference": "detectors"}, "one polarization each"),
    ):
        with pytest.raises(zonda.ZondaError, match=text):
            BinMap(stokes="IQU", **parameters)
    with pytest.raises(zonda.ZondaError, match="belongs to stokes: IQU"):
        BinMap(condition_limit=5.0)


def test_flagged_and_not_finite_samples_are_dropped_and_counted():
    o = observation()
    signal = signal_of(o)
    o.flags[100:150] = 1
    o.detector_flags[3] = 1
    signal[5, 1000:1010] = np.nan
    signal[6, 1000] = np.inf
    signal[:, 100:150] = 1e30
    data = run([BinMap(stokes="IQU", width="1 arcmin", pixel="15 arcsec")], o, signal)
    count = {
        what: int(value.split()[0])
        for who, what, value in data.log
        if who == "BinMap" and what.startswith("samples")
    }
    assert count["samples dropped: flagged"] == o.n_samples + (o.n_detectors - 1) * 50
    assert count["samples dropped: not finite"] == 11
    assert sum(count.values()) == o.n_detectors * o.n_samples
    product = data.products["map"]
    assert count["samples binned"] == product.hits.sum()
    solved = product.known
    np.testing.assert_allclose(product.polarization.q[solved], Q, rtol=0, atol=1e-5)


@pytest.mark.nightly
def test_a_campaign_of_two_workers_gives_the_bits_of_one_run(tmp_path):
    """With everything that a map of I, Q and U consists of."""
    camera = zonda.Instrument(
        name="pairs",
        telescope=zonda.Telescope(name="dish", diameter="6 m"),
        detectors=24,
        field_of_view="6 arcmin",
        band=zonda.Band(name="b", low="130 GHz", high="170 GHz"),
        fwhm="1.4 arcmin",
        polarization="pairs",
        net="1 mK s(1/2)",
        main_beam_efficiency=0.7,
        illumination_efficiency=0.9,
        sample_rate="20 Hz",
    )
    scene = zonda.Scene(
        site="green_bank", instrument=camera, time="2024-11-25T07:00", target="05h +20d", seed=3
    )
    found = []
    for how in ({}, {"engine": "processes", "workers": 2}):
        steps = [
            zonda.PointingDaisy(
                radius="5 arcmin",
                speed="60 arcsec/s",
                scan_duration="20 s",
                scans=3,
                offsets="none",
            ),
            zonda.HalfWavePlate(frequency="1 Hz"),
            zonda.WhiteNoise(),
            zonda.Efficiency(),
            zonda.BinMap(pixel="60 arcsec", stokes="IQU", crosslinking=True, scan_hits=True),
            zonda.SaveMap(),
        ]
        folder = tmp_path / how.get("engine", "one")
        if how:
            zonda.campaign(zonda.Pipeline(steps), scene, output=folder, **how)
        else:
            zonda.Pipeline(steps).run(scene, output=folder)
        with fits.open(next(folder.rglob("map.fits"))) as file:
            found.append({hdu.name: np.array(hdu.data) for hdu in file if hdu.is_image})
            found[-1]["SCAN_HITS"] = np.array(file["SCAN_HITS"].data)
    assert {"I", "Q", "U", "COV_QU", "HALF_DIFFERENCE_U", "CROSSLINKING"} <= found[0].keys()
    assert set(found[0]["SCAN_HITS"]["SCAN"]) == {0, 1, 2}
    assert np.isfinite(found[0]["Q"]).sum() > 20
    for name, values in found[0].items():
        np.testing.assert_array_equal(values, found[1][name], err_msg=name)
