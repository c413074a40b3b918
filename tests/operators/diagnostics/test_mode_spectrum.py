"""Principal components against numpy's singular values, closed forms, and for any block size."""

import numpy as np
import pytest
from astropy.table import Table

import zonda
import zonda.testing
from zonda.core.errors import ZondaError
from zonda.core.figures import measure
from zonda.operators.diagnostics.series import Modes
from zonda.plugins.checks import scenes

SAMPLES = 5000
T = np.arange(SAMPLES) / 100.0


def streams(detectors=6, seed=0):
    """A common wave of 1 K, another of 0.3 K with a gradient over the detectors, and noise of 0.05
    K; on a mean of 30 K.
    """
    random = np.random.default_rng(seed)
    gradient = np.linspace(-1, 1, detectors)[:, None]
    made = np.sin(2 * np.pi * T / 10) + 0.3 * gradient * np.cos(2 * np.pi * T / 3)
    return (
        made
        + 0.05 * random.standard_normal((detectors, SAMPLES))
        + 30
        + np.arange(detectors)[:, None]
    )


def found(signal, observation=None, **parameters):
    scan = scenes.scan(len(signal), signal.shape[1]) if observation is None else observation
    return scenes.run([zonda.ModeSpectrum(**parameters)], scan, signal).products["modes"]


def test_it_keeps_the_contract():
    zonda.testing.check_operator(zonda.ModeSpectrum(modes=2))


def test_singular_values_are_numpys():
    signal = streams()
    modes = found(signal, modes=3)
    rest = signal - signal.mean(axis=1, keepdims=True)
    u, s, v = np.linalg.svd(rest, full_matrices=False)
    assert modes.values[0, :6] == pytest.approx(s / np.sqrt(signal.size), rel=1e-9)
    assert modes.shares[:6] == pytest.approx(s**2 / (s**2).sum(), rel=1e-9)
    assert abs(modes.vectors @ u[:, :3]) == pytest.approx(np.eye(3), abs=1e-7)
    sign = np.sign((modes.vectors * u[:, :3].T).sum(axis=1))[:, None]
    assert modes.streams == pytest.approx(sign * s[:3, None] * v[:3], abs=1e-9)
    whole = found(signal, center=False)
    assert whole.values[0, 0] == pytest.approx(
        np.linalg.svd(signal, compute_uv=False)[0] / np.sqrt(signal.size), rel=1e-12
    )
    alike = found(signal, normalize=True)
    unit = np.linalg.svd(rest / rest.std(axis=1, keepdims=True), compute_uv=False)
    assert alike.values[0, :6] == pytest.approx(unit / np.sqrt(signal.size), rel=1e-9)
    assert alike.unit == ""


def test_lagged_components_see_what_moves():
    """A pulse that crosses four detectors, 0.2 s apart: at one instant all see their own; with
    three delays it is one mode.

    White noise of unit variance, delayed: instantaneous shares are 1/4 each. The embedded matrix
    holds it at 7 lags, 1 to 4 times: its leading eigenvalue is 4 of 16.
    """
    noise = np.random.default_rng(1).standard_normal(SAMPLES + 60)
    signal = np.array([noise[60 - 20 * d : 60 - 20 * d + SAMPLES] for d in range(4)])
    # a covariance of 5000 samples is known to 1.4 %; the largest of equal eigenvalues is 6 % high:
    # (1 + sqrt(4 / 5000))^2
    assert found(signal).shares[0] == pytest.approx(1 / 4, rel=0.08)
    lagged = found(signal, delays=3, delay="0.2 s")
    assert lagged.shares[0] == pytest.approx(4 / 16, rel=0.08)
    assert np.count_nonzero(lagged.values[0] > 1e-6) == 7  # 16 rows, 7 different series
    assert (lagged.delays, lagged.delay, lagged.vectors.shape) == (3, pytest.approx(0.2), (4, 16))


