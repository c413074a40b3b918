"""Gain drifts: their rms, their spectrum, the mean of the atmosphere that drifts with them."""

from __future__ import annotations

import numpy as np
import pytest

import zonda.testing
from zonda.core.numerics.random import normals
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.detectors.gain_drift import GainDrift, grid


def gains(bench, n_det, n_samples, index=0, **parameters):
    field = GainDrift(**parameters).prepare(bench.observation(n_det, n_samples, index=index))
    return field.evaluate(slice(0, n_det), slice(0, n_samples))


def test_it_keeps_the_contract():
    zonda.testing.check_operator(GainDrift(rms="1 %", fastest="0.2 Hz"))


@pytest.mark.parametrize("slope", [0.0, 1.0, 2.0])
def test_the_rms_is_what_is_asked_for_at_every_instant(bench, slope):
    """Over detectors, which are independent: sum of squares / rms^2 is chi^2 with n degrees at each
    instant.
    """
    n = 4000
    g = gains(bench, n, 3000, rms="2 %", slope=slope, fastest="0.5 Hz")[:, ::500]
    assert (np.abs((g**2).mean(axis=0) / 0.02**2 - 1) < 4.5 * np.sqrt(2 / n)).all()  # six instants
    assert (np.abs(g.mean(axis=0)) < 4.5 * 0.02 / np.sqrt(n)).all()


@pytest.mark.parametrize("slope", [1.0, 2.0])
def test_the_spectrum_falls_as_it_should(bench, slope):
    """Equation (1): <g(t) g(t + s)> = rms^2 sum_k p_k cos(2 pi k s / P)."""
    n, n_samples = 6000, 3000
    step, nodes, waves = grid(bench.observation(1, n_samples), 0.4)
    period = nodes * step / 100.0
    k = np.arange(1, waves + 1)
    power = k**-slope / (k**-slope).sum()
    g = gains(bench, n, n_samples, rms="1 %", slope=slope, fastest="0.4 Hz")
    for lag in (100, 700, 2000):
        expected = float(power @ np.cos(2 * np.pi * k * lag / 100 / period))
        found = float((g[:, 200] * g[:, 200 + lag]).mean()) / 1e-4
        # products of normals of correlation r have the variance 1 + r^2
        assert abs(found - expected) < 4 * np.sqrt((1 + expected**2) / n)


@pytest.mark.parametrize("slope", [0.0, 2.0])
def test_the_splines_are_the_series(bench, slope):
    """Equation (1) summed wave by wave at every sample: within (2 pi / 16)^4 / 384 = 6.2e-5 of each
    wave's amplitude.
    """
    observation, step = (
        bench.observation(3, 3000),
        GainDrift(rms="1 %", slope=slope, fastest="0.5 Hz"),
    )
    found = step.prepare(observation).evaluate(slice(0, 3), slice(0, 3000))
    every, nodes, waves = grid(observation, 0.5)
    k = np.arange(1, waves + 1)
    amplitude = 0.01 * np.sqrt(k**-slope / (k**-slope).sum())
    phase = 2 * np.pi * np.outer(k, np.arange(3000)) / (nodes * every)
    for d, row in enumerate(found):
        drawn = normals(observation.detector_key(step.label), 0, 2 * waves, stream=d).astype(
            np.float64
        )
        a, b = amplitude * drawn[:waves], amplitude * drawn[waves:]
        series = a @ np.cos(phase) + b @ np.sin(phase)
        assert np.abs(row - series).max() < 6.2e-5 * (np.abs(a) + np.abs(b)).sum()


def test_it_is_slow(bench):
    """Nothing above `fastest`, besides what the splines and the ends of the scan leave."""
    g = gains(bench, 3, 1 << 16, rms="1 %", slope=0.0, fastest="50 mHz")
    window = np.hanning(g.shape[1])
    spectrum = np.abs(np.fft.rfft((g - g.mean(axis=1, keepdims=True)) * window)) ** 2
    f = np.fft.rfftfreq(g.shape[1], 0.01)
    assert spectrum[:, f > 0.06].sum() < 1e-6 * spectrum.sum()
    assert spectrum[:, (f > 0.02) & (f < 0.05)].sum() > 0.3 * spectrum.sum()  # 0.6 of the band


def test_the_mean_emission_drifts_with_the_gain(bench):
    """30 K beside the stream, and in it: the same."""
    x = np.random.default_rng(0).standard_normal((3, 3000)) * 1e-3
    means = {"signal": SmoothField.constant(np.full(3, 30.0), 3000)}
    step = GainDrift(rms="1 %", fastest="0.1 Hz")
    found = bench.run(
        [step], bench.observation(3, 3000), {"signal": x}, means=means, precision="float64"
    ).signal
    g = 1 + gains(bench, 3, 3000, rms="1 %", fastest="0.1 Hz")
    np.testing.assert_allclose(found, (x + 30) * g, rtol=0, atol=1e-12)
    assert found.std() > 0.02


def test_detectors_and_scans_are_independent(bench):
    a, b = (gains(bench, 500, 2000, index=k)[:, 1000] for k in (0, 1))
    for one, other in ((a, b), (a[1:], a[:-1])):
        assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(500)


def test_a_short_scan_has_half_a_cycle(bench):
    g = gains(bench, 2000, 300, rms="1 %", fastest="1 mHz")
    assert abs((g**2).mean(axis=0)[150] / 1e-4 - 1) < 4.5 * np.sqrt(2 / 2000)
    assert np.ptp(g, axis=1).max() < 0.1
