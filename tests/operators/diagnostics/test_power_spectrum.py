"""Spectra against what is known of the series that made them."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from tests.scenes import in_blocks
from zonda.core.data import Block
from zonda.core.errors import PipelineError
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.diagnostics.power_spectrum import PowerSpectrum, Spectrum, Welch


def welch(values, sample_rate, length):
    estimator = Welch(len(values), sample_rate, length)
    return estimator.frequency, estimator(values), estimator.independent


def run(operator, observation, data, streams, means=None, sizes=(16,)):
    return in_blocks(operator, observation, data, streams, means, sizes)["spectrum"]


@pytest.fixture
def noise(make_observation):
    rng = np.random.default_rng(5)
    return {
        k: rng.normal(0, 1e-3, (19, 20000)).astype(np.float32)
        for k in ("signal", "white", "atmosphere", "sky")
    }


def test_white_noise_has_twice_its_variance_over_the_rate():
    values = np.random.default_rng(1).normal(0, 3.0, 2**18)
    _, p, independent = welch(values, 100.0, 1024)
    # The mean over m frequencies of averages of n independent exponentials has the relative error
    # (m n)^-1/2; neighbouring frequencies share the Hann window: 1.5 times the variance, in f and
    # again for detrended first bins (left out)
    error = np.sqrt(1.5 / (independent * (len(p) - 5)))
    assert np.mean(p[4:-1]) == pytest.approx(2 * 9.0 / 100.0, rel=4 * error)
    assert np.std(p[4:-1]) / np.mean(p[4:-1]) == pytest.approx(
        independent**-0.5, rel=0.15
    )  # 507 values: 3 %, correlated: 4 %


@pytest.mark.parametrize("length", [1000, 1001])
def test_the_power_of_a_sine_is_recovered(length):
    """The window is applied once and divided out: the integral of the spectrum is half the squared
    amplitude.
    """
    t = np.arange(50000) / 50.0
    f, p, _ = welch(0.7 * np.sin(2 * np.pi * 3.02 * t + 0.4), 50.0, length)
    assert (p * 50.0 / length).sum() == pytest.approx(0.7**2 / 2, rel=1e-3)
    assert f[p.argmax()] == pytest.approx(3.02, abs=50.0 / length)


@pytest.mark.parametrize("length", [256, 1023, 5000])
def test_equal_to_scipy(length):
    """Also in several chunks of segments (256) and in one segment (5000)."""
    values = np.random.default_rng(2).normal(size=5000)
    f, p, _ = welch(values, 10.0, length)
    g, q = scipy.signal.welch(
        values, 10.0, "hann", length, noverlap=length - length // 2, detrend="linear"
    )
    np.testing.assert_allclose(f, g[1:], rtol=1e-14)
    np.testing.assert_allclose(p, q[1:], rtol=1e-10)


def test_a_drift_is_taken_out():
    t = np.arange(8192) / 100.0
    _, p, _ = welch(70.0 + 0.3 * t, 100.0, 8192)
    assert p.max() < 1e-20


def test_components_are_referred_to_the_sky(make_observation, data, noise):
    observation = make_observation(20000)
    observation.components = frozenset({"sky", "white", "atmosphere"})
    found = run(PowerSpectrum(segment="20 s"), observation, data, noise)
    level = 2 * 1e-6 / 50.0
    # 16 detectors x 39 half-overlapping segments x 500 frequencies (1.5: Hann): 0.23 %; five sigma
    for name, factor in {
        "signal": 1.0,
        "sky": 1.0,
        "white": 1 / 0.27**2,
        "atmosphere": (0.8 / 0.27) ** 2,
    }.items():
        assert np.mean(found.psd[name][3:-1]) == pytest.approx(level * factor, rel=0.012), name
    assert found.white_level == pytest.approx(2e-6)
    assert found.detectors == 16
    assert list(found.psd) == ["signal", "atmosphere", "white", "sky"]


def test_the_mean_emission_leaves_no_trace(make_observation, data, noise):
    """70 K, falling by 15 K in 45 min, under 1 mK noise."""
    observation = make_observation(20000)
    step, n = 2048, -(-20000 // 2048) + 3
    slope = SmoothField(
        np.ones((19, 1)),
        70.0 - 15.0 * (np.arange(n)[None, :] - 1) * step / 50.0 / 2700,
        step,
        20000,
    )
    with_mean = run(
        PowerSpectrum(streams=["signal"], segment="20 s"),
        observation,
        data,
        noise,
        {"signal": slope},
    )
    data.products.clear()
    without = run(PowerSpectrum(streams=["signal"], segment="20 s"), observation, data, noise)
    np.testing.assert_allclose(with_mean.psd["signal"], without.psd["signal"], rtol=1e-7)


def test_no_block_size_changes_a_bit(make_observation, data, noise):
    observation = make_observation(20000)
    found = []
    for sizes in ((16,), (19,), (1,) * 19):
        data.products.clear()
        found.append(run(PowerSpectrum(), observation, data, noise, sizes=sizes))
    for other in found[1:]:
        for name, psd in found[0].psd.items():
            np.testing.assert_array_equal(psd, other.psd[name])


def test_scans_are_averaged(make_observation, data, noise):
    operator = PowerSpectrum(streams=["signal"], detectors=4)
    one, three = (
        run(operator, make_observation(20000), data, {"signal": k * noise["signal"]})
        for k in (1, 3)
    )
    short = run(operator, make_observation(1000), data, {"signal": noise["signal"][:, :1000]})
    before = one.psd["signal"].copy()
    for spectrum in (one, three, short):
        data.add(operator.label, type(spectrum).of(spectrum.arrays()))  # as from another process
    operator.finalize(data)
    both = data.products["spectrum"]
    assert both.observations == 2
    np.testing.assert_allclose(both.psd["signal"], 5 * before, rtol=1e-6)  # (1 + 9) / 2
    assert (
        data.log.get("PowerSpectrum", "scans of another length left out of the mean spectrum") == 1
    )


def test_flagged_and_broken_detectors(make_observation, data, noise):
    observation = make_observation(20000)
    observation.detector_flags[:10] = 1
    noise["signal"][12, 500] = np.nan
    found = run(PowerSpectrum(streams=["signal"]), observation, data, noise)
    assert np.isfinite(found.psd["signal"]).all()
    assert found.detectors == 9
    assert (
        observation.log.get("PowerSpectrum", "detectors left out for non-finite samples of signal")
        == 1
    )
    assert (
        observation.log.get("PowerSpectrum", "flagged samples that the power spectra include") == 13
    )


def test_a_scan_of_one_sample(make_observation, data):
    observation = make_observation(1)
    operator = PowerSpectrum()
    state = operator.prepare(observation)
    operator.exec(
        Block(observation, slice(0, 19), slice(0, 1), {"signal": np.ones((19, 1), np.float32)}),
        state,
    )
    operator.collect(data, observation, state)
    operator.finalize(data)
    assert data.products == {}
    assert observation.log.get("PowerSpectrum", "scans too short for a power spectrum") == 1


def test_a_scan_whose_detectors_are_all_flagged(make_observation, data, noise):
    observation = make_observation(20000)
    observation.detector_flags[:] = 1
    operator = PowerSpectrum()
    state = operator.prepare(observation)
    operator.exec(Block(observation, slice(0, 19), slice(0, 20000), noise), state)
    operator.collect(data, observation, state)
    operator.finalize(data)
    assert data.products == {}
    assert (
        observation.log.get("PowerSpectrum", "scans without a detector that has a power spectrum")
        == 1
    )


def test_segments_have_lengths_that_transform_quickly(make_observation):
    """No prime factor above 5; the shipped rates have such lengths already."""
    assert PowerSpectrum(segment="20 s").prepare(make_observation(20000)).welch.frequency[0] == 0.05
    assert (
        len(PowerSpectrum().prepare(make_observation(1999)).welch.frequency) == 972
    )  # 1944 = 2^3 3^5


def test_a_stream_that_is_not_there(make_observation, noise):
    observation, operator = make_observation(20000), PowerSpectrum(streams=["pink"])
    block = Block(observation, slice(0, 16), slice(0, 20000), {k: v[:16] for k, v in noise.items()})
    with pytest.raises(PipelineError, match="no stream 'pink'"):
        operator.exec(block, operator.prepare(observation))


def test_the_knee_is_where_pink_equals_white():
    f = np.linspace(0.01, 50, 5000)
    spectrum = Spectrum(
        f, {"white": np.full(5000, 2.0), "pink": 2.0 * (0.5 / f)}, 100.0, 2.0, "PowerSpectrum", 16
    )
    assert spectrum.knee() == pytest.approx(
        0.5, rel=0.05
    )  # logarithmic bins of 1/3 decade, interpolated
    assert Spectrum(f, {"white": np.full(5000, 2.0)}, 1.0, 2.0, "x", 1).knee() is None
    assert (
        Spectrum(
            f, {"white": np.full(5000, 2.0), "pink": np.full(5000, 1.0)}, 1.0, 2.0, "x", 1
        ).knee()
        is None
    )


def test_other_signals_have_no_spectrum(make_observation, data, noise):
    found = run(
        PowerSpectrum(),
        make_observation(20000),
        data,
        noise | {"signal/noiseless": noise["signal"]},
    )
    assert "signal/noiseless" not in found.psd
    assert "signal" in found.psd