def test_lagged_components_are_those_of_the_embedded_matrix():
    signal = streams(3)
    lagged = found(signal, delays=2, delay="0.5 s", modes=2)
    rows = np.concatenate([signal[:, 50 * k : SAMPLES - 100 + 50 * k] for k in range(3)])
    s = np.linalg.svd(rows - rows.mean(axis=1, keepdims=True), compute_uv=False)
    assert lagged.values[0, :9] == pytest.approx(s / np.sqrt(rows.size), rel=1e-8)
    assert np.isnan(lagged.streams[:, -100:]).all()
    assert np.isfinite(lagged.streams[:, :-100]).all()


def test_flags_are_left_out():
    signal, scan = streams(), scenes.scan(6, SAMPLES)
    signal[:, 1000:1100] = 1e6
    signal[2] = np.nan
    scan.flags[1000:1100] = 1
    scan.detector_flags[4] = 1
    modes = found(signal, scan)
    good = np.delete(np.delete(signal, np.s_[1000:1100], axis=1), [2, 4], axis=0)
    s = np.linalg.svd(good - good.mean(axis=1, keepdims=True), compute_uv=False)
    assert modes.values[0, :4] == pytest.approx(s / np.sqrt(good.size), rel=1e-9)
    assert np.isnan(modes.streams[:, 1000:1100]).all()


@pytest.mark.parametrize("settings", [{"memory": 3_000_000}, {"threads": 2}])
def test_the_bits_do_not_depend_on_blocks(settings):
    noise = zonda.WhiteNoise()
    steps = [noise, zonda.Efficiency(), zonda.ModeSpectrum()]
    one, other = (
        scenes.run(steps, scenes.scan(37, 6000), **more).products["modes"]
        for more in ({}, settings)
    )
    for name in ("values", "energy", "streams", "vectors"):
        assert scenes.differing(getattr(one, name), getattr(other, name)) == 0


def test_microkelvins_beside_the_mean():
    """float32 streams with the atmosphere's mean of tens of kelvin beside them: as in float64."""
    steps = [zonda.AtmosphereLayers(pwv="5 mm"), zonda.Efficiency(), zonda.ModeSpectrum()]
    narrow, wide = (
        scenes.run(steps, scenes.scan(7, 3000), precision=p).products["modes"]
        for p in ("float32", "float64")
    )
    assert narrow.shares[:7] == pytest.approx(wide.shares[:7], rel=1e-4)
    assert wide.shares[0] > 0.9


def test_tables_and_scans(tmp_path):
    one = Modes(
        np.array([[3.0, 4.0]]),
        np.array([25.0]),
        T[:4],
        np.ones((1, 4)),
        np.ones((1, 2)),
        ["a", "b"],
        0,
        0.0,
        "K_RJ",
        "s",
        "m",
    )
    other = Modes(
        np.array([[4.0, 2.0]]),
        np.array([20.0]),
        T[:4],
        np.ones((1, 4)),
        np.ones((1, 2)),
        ["a", "b"],
        0,
        0.0,
        "K_RJ",
        "t",
        "m",
    )
    one += other
    assert one.shares == pytest.approx([(0.36 + 0.8) / 2, (0.64 + 0.2) / 2])
    assert one.error[0] == pytest.approx(0.22)
    assert Modes.of(one.arrays()).shares == pytest.approx(one.shares)
    step = zonda.ModeSpectrum(modes=2)
    data = scenes.run([step], scenes.scan(6, SAMPLES), streams(), output=tmp_path)
    table = Table.read(tmp_path / "modes.ecsv", format="ascii.ecsv")
    assert table["share"].sum() == pytest.approx(1)
    assert table["cumulative"][-1] == pytest.approx(1)
    times = Table.read(tmp_path / "modes_streams.ecsv", format="ascii.ecsv")
    assert times.colnames == ["seconds", "mode_1", "mode_2"]
    figure = measure(data, "first_component")
    assert figure.value == data.products["modes"].shares[0]
    assert "instantaneous" in figure.description


def test_too_many_rows_are_refused():
    with pytest.raises(
        ZondaError,
        match=r"6 detectors with 1000 delays are more than 4096 rows(.|\n)*set detectors to 4",
    ):
        found(streams(), delays=1000)
    with pytest.raises(ZondaError, match="there is no mode spectrum 'modes'"):
        measure(scenes.run([zonda.BinMap()], scenes.scan(6, SAMPLES), streams()), "first_component")
