"""The brick wall against the full DCT; zero phase; drifts; gaps; short scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.fft import dct, idct

from zonda.core.data import Data
from zonda.core.errors import PipelineError
from zonda.core.flags import SUN_CLOSE, SUN_UP, TRIMMED, TURNAROUND
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.filters.brick_wall import plan_highpass
from zonda.operators.filters.highpass import ONLY_A_LINE, HighpassFilter

RATE, CUT = 100.0, 0.08
WHITE = 1.7e-3 * np.sqrt(RATE)


def brick_wall(x, cut, degree):
    """Polynomial and DCT, directly, float64."""
    n = x.shape[-1]
    basis = np.linalg.qr(np.polynomial.legendre.legvander((2 * np.arange(n) + 1) / n - 1, degree))[
        0
    ]
    spectrum = dct(x - (x @ basis) @ basis.T, type=2)
    spectrum[..., :cut] = 0
    return idct(spectrum, type=2)


def filtered(x, frequency=CUT / RATE, degree=3, oversampling=24.0):
    plan = plan_highpass(len(x), frequency, degree, oversampling)
    y = np.array(x)
    plan.apply(y[None])
    return y


@pytest.mark.parametrize("n", [51600, 20011, 6007])
def test_equals_the_full_brick_wall(n):
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.normal(0, 3e-3, n)) + rng.normal(0, WHITE, n)
    plan = plan_highpass(n, CUT / RATE, 3, 24.0)
    assert plan.knots > 0
    expected = brick_wall(x, plan.cut, 3)
    assert np.std(filtered(x) - expected) < 1e-6 * x.std()
    # float32: the row itself is rounded, 2^-24 of 1 K peak to peak
    assert (
        np.std(filtered(x.astype(np.float32)) - expected) < 1e-6 * x.std() + 6e-8 * np.abs(x).max()
    )


@pytest.mark.parametrize(
    ("n", "frequency", "taps"),
    [(20011, 0.08 / 100, 5), (20011, 0.5 / 225, 5), (6007, 0.5 / 110, 6)],
)
def test_rows_side_by_side_and_close_knots(n, frequency, taps):
    """35 rows: two tiles and a rest; knots 104, 18.7 and 9.1 samples apart; alone or beside others
    a row has the same bits.
    """
    x = np.cumsum(np.random.default_rng(3).normal(0, 1.0, (35, n)), axis=1)
    plan = plan_highpass(n, frequency, 3, 24.0)
    assert plan.taps == taps
    expected = brick_wall(x, plan.cut, 3)
    for kind, rounding in ((np.float64, 0.0), (np.float32, 6e-8 * np.abs(x).max())):
        together = x.astype(kind)
        plan.apply(together)
        assert np.std(together - expected) < 2e-6 * x.std() + rounding
        alone = x[20:21].astype(kind)
        plan.apply(alone)
        np.testing.assert_array_equal(alone[0], together[20])


@pytest.mark.parametrize(
    ("n", "cycles", "degree", "oversampling", "knots"),
    [
        (20011, 41.5, 3, 24.0, 1000),
        (20011, 12.5, 2, 25.0, 315),
        (20011, 5.0, 1, 35.0, 175),
        (5000, 2.0, 0, 24.0, 48),
    ],
)
def test_few_cosines_are_summed_to_what_transforms_make(n, cycles, degree, oversampling, knots):
    """Both are sums of some 1000 float64 numbers: 1e-13 apart at most."""
    plan = plan_highpass(n, cycles / n, degree, oversampling)
    assert plan.knots == knots
    rows = np.cumsum(np.random.default_rng(4).normal(0, 1.0, (3, n)), axis=1)
    spread = plan._spread(rows)
    expected = replace(plan, sums=())._low(spread)
    assert plan.sums
    assert np.abs(plan._low(spread) - expected).max() < 1e-13 * np.abs(expected).max()


def test_oversampling_buys_accuracy():
    rng = np.random.default_rng(1)
    x = rng.standard_normal(30000)
    expected = brick_wall(x, plan_highpass(30000, 0.001, 3, 24.0).cut, 3)
    coarse, fine = (np.std(filtered(x, 0.001, oversampling=o) - expected) for o in (10.0, 40.0))
    assert fine < coarse / 100  # fourth order: 4^4 = 256 at the cut


@pytest.mark.parametrize("cycles", [20, 35, 42, 45, 60, 400])
def test_transfer_function_is_a_brick_wall(cycles):
    """A cosine of the even extension is removed below the cut (K = 82.56 -> 83) and untouched above
    it.
    """
    n = 51600
    mode = np.cos(np.pi * 2 * cycles * (np.arange(n) + 0.5) / n)
    y = filtered(mode)
    if 2 * cycles < 83:
        assert (
            np.abs(y).max() < 1e-2
        )  # what the cubic took out of it has a little power above the cut
        assert y.std() < 1e-3
    else:
        # the least-squares cubic overlaps a cosine by O(1 / cycles^2)
        assert np.abs(y - mode).max() < 1e-4


def test_zero_phase():
    """Time reversal commutes with the filter; a source is neither shifted nor skewed."""
    rng = np.random.default_rng(2)
    x = rng.standard_normal(20000)
    np.testing.assert_allclose(filtered(x[::-1]), filtered(x)[::-1], rtol=0, atol=1e-12)
    t = np.arange(20001) - 10000
    source = np.exp(-0.5 * (t / 8.0) ** 2)
    y = filtered(source)
    np.testing.assert_allclose(y, y[::-1], rtol=0, atol=1e-12)
    near = np.abs(t) < 20
    assert abs((t * y)[near].sum() / y[near].sum()) < 1e-9
    # a Gaussian of 8 samples loses the share 2 f sqrt(2 pi) sigma of its peak below the cut
    assert abs(y.max() - (1 - 2 * CUT / RATE * np.sqrt(2 * np.pi) * 8)) < 0.002


def test_ramp_with_curvature_leaves_less_than_a_percent_of_the_white_noise():
    u = np.linspace(0, 1, 51600)
    ramp = 15 * (u + 0.1 * u**2 + 0.03 * u**3 + 0.005 * u**4)
    assert filtered(ramp).std() < 0.01 * WHITE
    assert np.abs(filtered(ramp)).max() < 0.01 * WHITE
    assert filtered(ramp.astype(np.float32)).std() < 0.01 * WHITE
    assert np.abs(filtered(ramp, degree=1)).max() > 0.01 * WHITE  # why a line is not enough


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 4000), frequency=st.floats(1e-4, 0.4), seed=st.integers(0, 99))
def test_linear_idempotent_and_finite(n, frequency, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((2, n))
    fa, fb = filtered(a, frequency), filtered(b, frequency)
    np.testing.assert_allclose(
        filtered(2 * a - 3 * b, frequency), 2 * fa - 3 * fb, rtol=0, atol=1e-11
    )
    assert np.isfinite(fa).all()
    assert fa @ fa <= a @ a * (1 + 1e-5)  # removes, never adds
    assert abs(fa.sum()) < 1e-9 * n


@pytest.mark.parametrize("n", [1, 2, 50, 1249, 1251])
def test_short_scans(bench, n):
    x = np.random.default_rng(3).standard_normal((3, n)) + 5
    run = bench.run([HighpassFilter()], bench.observation(3, n), {"signal": x}, precision="float64")
    degree = min(1, n - 1)
    cut = 0 if n < 1250 else 3
    # 3e-7: the decimation's 1e-6 of the low part
    np.testing.assert_allclose(
        run.signal, brick_wall(x, cut, 2 if cut else degree), rtol=0, atol=3e-7
    )
    assert any("shorter" in what for _, what in run.log) == (n < 1250)


@pytest.mark.parametrize("flag", [TRIMMED, TURNAROUND, SUN_UP, SUN_CLOSE])
def test_samples_with_a_signal_are_not_bridged(bench, flag):
    """Turnarounds that no map uses, ends that another filter trims, the Sun: the filter takes what
    they hold.
    """
    x = np.random.default_rng(7).standard_normal((3, 6000))
    plain, observation = (
        bench.run([HighpassFilter()], bench.observation(3, 6000), {"signal": x}),
        bench.observation(3, 6000),
    )
    observation.flags[2000:2500] = flag
    run = bench.run([HighpassFilter()], observation, {"signal": x})
    np.testing.assert_array_equal(run.signal, plain.signal)
    assert run.log["HighpassFilter", "flagged samples bridged before filtering"] == "0"


def test_modelled_mean_is_dropped_analytically(bench):
    observation = bench.observation(5, 9000)
    x = np.random.default_rng(4).normal(0, WHITE, (5, 9000))
    mean = SmoothField.constant(np.linspace(60, 70, 5), 9000)
    with_mean = bench.run([HighpassFilter()], observation, {"signal": x}, means={"signal": mean})
    without = bench.run([HighpassFilter()], bench.observation(5, 9000), {"signal": x})
    np.testing.assert_array_equal(with_mean.signal, without.signal)


def test_flagged_gap_and_nan_do_not_ring(bench):
    observation = bench.observation(3, 20000)
    x = np.random.default_rng(5).normal(0, WHITE, (3, 20000))
    clean = bench.run(
        [HighpassFilter()], bench.observation(3, 20000), {"signal": x}, precision="float64"
    ).signal
    observation.flags[7000:7050] = 1
    x[:, 7000:7050] = 1e6
    x[1, 100] = np.nan
    x[2] = np.inf
    run = bench.run([HighpassFilter()], observation, {"signal": x}, precision="float64")
    good = np.r_[0:100, 101:7000, 7050:20000]
    # the bridge replaces 50 samples of white noise by two, so the low part changes by some of its
    # own rms
    assert np.abs(run.signal - clean)[:2, good].max() < 0.2 * WHITE
    assert np.isnan(run.signal[1, 100])
    assert not np.isfinite(run.signal[2]).any()
    assert run.log["HighpassFilter", "samples not finite"] == "20001"
    assert run.log["HighpassFilter", "flagged samples bridged before filtering"] == "50"


def test_trim_flags_the_ends_and_is_reported(bench):
    x = np.random.default_rng(6).standard_normal((3, 6000))
    plain = bench.run([HighpassFilter()], bench.observation(3, 6000), {"signal": x})
    run = bench.run([HighpassFilter(trim="2 s")], bench.observation(3, 6000), {"signal": x})
    flags = run.observations[0].flags
    assert flags[:200].all()
    assert flags[-200:].all()
    assert not flags[200:-200].any()
    np.testing.assert_array_equal(run.signal, plain.signal)
    assert run.log["HighpassFilter", "samples trimmed"] == "400"
    with pytest.raises(PipelineError, match="leaves nothing"):
        bench.run([HighpassFilter(trim="30 s")], bench.observation(3, 6000), {"signal": x})


def test_bits_do_not_depend_on_blocks_or_neighbours(bench):
    x = np.random.default_rng(7).standard_normal((37, 9001))
    one = bench.run(
        [HighpassFilter()], bench.observation(37, 9001), {"signal": x}, threads=1
    ).signal
    two = bench.run(
        [HighpassFilter()], bench.observation(37, 9001), {"signal": x}, threads=3
    ).signal
    np.testing.assert_array_equal(one, two)
    lone = bench.run([HighpassFilter()], bench.observation(1, 9001), {"signal": x[20:21]}).signal
    np.testing.assert_array_equal(lone[0], one[20])


def test_cut_above_nyquist_is_refused(bench):
    with pytest.raises(PipelineError, match="removes everything"):
        bench.run(
            [HighpassFilter(frequency="50 Hz")],
            bench.observation(1, 100),
            {"signal": np.zeros((1, 100))},
        )
    with pytest.raises(ValueError):
        HighpassFilter(frequency="0 Hz")
    with pytest.raises(ValueError):
        HighpassFilter(degree=4)


@pytest.mark.parametrize("n", [1, 2, 3, 17, 90, 1249])
def test_a_scan_shorter_than_one_cycle_loses_a_line_and_says_so(bench, n):
    x = np.random.default_rng(3).standard_normal((3, n)) + 5
    run = bench.run([HighpassFilter()], bench.observation(3, n), {"signal": x}, precision="float64")
    np.testing.assert_allclose(run.signal, brick_wall(x, 0, min(1, n - 1)), rtol=0, atol=1e-12)
    said = run.log["HighpassFilter", "scan0 is shorter than 1/frequency"]
    assert said == {1: "nothing is left of 1 sample", 2: "nothing is left of 2 samples"}.get(
        n, ONLY_A_LINE
    )
    data = Data(None, [bench.observation(3, n)])
    assert HighpassFilter().check(data) == [
        f"1 of 1 scans are shorter than 1/frequency, 12.5 s: {ONLY_A_LINE}"
    ]
    if n > 1:  # as a run refuses it
        with pytest.raises(PipelineError, match="removes everything"):
            HighpassFilter(frequency="90 Hz").check(data)


@pytest.mark.parametrize("n", [3, 20, 301])
def test_a_cut_above_the_fastest_wave_of_a_scan_is_refused(bench, n):
    """Of N cosines the fastest has frequency (N - 1) / N of the Nyquist frequency, 50 Hz."""
    x = np.random.default_rng(4).standard_normal((2, n))
    fastest = (n - 1) / n * 50.0
    with pytest.raises(PipelineError, match="removes everything") as err:
        bench.run(
            [HighpassFilter(frequency=f"{fastest * 1.001} Hz")],
            bench.observation(2, n),
            {"signal": x},
        )
    assert f"below {fastest:.6g} Hz" in str(err.value)
    left = bench.run(
        [HighpassFilter(frequency=f"{fastest * 0.999} Hz", degree=0)],
        bench.observation(2, n),
        {"signal": x},
    )
    assert left.signal.std() > 0.05 / np.sqrt(n)  # one cosine of white noise, rms sqrt(2 / n) or so


@pytest.mark.parametrize("frequency", [0.08, 0.5, 20.0])
def test_gaps_at_the_ends_and_inside_of_short_scans_are_bridged(bench, frequency):
    """Lines between good neighbours, constants at the ends; then as without gaps. The lost samples
    stay as they are.
    """
    # 7 s: shorter than a cycle of 0.08 Hz; on a coarse series at 0.5 Hz; with the full DCT at 20 Hz
    n = 700
    x = np.cumsum(np.random.default_rng(5).standard_normal((4, n)), axis=1)
    lost = [np.arange(30), np.arange(650, n), np.r_[0, 100:140, n - 1], np.arange(1, n)]
    bridged = x.copy()
    for row, gap in zip(bridged, lost, strict=True):
        good = np.setdiff1d(np.arange(n), gap)
        row[gap] = np.interp(gap, good, row[good])
    for d, gap in enumerate(lost):
        x[d, gap] = np.nan
    run = bench.run(
        [HighpassFilter(frequency=f"{frequency} Hz")],
        bench.observation(4, n),
        {"signal": x},
        precision="float64",
    )
    plan = plan_highpass(n, frequency / 100, 3, 24.0)
    expected = brick_wall(bridged, plan.cut, min(3, plan.cut - 1) if plan.cut else 1)
    for d, gap in enumerate(lost):
        good = np.setdiff1d(np.arange(n), gap)
        # the coarse series errs by some 1e-6 of the low part
        np.testing.assert_allclose(
            run.signal[d, good], expected[d, good], rtol=0, atol=1e-5 * np.abs(bridged).max()
        )
        assert np.isnan(run.signal[d, gap]).all()
    assert run.log["HighpassFilter", "samples not finite"] == str(sum(map(len, lost)))
