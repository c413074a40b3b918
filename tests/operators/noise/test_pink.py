import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zonda.core.errors import InputError, ZondaError
from zonda.core.numerics.random import normals, stream_key
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.noise.one_over_f import power_law_filter
from zonda.operators.noise.pink import PinkNoise
from zonda.operators.noise.streams import CHECKPOINT, Streams
from zonda.operators.noise.white import WhiteNoise

NET = 1.7e-3
BANDS = 12


def spectrum(values, rate):
    """Hann-windowed one-sided power spectral density averaged over detectors and half-overlapped
    halves of the scan.
    """
    n = values.shape[1] // 2
    window = np.hanning(n + 1)[:n]
    pieces = np.concatenate([values[:, k : k + n] for k in (0, n // 2, n)]).astype(np.float64)
    power = abs(np.fft.rfft(pieces * window, axis=1)) ** 2
    return np.fft.rfftfreq(n, 1 / rate), 2 * power.mean(0) / (rate * (window**2).sum())


def expected_spectrum(law, n, rate):
    """Expectation of `spectrum` of unit innovations: the law's covariance times the window's
    autocorrelation.
    """
    grid = 1 << 21
    covariance = np.fft.irfft(law.response(np.fft.rfftfreq(grid)))[:n]
    window = np.hanning(n + 1)[:n]
    overlap = np.fft.irfft(abs(np.fft.rfft(window, 2 * n)) ** 2)[:n]
    product = covariance * overlap
    return (
        2
        * (2 * np.fft.rfft(np.r_[product, np.zeros(n)]).real[::2] - product[0])
        / (rate * (window**2).sum())
    )


def in_bands(frequency, ratio, low, high):
    edges = np.geomspace(low, high, BANDS + 1)
    which = np.digitize(frequency, edges) - 1
    inside = (which >= 0) & (which < BANDS)
    count = np.bincount(which[inside], minlength=BANDS)
    return np.bincount(which[inside], ratio[inside], BANDS) / count, count


@pytest.mark.parametrize(
    ("slope", "f_min"), [(0.5, 0.1), (1.0, 0.1), (1.0, 0.002), (2.0, 0.1), (3.0, 0.2)]
)
def test_spectrum(make_observation, simulate, slope, f_min):
    rate, n, n_det = 100.0, 1 << 16, 96
    observation = make_observation(n_det=n_det, n_samp=n, rate=rate)
    pink = simulate(
        observation, PinkNoise(slope=slope, minimum_frequency=f"{f_min} Hz", knee="2 Hz")
    )["pink"]
    frequency, power = spectrum(pink, rate)
    law = power_law_filter(f_min / rate, slope, 8)
    scale = 2 * NET**2 * (2.0 / f_min) ** slope
    low = max(0.01, f_min / 5)
    # Values of a Hann-windowed spectrum are exponentially distributed, neighbours' correlation^2 is
    # 4/9 and 1/36, halves that overlap by half 1/36: variance of a band mean = 1.94 * (1 + 4/3/36)
    # / (3 n_det n_bins).
    expected = expected_spectrum(law, n // 2, rate) * rate / 2
    ratio, count = in_bands(frequency[1:], (power / (scale * expected))[1:], low, rate / 2)
    error = np.sqrt(1.94 * 1.04 / (3 * n_det * count))
    assert (abs(ratio - 1) < 4.5 * error).all()
    if slope < 2.5:  # the window leaks less than a per cent there
        above = frequency > 3 * f_min
        target = scale * (frequency[above] / f_min) ** -slope
        ratio, count = in_bands(frequency[above], power[above] / target, 3 * f_min, rate / 2)
        assert (
            abs(ratio - 1) < law.error + 0.01 + 4.5 * np.sqrt(1.94 * 1.04 / (3 * n_det * count))
        ).all()


@pytest.mark.parametrize("slope", [0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
@pytest.mark.parametrize("f_min", [1e-8, 1e-5, 1e-2, 0.3])
def test_fit_is_as_good_as_it_says(slope, f_min):
    law = power_law_filter(f_min, slope, 10)
    frequency = np.r_[
        np.geomspace(f_min, 0.5, 3001), np.linspace(0.9 * 0.5 + 0.1 * f_min, 0.5, 1001)
    ]
    error = abs(law.response(frequency) * (frequency / f_min) ** slope - 1).max()
    assert error < 1.1 * law.error + 1e-3
    assert law.error < 0.07
    assert 0.3 < law.plateau < 200
    assert (law.poles > 0).all()
    assert (law.poles < 2).all()


def test_more_poles_fit_better():
    errors = [power_law_filter(1e-5, 1.0, poles).error for poles in (4, 6, 8, 10, 12)]
    np.testing.assert_allclose(
        errors, [0.18, 0.051, 0.018, 0.007, 0.0026], rtol=0.2
    )  # the documented table


def test_the_plateau_joins_the_law():
    law = power_law_filter(1e-4, 1.0, 8)
    below = law.response(np.geomspace(1e-8, 1e-4, 200))
    assert (np.diff(below) < 1e-6).all()
    assert below[0] == pytest.approx(law.plateau, rel=1e-4)
    assert 1 < law.plateau < 3


@pytest.mark.parametrize("slope", [1.0, 3.0])
def test_variance_and_stationarity(slope):
    """The first sample is as any other: ensemble variances at the start and late equal theory, and
    so does theory's integral.
    """
    law = power_law_filter(1e-3, slope, 8)
    frequency = np.r_[np.linspace(0, 1e-3, 2000, endpoint=False), np.geomspace(1e-3, 0.5, 20_000)]
    assert 2 * np.trapezoid(law.response(frequency), frequency) == pytest.approx(
        law.gain * law.variance, rel=1e-4
    )
    n_det = 20_000
    streams = Streams(law, stream_key(5, "a"), stream_key(5, "b"))
    for sample in (0, 3000):
        out = np.zeros((n_det, 1), np.float32)
        streams.add(0, sample, out)
        variance = (out.astype(np.float64) ** 2).mean()
        assert variance == pytest.approx(law.variance, rel=4.5 * np.sqrt(2 / n_det))


def test_long_series_keeps_its_variance():
    """4 million samples (11 h at 100 Hz), correlation time some 1600 samples: no drift, no loss in
    float32.
    """
    law = power_law_filter(1e-4, 1.0, 8)
    n, n_det = 1 << 20, 4
    streams = Streams(law, stream_key(6, "a"), stream_key(6, "b"))
    out = np.zeros((n_det, 1 << 16), np.float32)
    total = np.zeros(2)
    for start in range(0, 4 * n, out.shape[1]):
        out[...] = 0
        streams.add(0, start, out)
        total[start >= 2 * n] += (out.astype(np.float64) ** 2).sum()
    # Var(sample variance) = 2 int C^2 dt / T per series, and int C^2 dt = int P^2 df (two-sided).
    frequency = np.r_[np.linspace(0, 1e-4, 2000, endpoint=False), np.geomspace(1e-4, 0.5, 20_000)]
    power = law.response(frequency) / law.gain
    error = np.sqrt(2 * 2 * np.trapezoid(power**2, frequency) / (2 * n * n_det)) / law.variance
    assert error < 0.03
    np.testing.assert_allclose(total / (2 * n * n_det), law.variance, rtol=4.5 * error)


@pytest.mark.parametrize(("f_min", "slope"), [(1e-5, 1.0), (1e-8, 1.0), (1e-7, 2.0), (1e-5, 3.0)])
def test_float32_states_are_enough(f_min, slope):
    from scipy.signal import lfilter

    law, n = power_law_filter(f_min, slope, 8), 1 << 15
    streams = Streams(law, stream_key(7, "a"), stream_key(7, "b"))
    out = np.zeros((16, n), np.float32)
    streams.add(0, 0, out)
    exact = normals(stream_key(7, "a"), 0, 16 * n).reshape(n, 16).T.astype(np.float64)
    n_states = len(law.start)
    first = law.start @ normals(stream_key(7, "b"), 0, n_states * 16).reshape(n_states, 16)
    for q, z, s in zip(law.poles, law.zeros, first[:8], strict=True):
        exact, _ = lfilter([1, z - 1], [1, q - 1], exact, axis=1, zi=((z - q) * s)[:, None])
    for (a, b, real, imaginary), (r, i) in zip(
        law.pairs, first[8:].reshape(-1, 2, 16), strict=True
    ):
        y = exact.copy()
        for t in range(n):  # equation (3)
            y[:, t] += real * r + imaginary * i
            r, i = r + (exact[:, t] - a * r + b * i), i - (a * i + b * r)
        exact = y
    assert abs(out - exact).std() < 1e-3 * exact.std()
    # At every frequency, not only where the power is; differences, lest the lowest frequencies leak
    # over all others.
    noise, signal = (
        abs(np.fft.rfft(np.diff(x, axis=1) * np.hanning(n - 1), axis=1)) ** 2
        for x in (out - exact, exact)
    )
    bands = np.geomspace(1, n // 2, 40).astype(int)[::4]
    assert (
        np.add.reduceat(noise.sum(0), bands) < 1e-3 * np.add.reduceat(signal.sum(0), bands)
    ).all()


LAW = power_law_filter(1e-3, 1.0, 6)


@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_any_order_of_any_blocks_gives_the_same_bits(data):
    n_det, n = 20, 3000
    whole = np.zeros((n_det, n), np.float32)
    Streams(LAW, stream_key(8, "a"), stream_key(8, "b")).add(0, 0, whole)
    streams = Streams(LAW, stream_key(8, "a"), stream_key(8, "b"))
    for _ in range(4):
        d, t = data.draw(st.integers(0, n_det - 1)), data.draw(st.integers(0, n - 1))
        rows, columns = data.draw(st.integers(1, n_det - d)), data.draw(st.integers(1, n - t))
        part = np.zeros((rows, columns), np.float32)
        streams.add(d, t, part)
        assert np.array_equal(part, whole[d : d + rows, t : t + columns])


def test_checkpoints():
    """Blocks beyond several checkpoints, visited backwards and by threads at once; only checkpoints
    and one end are kept.
    """
    n = 3 * CHECKPOINT + 4096
    whole = np.zeros((16, n), np.float32)
    Streams(LAW, stream_key(9, "a"), stream_key(9, "b")).add(0, 0, whole)
    streams = Streams(LAW, stream_key(9, "a"), stream_key(9, "b"))
    result = np.zeros_like(whole)

    def visit(starts):
        for start in starts:
            part = np.zeros((16, min(8192, n - start)), np.float32)
            streams.add(0, start, part)
            result[:, start : start + part.shape[1]] = part

    starts = list(range(0, n, 8192))[::-1]
    threads = [threading.Thread(target=visit, args=(starts[k::3],)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert np.array_equal(result, whole)
    kept = streams._tiles[0].kept
    assert {k for k in kept if k % CHECKPOINT == 0} == {
        0,
        CHECKPOINT,
        2 * CHECKPOINT,
        3 * CHECKPOINT,
    }
    assert len(kept) <= 5


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shared", [0, 0.5])
def test_blocks_never_change_a_bit(make_observation, simulate, dtype, shared):
    pink = PinkNoise(shared=shared)
    whole = simulate(make_observation(n_det=37, n_samp=10_000), pink, dtype=dtype)["pink"]
    blocks = [
        (slice(d, min(d + 16, 37)), slice(t, min(t + 4096, 10_000)))
        for t in (8192, 0, 4096)
        for d in (32, 0, 16)
    ]
    assert np.array_equal(
        simulate(make_observation(n_det=37, n_samp=10_000), pink, blocks=blocks, dtype=dtype)[
            "pink"
        ],
        whole,
    )
    assert np.array_equal(
        simulate(make_observation(n_det=5, n_samp=3000), pink, dtype=dtype)["pink"],
        whole[:5, :3000],
    )


def test_independent_between_detectors_observations_seeds_and_of_white(make_observation, simulate):
    # A spectrum flat over most of the band, so that the number of independent samples is known.
    pink = PinkNoise(minimum_frequency="20 Hz", knee="20 Hz")
    n = 1 << 16

    def stream(operator, name="pink", **arguments):
        values = simulate(make_observation(n_samp=n, **arguments), operator)[name].astype(
            np.float64
        )
        return values / values.std()

    first = stream(pink)
    law = power_law_filter(0.2, 1.0, 8)
    frequency = np.linspace(0, 0.5, 20_001)
    power = law.response(frequency) / law.gain
    bound = (
        5 * np.sqrt(2 * np.trapezoid(power**2, frequency) / n) / law.variance
    )  # int C^2 dt = int P^2 df
    assert bound < 0.04
    assert abs(np.corrcoef(first) - np.eye(16)).max() < bound
    for other in (
        stream(pink, seed=2),
        stream(pink, index=1),
        stream(PinkNoise(name="b", minimum_frequency="20 Hz", knee="20 Hz")),
        stream(WhiteNoise(), "white"),
    ):
        assert abs((first * other).mean(1)).max() < bound
    assert np.array_equal(first, stream(pink))


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_shared_part(make_observation, simulate, share):
    """Coherence of two detectors is the shared part of the power, at all frequencies; the power
    stays.
    """
    rate, n, n_det = 100.0, 1 << 15, 64
    observation = make_observation(n_det=n_det, n_samp=n)
    pink = simulate(observation, PinkNoise(shared=share))["pink"].astype(np.float64)
    field = np.fft.rfft(pink * np.hanning(n), axis=1)[:, 50:-1]
    power = (abs(field) ** 2).mean(0)
    cross = (abs(field.sum(0)) ** 2 - n_det * power) / (n_det * (n_det - 1))
    shape = power_law_filter(0.1 / rate, 1.0, 8).response(np.fft.rfftfreq(n)[50:-1])
    scale = rate / 2 * n * 0.375 * 2 * NET**2 * 10  # Hann: mean square 3/8; knee / f_min = 10
    for k in range(4):
        part = slice(4096 * k, 4096 * (k + 1) - 60)
        relative = (cross[part] / (scale * shape[part])).mean()
        # One common realization: relative error 1 / sqrt(bins / 1.94) of its power.
        assert relative == pytest.approx(
            share, abs=4.5 * np.sqrt(1.94 / 4036) * (share + 1 / n_det)
        )
        total = (power[part] / (scale * shape[part])).mean()
        assert total == pytest.approx(
            1, abs=4.5 * np.sqrt(1.94 / 4036 * (share**2 + (1 - share**2) / n_det))
        )
    other = simulate(make_observation(n_samp=n, index=1), PinkNoise(shared=share))["pink"]
    assert not np.array_equal(other[0], pink[0].astype(np.float32))


def test_level_follows_white_noise(make_observation, simulate):
    """Scatter, reference and transmission of WhiteNoise carry over, in either order of steps and in
    its absence later.
    """

    def observe():
        observation = make_observation(n_det=4, zeta=0.3)
        observation.smooth["transmission"] = SmoothField.constant(
            np.full(4, 0.5), observation.n_samples
        )
        return observation

    plain = simulate(make_observation(n_det=4), PinkNoise())["pink"]
    white = WhiteNoise(scatter=0.3)
    observation = observe()
    pink = simulate(observation, white, PinkNoise())["pink"]
    factor = 0.3 * 0.5 * observation.focalplane.net / NET
    np.testing.assert_allclose(pink, plain * factor[:, None], rtol=1e-4, atol=1e-9)
    assert np.array_equal(simulate(observe(), PinkNoise(), white)["pink"], pink)
    assert np.array_equal(simulate(observation, PinkNoise())["pink"], pink)
    at_detector = simulate(
        observe(), WhiteNoise(net="3.4 mK s(1/2)", reference="detector"), PinkNoise()
    )["pink"]
    np.testing.assert_allclose(at_detector, 2 * plain, rtol=1e-5, atol=1e-9)


def test_own_level(make_observation, simulate):
    plain = simulate(make_observation(zeta=0.3), PinkNoise())["pink"]
    np.testing.assert_allclose(
        simulate(make_observation(zeta=0.3), PinkNoise(net="3.4 mK s(1/2)"))["pink"],
        2 * plain,
        rtol=1e-5,
        atol=1e-9,
    )
    at_detector = simulate(
        make_observation(zeta=0.3), PinkNoise(net="1.7 mK s(1/2)", reference="detector")
    )["pink"]
    np.testing.assert_allclose(0.3 * at_detector, plain, rtol=1e-5, atol=1e-9)


def test_no_knee_no_noise(make_observation, simulate):
    observation = make_observation(knee="0 Hz")
    assert not simulate(observation, PinkNoise())["pink"].any()
    assert ("PinkNoise", "pink noise", "none: the knee is at 0 Hz") in list(observation.log)


def test_the_fit_is_stated(make_observation, simulate):
    observation = make_observation()
    simulate(observation, PinkNoise())
    stated = {what: text for _, what, text in observation.log}
    law = power_law_filter(1e-3, 1.0, 8)
    expected = (
        f"(f / 1 Hz)^-1 from 0.1 Hz to 50 Hz within {100 * law.error:.2g} %, levelling off below to"
        f" {law.plateau:.2g} times"
    )
    assert stated["power over that of white noise"].startswith(expected)
    rms = 1.7 * np.sqrt(100 * 10 * law.gain * law.variance)  # mK; knee / f_min = 10
    assert float(stated["rms at the detector, median (mK)"]) == pytest.approx(rms, rel=1e-3)


def test_what_cannot_be_fitted_is_refused(make_observation, simulate):
    with pytest.raises(
        InputError, match=r"PinkNoise: minimum_frequency is 1\.2 times the Nyquist frequency"
    ):
        simulate(make_observation(), PinkNoise(minimum_frequency="60 Hz"))
    with pytest.raises(InputError, match="raise poles"):
        simulate(make_observation(), PinkNoise(minimum_frequency="1e-5 Hz", poles=2))
    for bad in (
        {"slope": 3.5},
        {"poles": 1},
        {"shared": 1.5},
        {"knee": "-1 Hz"},
        {"minimum_frequency": "0 Hz"},
        {"reference": "sky"},
    ):
        with pytest.raises(ZondaError):
            PinkNoise(**bad)
