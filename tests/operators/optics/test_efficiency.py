"""T_scan term by term, the smooth mean, the limits of opacity."""

from __future__ import annotations

import numpy as np
import pytest

import zonda
from zonda.core.numerics.radiation import LEAST_TRANSMISSION
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.optics.efficiency import Efficiency
from zonda.operators.optics.field_ratio import _spline, field_ratio

from ...scenes import camera

N_DET, N = 19, 5000


@pytest.fixture
def streams():
    rng = np.random.default_rng(1)
    return {
        "sky": 1e-3 * rng.standard_normal((N_DET, N)),
        "atmosphere": 0.1 * rng.standard_normal((N_DET, N)),
        "transmission": 1e-3 * rng.standard_normal((N_DET, N)),
        "white": 1e-2 * rng.standard_normal((N_DET, N)),
        "pink": 1e-2 * rng.standard_normal((N_DET, N)),
    }


def fields(n=N, step=64):
    """Emission near 30 K, transmission near 0.8, both varying over time and detectors, as exact
    values too.
    """
    margin = 16
    k = (np.arange(-(-n // step) + 3 + 2 * margin) - 1 - margin) * step / n
    nodes = np.linspace(-1, 1, N_DET)
    weights = np.stack([1 + 0 * nodes, nodes], axis=1)
    emission = np.stack([30 + 2 * k + 0.5 * k**2, 0.1 + 0.02 * k])
    transmission = np.stack([0.8 - 0.05 * k, -0.003 + 0 * k])
    return {
        "atmosphere": SmoothField.from_values(weights, emission, step, n),
        "transmission": SmoothField.from_values(weights, transmission, step, n),
    }


def everywhere(field, n=N):
    return field.evaluate(slice(0, N_DET), slice(0, n))


@pytest.mark.parametrize("calibration", ["mean", "instantaneous"])
@pytest.mark.parametrize("absent", [None, "sky", "atmosphere", "transmission", "white", "pink"])
def test_the_papers_equation_term_by_term(bench, streams, calibration, absent):
    streams.pop(absent, None)
    smooth = fields()
    run = bench.run(
        [Efficiency(main_beam=0.35, illumination=0.7, calibration=calibration)],
        bench.observation(N_DET, N),
        streams,
        smooth=smooth,
        precision="float64",
    )
    zero = np.zeros((N_DET, N))
    get = lambda name: streams.get(name, zero)  # noqa: E731
    t = everywhere(smooth["transmission"])
    instant = t * (1 + get("transmission"))
    total = (
        0.7 * (everywhere(smooth["atmosphere"]) + get("atmosphere"))
        + 0.35 * instant * get("sky")
        + get("white")
        + get("pink")
    )
    expected = total / (0.35 * (t if calibration == "mean" else instant))
    # the refitted mean is allowed 1e-7 of its 90 K
    assert np.abs(run.signal - expected).max() < 1e-7 * np.abs(expected).max()


def test_float32_stream_keeps_microkelvin_under_the_mean(bench, streams):
    smooth = fields()
    run64, run32 = (
        bench.run([Efficiency()], bench.observation(N_DET, N), streams, smooth=smooth, precision=p)
        for p in ("float64", "float32")
    )
    # fluctuations of 0.4 K / float32: 0.4 * 2^-24 per operation, some six operations
    assert np.abs(run64.signal - run32.signal).max() < 0.4 * 6 * 2.0**-24 * 3


def test_without_atmosphere_the_sky_comes_through_and_noise_is_divided_by_zeta(bench, streams):
    sky, white = streams["sky"], streams["white"]
    run = bench.run(
        [Efficiency()],
        bench.observation(N_DET, N),
        {"sky": sky, "white": white},
        precision="float64",
    )
    np.testing.assert_allclose(run.signal, sky + white / 0.3, rtol=0, atol=1e-14)


def test_efficiencies_reach_the_focal_plane(bench, streams):
    run = bench.run(
        [Efficiency(main_beam="40 %", illumination=0.9)], bench.observation(N_DET, N), streams
    )
    plane = run.observations[0].focalplane
    assert (plane.main_beam_efficiency == 0.4).all()
    assert (plane.illumination_efficiency == 0.9).all()


def test_scatter_changes_noise_and_not_the_sky(bench, streams):
    operator = Efficiency(scatter=0.1)
    sky = {"sky": streams["sky"]}
    run = bench.run([operator], bench.observation(N_DET, N), sky, precision="float64")
    zeta = run.observations[0].focalplane.main_beam_efficiency
    np.testing.assert_allclose(run.signal, sky["sky"], rtol=0, atol=1e-15)
    # rms of 19 normals around 10 %: standard error 0.1 / sqrt(38) = 0.016, four of them
    assert abs((zeta / 0.3 - 1).std() - 0.1) < 0.065
    again = bench.observation(N_DET, N)
    operator.configure(again)
    operator.configure(again)
    np.testing.assert_array_equal(again.focalplane.main_beam_efficiency, zeta)


@pytest.mark.parametrize("reference", ["sky", "detector"])
def test_scatter_changes_noise_at_the_detector_alone(tmp_path, reference):
    """A NET on the sky is that of the calibrated stream whatever zeta is; one at the detector is
    divided by it. 20000 samples show a detector's rms to 0.5 %, of which 5 sigma are allowed; zeta
    scatters by 20 %."""
    (tmp_path / "a.yaml").write_text(
        camera(8)
        + f"""operators:
  - PointingStare: {{scan_duration: 400 s}}
  - WhiteNoise: {{net: 1 mK s(1/2), reference: {reference}}}
  - Efficiency: {{scatter: 20 %}}
"""
    )
    file = zonda.load(tmp_path / "a.yaml")
    (o,) = file.pipeline().run(file.scene(), threads=1, keep=["signal"]).observations
    zeta = o.focalplane.main_beam_efficiency
    assert zeta.std() > 0.1 * zeta.mean()
    found = np.asarray(o.detdata["signal"], np.float64).std(axis=1) / (1e-3 * np.sqrt(50.0))
    np.testing.assert_allclose(found if reference == "sky" else found * zeta, 1.0, rtol=5 * 0.005)


def test_calibration_error_scales_each_detector(bench, streams):
    run = bench.run(
        [Efficiency(calibration_error=0.05)],
        bench.observation(N_DET, N),
        {"sky": streams["sky"]},
        precision="float64",
    )
    gain = run.signal[:, 0] / streams["sky"][:, 0]
    np.testing.assert_allclose(run.signal, gain[:, None] * streams["sky"], rtol=1e-12)
    assert 0.02 < gain.std() < 0.085  # 0.05 +- 4 standard errors of 0.05 / sqrt(38)
    assert (gain != 1).all()


def test_opaque_detector_is_flagged_and_finite(bench, streams):
    smooth = fields()
    weights = smooth["transmission"].weights.copy()
    weights[3] = 0.0
    smooth["transmission"] = SmoothField(weights, smooth["transmission"].coefficients, 64, N)
    run = bench.run([Efficiency()], bench.observation(N_DET, N), streams, smooth=smooth)
    assert np.flatnonzero(run.observations[0].detector_flags).tolist() == [3]
    assert (
        run.log["Efficiency", f"detectors flagged: band transmission below {LEAST_TRANSMISSION:g}"]
        == "1"
    )
    assert np.isfinite(run.signal).all()
    clear = bench.run([Efficiency()], bench.observation(N_DET, N), streams, smooth=fields())
    others = np.arange(N_DET) != 3
    assert np.abs(run.signal - clear.signal)[others].max() < 2e-5


def test_opaque_stretch_flags_samples(bench, streams):
    smooth = fields()
    k = np.arange(smooth["transmission"].coefficients.shape[1] + 32) - 17
    values = np.stack([np.where(k > 60, 0.0, 0.8) + 0 * k, 0.0 * k])
    smooth["transmission"] = SmoothField.from_values(smooth["transmission"].weights, values, 64, N)
    run = bench.run([Efficiency()], bench.observation(N_DET, N), streams, smooth=smooth)
    flags = run.observations[0].flags
    assert flags[62 * 64 : N].all()
    assert not flags[: 55 * 64].any()
    assert not run.observations[0].detector_flags.any()
    assert np.isfinite(run.signal).all()


@pytest.mark.parametrize("steps", [(64, 64), (128, 32), (32, 128)])
def test_ratio_of_smooth_fields(steps):
    above, below = fields(step=steps[0])["atmosphere"], fields(step=steps[1])["transmission"]
    ratio, error = field_ratio(above, below, np.arange(N_DET))
    exact = everywhere(above) / everywhere(below)
    assert error < 1e-7 * exact.max()
    assert np.abs(everywhere(ratio) - exact).max() < 1e-7 * exact.max()


@pytest.mark.parametrize("n", [1, 2, 63, 64, 65])
def test_ratio_of_short_scans(n):
    above, below = fields(n)["atmosphere"], fields(n)["transmission"]
    ratio, _ = field_ratio(above, below, np.arange(N_DET))
    exact = everywhere(above, n) / everywhere(below, n)
    assert np.abs(everywhere(ratio, n) - exact).max() < 1e-6 * exact.max()


def test_bits_do_not_depend_on_blocks(bench, streams):
    smooth = fields()
    runs = [
        bench.run(
            [Efficiency()], bench.observation(N_DET, N), streams, smooth=smooth, threads=t, memory=m
        )
        for t, m in ((1, 1 << 30), (2, 1 << 23))
    ]
    np.testing.assert_array_equal(runs[0].signal, runs[1].signal)


@pytest.mark.parametrize(
    "bad",
    [
        {"main_beam": 0},
        {"illumination": 1.2},
        {"scatter": -0.1},
        {"calibration": "never"},
        {"zeta": 0.3},
    ],
)
def test_bad_parameters(bad):
    with pytest.raises(ValueError):
        Efficiency(**bad)


def test_an_instantaneous_calibration_that_cannot_divide_is_counted(bench, streams):
    streams["transmission"][3, 100:130] = -1.0
    streams["transmission"][5, 7] = np.nan
    run = bench.run(
        [Efficiency(calibration="instantaneous")],
        bench.observation(N_DET, N),
        streams,
        smooth=fields(),
    )
    assert run.log["Efficiency", "samples whose fluctuating e^-tau was raised to 1e-06"] == "31"
    mean = bench.run([Efficiency()], bench.observation(N_DET, N), streams, smooth=fields())
    assert ("Efficiency", "samples whose fluctuating e^-tau was raised to 1e-06") not in mean.log


@pytest.mark.parametrize("cells", [1, 2, 3, 50])
def test_spline_has_the_values_and_the_slopes_at_the_ends(cells):
    known = np.random.default_rng(cells).normal(size=(2, cells + 3))
    c = _spline(known)
    np.testing.assert_allclose(
        (c[:, :-2] + 4 * c[:, 1:-1] + c[:, 2:]) / 6, known[:, 1:-1], rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(
        (c[:, [2, -1]] - c[:, [0, -3]]) / 2, known[:, [0, -1]], rtol=0, atol=1e-14
    )
