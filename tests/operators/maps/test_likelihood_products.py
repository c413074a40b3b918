"""Products of maximum-likelihood maps: the source as a template, chi^2, noise model."""

import re
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import zonda
import zonda.pipelines
from zonda.core import cli
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.maps.noise_figures import matched
from zonda.operators.maps.grid import Looking
from zonda.plugins.checks.scenes import run, scan, scene

CLUSTER = Path(zonda.pipelines.__path__[0]) / "data" / "merging_cluster.fits"
SCENE = {
    "site": "green_bank",
    "instrument": {
        "name": "camera",
        "telescope": {"name": "GBT", "diameter": "100 m"},
        "band": {"name": "m2", "low": "75 GHz", "high": "105 GHz"},
        "net": "100 uK s(1/2)",
        "detectors": 40,
        "field_of_view": "4 arcmin",
        "main_beam_efficiency": 0.8,
        "illumination_efficiency": 0.9,
        "sample_rate": "50 Hz",
    },
    "time": "2024-02-01T05:00",
    "target": "75 deg 20 deg",
    "seed": 5,
}
RUNS = {
    "model": {"only": ["sky"]},
    "true": {"only": ["sky"], "filters": "none"},
    "free": {"without": ["sky"]},
}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A cluster in white noise."""
    steps = [
        zonda.PointingDaisy(radius="3 arcmin", speed="50 arcsec/s", scan_duration="60 s"),
        zonda.SkyMap(file=CLUSTER, centre="target"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.MaximumLikelihoodMap(
            pixel="4 arcsec", half_difference=False, modes=0, free=0, tolerance=1e-6
        ),
        zonda.BinMap(pixel="4 arcsec", product="binned"),
        zonda.SaveMap(),
        zonda.Plots(),
        zonda.Report(),
    ]
    folder = tmp_path_factory.mktemp("run")
    return zonda.Pipeline(steps, runs=RUNS).run(zonda.Scene(**SCENE), threads=1, output=folder)


SIGMA = 1e-3
"""White noise of a sample, K."""


@pytest.fixture(scope="module")
def scanned():
    """Three turns of 4 arcmin with white noise, and a Gaussian of 15 arcsec on the way, at rest and
    moving by 30 arcsec half way."""
    o = scan(37, 6000, radius=3.0)
    o.focalplane.net[:] = SIGMA / np.sqrt(o.sample_rate)
    maker = zonda.BinMap(pixel="3 arcsec")
    maker.observe(Data(scene(o.instrument), [o]))
    pixel = Looking.of(o, maker.grid).pixels(np.arange(37), 0, o.n_samples)
    y, x = np.divmod(pixel, maker.grid.shape[1])
    here = 3 * (x - x[0, 1500]), 3 * (y - y[0, 1500])
    rest, moved = (np.exp(-((here[0] - s) ** 2 + here[1] ** 2) / 450) for s in (0, 30))
    noise = SIGMA * np.random.default_rng(2).normal(size=pixel.shape)
    return o, noise, rest, np.where(np.arange(o.n_samples) < 3000, rest, moved)


def chi2(o, signal, **how):
    maker = zonda.MaximumLikelihoodMap(**{"pixel": "15 arcsec", "half_difference": False, **how})
    return run([maker], o, signal).products["map"].chi2


@pytest.mark.parametrize("how", [{}, {"modes": 0, "free": 0}, {"modes": 5, "free": 2}])
def test_chi_square_of_noise_from_the_model(scanned, how):
    """sqrt(2 / n): of 37 detectors' 6000 samples, less what modes and pixels take, 0.3 %. White levels
    are medians of the same samples: the ratio to their mean scatters by sqrt(pi / 2 - 1) of that, and
    slow baselines, 1 in 20, are at least as noisy as white noise: 0.3 %."""
    o, noise, *_ = scanned
    value, error = chi2(o, noise, **how)
    free = how.get("free", 1)
    taken = free * o.n_samples + 2 * (37 - free)
    assert error == pytest.approx(np.sqrt(2 / (37 * o.n_samples - taken)), rel=0.01)
    assert value == pytest.approx(1, abs=3 * error + 0.003)


def test_chi_square_of_wrong_models(scanned):
    """Sources of 30 times the noise of a sample, in 1 % of the samples: within pixels as wide as
    the source and where it moves there is more than noise. What a walk that all detectors share adds
    to baselines is not that of independent ones."""
    o, noise, rest, moved = scanned
    walk = 2 * SIGMA * np.cumsum(np.random.default_rng(3).normal(size=o.n_samples))
    for signal, how in (
        (30 * SIGMA * rest, {"pixel": "40 arcsec"}),
        (30 * SIGMA * moved, {"pixel": "6 arcsec"}),
        (walk, {"modes": 0, "free": 0}),
    ):
        value, error = chi2(o, signal + noise, **how)
        assert value > 1 + 10 * error, how


def test_the_noise_model_is_a_product(found):
    record = found["noise_model"]
    (model,) = record.models
    assert record.scans == [o.name for o in found.observations]
    # white noise: that of the detectors, and baselines like it
    net = found.observations[0].focalplane.net
    assert np.sqrt(model.white.mean()) == pytest.approx(net.mean() * np.sqrt(50), rel=0.03)
    # 40 detectors' powers in bins of 10 frequencies or more scatter by 5 %; below 1 they are 1
    many = np.diff(model.edges) >= 10
    assert (model.own[many] < 1.2).all()
    assert record.chi2 == found["map"].chi2
    assert record.history[-1] < 1e-6 <= record.history[-2]
    assert 0 < record.ritz[0] < record.ritz[-1] < 1.001


def test_the_noise_model_has_files_and_pictures(found):
    record, folder = found["noise_model"], found.output
    table = Table.read(folder / "noise_model.ecsv")
    np.testing.assert_allclose(table["own"], record.models[0].own, rtol=1e-8)
    assert table["frequency"].unit == "Hz"
    steps = Table.read(folder / "noise_model_convergence.ecsv")
    np.testing.assert_allclose(steps["residual"], record.history, rtol=1e-8)
    assert Table.read(folder / "noise_model_modes.ecsv").colnames == ["scan", "white", "free"]
    assert len(Table.read(folder / "noise_model_ritz.ecsv")) == len(record.ritz)
    report = (folder / "report.html").read_text()
    for title in ("Noise model", "Convergence of the map"):
        assert f"<b>{title}.</b>" in report
    assert (folder / "noise_model.png").exists()
    assert (folder / "noise_model_convergence.png").exists()
    for text in ("chi^2 per sample", "taken off the map of I", "its weighted plane"):
        assert text in report


def test_a_template_in_white_noise(found):
    """A is at most the matrix of white noise, sum (t / n)^2; a line of each detector, and slow
    baselines that are found up to 15 % noisier than they are (bins of 40 detectors, at least as
    noisy as white noise), take some of it."""
    t, m, free = (found[f"{name}map"] for name in ("model/", "", "free/"))
    one, error = matched(t, t)
    assert one == pytest.approx(1, abs=1e-12)
    white = np.sqrt(np.nansum((t.signal / t.noise) ** 2))
    assert 0.8 * white < 1 / error < white
    noise = matched(t, free)
    assert abs(noise[0]) < 4 * error
    # the map is linear in its data, solved to 1e-6 of a right side of 200 sigma
    assert matched(t, m)[0] == pytest.approx(1 + noise[0], abs=0.01 * error)
    # a mean of samples tells the same template but for structure within pixels
    assert matched(found["true/map"], m)[1] == pytest.approx(error, rel=0.02)


def test_what_is_taken_off_has_no_weight(found):
    """A' P = 0: a mean and a plane added to the map change no amplitude, to the rounding of A."""
    t, m = found["model/map"], found["map"]
    amplitude, error = matched(t, m)
    y, x = np.indices(m.hits.shape)
    for pattern in (np.ones(m.hits.shape), y - y.mean(), x - x.mean()):
        changed = m.with_planes(signal=m.signal + 1e-3 * pattern)  # 10 times the noise or more
        assert matched(t, changed)[0] == pytest.approx(amplitude, abs=1e-6 * error)


