"""The filters of the paper's authors' code: against scipy and numpy, directly; causal; linear;
whatever the blocks.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal as scipy_signal
from scipy.interpolate import make_lsq_spline

import zonda.testing
from zonda.core.errors import PipelineError
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.filters.baseline import Fit, polynomials, splines
from zonda.operators.filters.common_mode import CommonModeFilter
from zonda.operators.filters.highpass import Bridged, HighpassFilter, amplitude, causal
from zonda.operators.filters.polynomial import Despline, Detrend
from zonda.operators.filters.rows import Rows
from zonda.operators.filters.taper import Taper

RATE, CUT = 100.0, 0.08
NONE = np.zeros(0, np.intp)


def drifting(n_det, n, seed=0):
    """White noise, a common drift of unequal gain, and a line of each detector."""
    rng = np.random.default_rng(seed)
    drift = np.cumsum(rng.standard_normal(n)) * 0.01
    gain, slope = rng.uniform(0.5, 2.0, (2, n_det))
    noise = rng.uniform(0.5, 2.0, n_det)[:, None] * rng.standard_normal((n_det, n)) * 0.017
    return np.outer(gain, drift) + np.outer(slope, np.linspace(0, 5, n)) + noise + 30.0


def unit_rms_mode_removed(x):
    """The first singular mode of streams of unit rms, directly."""
    rms = x.std(axis=1, keepdims=True)
    u, s, v = np.linalg.svd(x / rms, full_matrices=False)
    return x - rms * np.outer(u[:, 0] * s[0], v[0])


def test_the_chain_equals_scipy_and_numpy(bench):
    """Line, Tukey's window, Bessel filter from the state zero, first mode of unit rms, as the
    authors' mapper does it.
    """
    n = 6000
    x = drifting(9, n)
    expected = scipy_signal.detrend(x, axis=-1) * scipy_signal.windows.tukey(n, 0.1)
    sos = scipy_signal.bessel(4, 2 * CUT / RATE, btype="high", output="sos")
    expected = unit_rms_mode_removed(scipy_signal.sosfilt(sos, expected, axis=-1))
    steps = [
        Detrend(),
        Taper(),
        HighpassFilter(response="bessel", degree=None),
        CommonModeFilter(scale="rms", residual=1e-10),
    ]
    found = bench.run(steps, bench.observation(9, n), {"signal": x}, precision="float64").signal
    assert np.linalg.norm(found - expected) < 1e-8 * np.linalg.norm(expected)


def test_unit_rms_modes_of_other_signals_are_those_of_the_complete_one(bench):
    """What is removed is linear given the modes: (4) of A = B + C is that of B plus that of C (the
    kit tests it in the executor); and streams of equal rms have the modes that they have without a
    scale."""
    x = drifting(9, 4000)
    x -= x.mean(axis=1, keepdims=True)
    x /= x.std(axis=1, keepdims=True)
    plain, scaled = (
        bench.run(
            [CommonModeFilter(scale=s, residual=1e-10)],
            bench.observation(9, 4000),
            {"signal": x},
            precision="float64",
        )
        for s in ("none", "rms")
    )
    np.testing.assert_allclose(scaled.signal, plain.signal, rtol=0, atol=1e-9)
    assert (
        "of the detectors' rms"
        in scaled.log["CommonModeFilter", "scan0: singular values / sqrt(detectors x samples)"]
    )


def test_the_amplitude_of_waves():
    """Of a wave there is left |H|, which falls with the fourth power far below the cut; unity far
    above.
    """
    t = np.arange(60000) / RATE
    for f in (0.02, 0.08, 0.4):
        wave = np.sin(2 * np.pi * f * t)[None]
        Bridged(causal(CUT, RATE), NONE).remove(Rows.of(wave))
        last = wave[
            0, -20000:
        ]  # whole waves at these frequencies; the transient has decayed by e^-100 and more
        assert np.sqrt(2 * np.mean(last**2)) == pytest.approx(amplitude(f, CUT, RATE), rel=1e-3)
    assert amplitude(2e-4, CUT, RATE) / amplitude(1e-4, CUT, RATE) == pytest.approx(16, rel=1e-3)
    assert amplitude(20.0, CUT, RATE) == pytest.approx(1, abs=1e-3)


def test_it_is_causal():
    """Nothing before a source, a trough behind it."""
    source = np.exp(-0.5 * ((np.arange(20000) - 10000) / 8.0) ** 2)[None]
    before = source.copy()
    Bridged(causal(CUT, RATE), NONE).remove(Rows.of(source))
    assert np.abs(source[0, :9900]).max() < 1e-15
    assert source[0, 10050:10200].max() < 0
    assert source.max() > 0.8 * before.max()


@settings(max_examples=25, deadline=None)
@given(n=st.integers(1, 3000), degree=st.sampled_from([None, 0, 1, 3]), seed=st.integers(0, 99))
def test_bessel_is_linear_and_acts_on_each_detector_alone(n, degree, seed):
    rows = np.random.default_rng(seed).standard_normal((3, n))
    fit = None if degree is None else Fit.of(polynomials(n, degree), np.ones(n, bool))
    plan = Bridged(causal(0.5, RATE), NONE, fit)
    whole, part = rows.copy(), rows[1:2].copy()
    plan.remove(Rows.of(whole))
    plan.remove(Rows.of(part))
    np.testing.assert_array_equal(whole[1], part[0])
    mixed = (2 * rows[0] - 3 * rows[1])[None]
    plan.remove(Rows.of(mixed))
    np.testing.assert_allclose(mixed[0], 2 * whole[0] - 3 * whole[1], rtol=0, atol=1e-10)


@pytest.mark.parametrize("steps", [[Detrend()], [HighpassFilter(response="bessel")]])
def test_the_mean_beside_the_stream_is_part_of_it(bench, steps):
    x = np.random.default_rng(4).normal(0, 0.017, (5, 6000))
    level = np.linspace(60, 70, 5)
    beside = bench.run(
        steps,
        bench.observation(5, 6000),
        {"signal": x},
        means={"signal": SmoothField.constant(level, 6000)},
        precision="float64",
    )
    inside = bench.run(
        steps, bench.observation(5, 6000), {"signal": x + level[:, None]}, precision="float64"
    )
    np.testing.assert_allclose(beside.signal, inside.signal, rtol=0, atol=1e-10)
    assert np.abs(beside.signal).max() < 0.2


def test_without_a_trend_removed_first_there_is_a_transient(bench):
    """From the state zero a step of 1 K rings for about 1 / f; with the trend removed it does
    not.
    """
    x = np.ones((1, 6000))
    plain, level = (
        bench.run(
            [HighpassFilter(response="bessel", degree=d)], bench.observation(1, 6000), {"signal": x}
        ).signal[0]
        for d in (None, 0)
    )
    assert plain[0] > 0.9
    assert np.abs(plain[3 * 1250 :]).max() < 0.01  # three periods of 0.08 Hz
    assert np.abs(level).max() < 1e-6


def test_flagged_samples_do_not_ring(bench):
    x = np.random.default_rng(5).normal(0, 0.017, (2, 9000))
    clean = bench.run(
        [HighpassFilter(response="bessel")],
        bench.observation(2, 9000),
        {"signal": x},
        precision="float64",
    ).signal
    observation = bench.observation(2, 9000)
    observation.flags[4000:4050] = 1
    x[:, 4000:4050] = 1e6
    x[1, 100] = np.nan
    run = bench.run(
        [HighpassFilter(response="bessel")], observation, {"signal": x}, precision="float64"
    )
    fine = np.r_[0:100, 101:4000, 4050:9000]
    assert (
        np.abs(run.signal - clean)[:, fine].max() < 0.5 * 0.017
    )  # 50 samples of white noise became a line
    assert np.isnan(run.signal[1, 100])
    assert run.log["HighpassFilter", "samples not finite"] == "1"


def test_what_cannot_be_is_refused(bench):
    with pytest.raises(PipelineError, match="removes everything"):
        bench.run(
            [HighpassFilter(frequency="50 Hz", response="bessel")],
            bench.observation(1, 100),
            {"signal": np.zeros((1, 100))},
        )
    with pytest.raises(PipelineError, match="more than 2000 in a scan of 30 s"):
        bench.run(
            [Despline(knots="10 ms")], bench.observation(1, 3000), {"signal": np.zeros((1, 3000))}
        )
    with pytest.raises(ValueError, match="belongs to response: bessel"):
        HighpassFilter(degree=None)
    with pytest.raises(ValueError, match="scale: rms belongs to method: svd"):
        CommonModeFilter(method="mean", scale="rms")


@pytest.mark.parametrize("order", [0, 1, 4])
def test_detrend_equals_least_squares_on_good_samples(bench, order):
    n = 3000
    x, observation = drifting(4, n), bench.observation(4, n)
    observation.flags[1000:1400] = 1
    x[:, 1000:1400] = 1e3
    x[2, 50] = np.nan
    found = bench.run(
        [Detrend(order=order)], observation, {"signal": x}, precision="float64"
    ).signal
    t = np.arange(n)
    for row, was in zip(found, x, strict=True):
        use = np.isfinite(was) & ((t < 1000) | (t >= 1400))
        fit = np.polynomial.Polynomial.fit(t[use], was[use], order)
        np.testing.assert_allclose(
            row[np.isfinite(was)], (was - fit(t))[np.isfinite(was)], rtol=0, atol=1e-9
        )
    assert np.isnan(found[2, 50])


@pytest.mark.parametrize(("n", "knots"), [(51600, 60.0), (9001, 20.0), (700, 60.0)])
def test_despline_equals_a_least_squares_spline(bench, n, knots):
    """The splines with these knots are the same space, however its basis goes on beyond the ends.
    On 7 s of a 60 s interval they are nearly alike: the normal equations lose all but some four
    digits."""
    x = np.cumsum(np.random.default_rng(1).standard_normal((2, n)), axis=1)
    found = bench.run(
        [Despline(knots=f"{knots} s")], bench.observation(2, n), {"signal": x}, precision="float64"
    ).signal
    t = np.arange(n) / RATE
    inner = np.arange(t[0], t[-1], knots)
    inner += t.mean() - inner.mean()
    fit = make_lsq_spline(t, x.T, np.r_[[t[0]] * 4, inner, [t[-1]] * 4], k=3)
    np.testing.assert_allclose(
        found, x - fit(t).T, rtol=0, atol=(1e-3 if n == 700 else 1e-6) * np.abs(x).max()
    )


def test_a_gap_longer_than_the_knots_is_no_trouble():
    """Splines that no sample determines get nothing; what is left of a cubic is rounding."""
    n = 6000
    use = np.ones(n, bool)
    use[2000:4500] = False
    t = np.linspace(-1, 1, n)
    rows = (1 + t - 2 * t**3)[None].copy()
    Fit.of(splines(n, 300), use).remove(Rows.of(rows))
    assert np.isfinite(rows).all()
    assert np.abs(rows[0, use]).max() < 1e-6


@pytest.mark.parametrize(
    "operator",
    [
        Detrend(),
        Detrend(order=4, mask={"radius": "1 arcmin"}),
        Despline(knots="20 s"),
        Taper(),
        HighpassFilter(frequency="0.1 Hz", response="bessel"),
        HighpassFilter(frequency="0.1 Hz", response="bessel", degree=None),
        CommonModeFilter(scale="rms", modes=2),
    ],
    ids=repr,
)
def test_they_keep_the_contract(operator):
    zonda.testing.check_operator(operator)