@pytest.mark.nightly
def test_deviates_of_noise_have_their_variance():
    """Amplitudes of a cluster in maps of white noise, of which a plane is taken off: with A instead
    of A' they would scatter by more, since the plane is well determined."""
    steps = [
        zonda.PointingDaisy(radius="3 arcmin", speed="50 arcsec/s", scan_duration="60 s"),
        zonda.SkyMap(file=CLUSTER, centre="target"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.MaximumLikelihoodMap(pixel="8 arcsec", half_difference=False, modes=0, free=0),
    ]
    deviates = []
    for seed in range(60):
        data = zonda.Pipeline(steps, runs=RUNS).run(zonda.Scene(**{**SCENE, "seed": seed}))
        amplitude, error = matched(data["model/map"], data["free/map"])
        deviates.append(amplitude / error)
    # 60 deviates: their rms to 1 / sqrt(120), and baselines that are found a little too noisy
    assert np.sqrt(np.mean(np.square(deviates))) == pytest.approx(1, abs=3 / np.sqrt(120))


def test_the_figure(found):
    t, m = found["model/map"], found["map"]
    amplitude, error = matched(t, m)
    assert zonda.measure(found, "template_snr").value == pytest.approx(1 / error, rel=1e-12)
    figure = zonda.measure(found, "template_snr", of="amplitude", signal="model")
    assert (figure.value, figure.error) == (amplitude, error)
    with pytest.raises(InputError, match="maximum-likelihood map"):
        zonda.measure(found, "template_snr", map="binned")
    for other in (found["binned"], m.smooth("9 arcsec")):  # of the same samples
        np.testing.assert_array_equal(other.hits, t.hits)
        with pytest.raises(InputError, match="another noise model"):
            matched(t, other)


def test_files_hold_it(found):
    band = found["map"].band
    t, m = (
        zonda.read_map(found.output / f"{name}.fits", band=band) for name in ("model_map", "map")
    )
    assert matched(t, m) == pytest.approx(matched(found["model/map"], found["map"]), rel=1e-12)
    assert "template" not in m.planes
    assert m.chi2 == found["map"].chi2
    assert t.chi2 == (0.0, 0.0)
    assert m.chi2[0] == pytest.approx(1, abs=0.03)  # small pixels, and a source in white noise
    assert matched(t.to("mJy/beam"), m.to("mJy/beam")) == pytest.approx(matched(t, m), rel=1e-9)


def test_zonda_compare_prints_it(found, tmp_path, capsys):
    files = [found.output / f"{name}.fits" for name in ("model_map", "map", "binned")]
    rows = "S/N of the reference as a template", "its amplitude in the map"
    amplitude, error = matched(found["model/map"], found["map"])
    assert cli.main(["compare", *map(str, files[:2]), "--output", str(tmp_path)]) == 0
    table = dict(re.findall(r"^(\S.*?)  +(\S.*)$", capsys.readouterr().out, re.MULTILINE))
    assert table[rows[0]] == f"{1 / error:.4g}"
    assert table[rows[1]] == f"{amplitude:.4g} +- {error:.2g}"
    assert cli.main(["compare", *map(str, files[:0:-1]), "--output", str(tmp_path)]) == 0
    assert not any(row in capsys.readouterr().out for row in rows)


def test_what_is_no_template_is_refused(found):
    t, m = found["model/map"], found["map"]
    for wrong, other, cause in (
        (t.smooth("9 arcsec"), m, "no weights"),
        (m, m, "no weights"),
        (t, m.to("mK_CMB"), "or unit"),
        (t, m.with_planes(hits=m.hits + 1), "other samples"),
        (t.with_planes(signal=0 * t.signal), m, "empty"),
    ):
        with pytest.raises(InputError, match=cause):
            matched(wrong, other)


def test_polarized_templates_have_all_three(found, tmp_path):
    t = found["model/map"]
    three = np.stack([t.signal, 2 * t.signal, 3 * t.signal])
    weights = np.stack([k * t.planes["template"].values[0] for k in (1, 2, 3)])
    nothing = np.ones((6, *t.hits.shape))
    made = t.with_planes(
        signal=three,
        weights=np.stack([t.weights] * 3),
        noise=np.stack([t.noise] * 3),
        covariance=nothing,
        condition=nothing[:1],
        template=weights,
    )
    made.write(tmp_path / "iqu.fits")
    again = zonda.read_map(tmp_path / "iqu.fits")
    # S/N^2 of (1, 2, 3) t with weights (1, 2, 3) A t: 1 + 4 + 9 times that of t
    assert matched(again, again)[1] == pytest.approx(matched(t, t)[1] / np.sqrt(14), rel=1e-12)
    for one in (again.stokes("I"), again.smooth("9 arcsec")):
        assert "template" not in one.planes
