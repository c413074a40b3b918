"""Noise of single streams: Welch's spectra, their median, and the fit of white level, knee and
slope.
"""

import numpy as np
import pytest

from zonda.core.errors import InputError
from zonda.operators.noise.estimate import fit, median_bias, segment_length, spectrum

RATE, N = 100.0, 60000


def made(rng, net, knee, slope):
    """(N,) noise of the one-sided density 2 NET^2 (1 + (knee / f)^slope), cut out of four times as
    much.
    """
    if knee == 0:
        return net * np.sqrt(RATE) * rng.normal(size=N)
    f = np.fft.rfftfreq(4 * N, 1 / RATE)
    density = 2 * net**2 * (1 + (knee / np.maximum(f, 1e-3)) ** slope)
    waves = np.sqrt(density * RATE * N) * (rng.normal(size=f.size) + 1j * rng.normal(size=f.size))
    waves[0] = 0
    return np.fft.irfft(waves, 4 * N)[:N]


def estimate(row, good=None):
    n = len(row)
    return fit(
        *spectrum(
            row,
            np.ones(n, bool) if good is None else good,
            RATE,
            segment_length(n, RATE, None, "here"),
        )
    )


@pytest.mark.parametrize(
    ("knee", "slope", "n"), [(0.5, 1.0, N), (0.5, 1.0, N // 5), (2.0, 1.5, N), (1.0, 2.0, N)]
)
def test_estimates_lie_within_their_errors(knee, slope, n):
    """Pulls have no bias and the standard deviation 1.

    Medians of neighbours are correlated less than their powers; without what Hann's window mixes,
    and with shorter segments, the knee of scans of two minutes was 0.62 Hz for 0.5.
    """
    rng = np.random.default_rng(2)
    found = [estimate(made(rng, 1e-3, knee, slope)[:n]) for _ in range(100)]
    found = [noise for noise in found if noise.knee > 0]
    assert len(found) > 95
    for name, truth in (("net", 1e-3), ("knee", knee), ("slope", slope)):
        pulls = np.array([(getattr(n, name) - truth) / getattr(n, f"{name}_error") for n in found])
        # of 100 pulls of standard deviation 1: the mean to 0.1, the standard deviation to 0.07;
        # four times that
        assert abs(pulls.mean()) < 0.4, name
        assert 0.72 < pulls.std() < 1.28, name
        middle = np.median([getattr(n, name) for n in found])
        assert abs(middle - truth) < 0.4 * np.median(
            [getattr(n, f"{name}_error") for n in found]
        ), name
    # of 100 fits of some 25 degrees of freedom to 0.03; ln P of few segments is not quite normal
    assert np.mean([n.chi_square for n in found]) == pytest.approx(1, abs=0.12)


def test_the_error_of_a_white_level():
    rng = np.random.default_rng(8)
    nets = [
        (n.net, n.net_error)
        for n in (estimate(made(rng, 1e-3, 0.0, 1.0)) for _ in range(150))
        if n.knee == 0
    ]
    levels, errors = np.array(nets).T
    assert levels.std() == pytest.approx(
        np.median(errors), rel=0.25
    )  # a standard deviation of some 140 to 6 %; four times that


def test_white_noise_has_no_knee():
    rng = np.random.default_rng(3)
    found = [estimate(made(rng, 1e-3, 0.0, 1.0)) for _ in range(40)]
    assert (
        sum(n.knee == 0 for n in found) >= 34
    )  # at most one of twenty by chance, to three standard deviations
    net = np.array([n.net for n in found])
    assert abs(net.mean() - 1e-3) < 5 * net.std() / np.sqrt(40)


def test_glitches_and_flags_do_not_matter():
    rng = np.random.default_rng(4)
    row, clean = made(rng, 1e-3, 0.0, 1.0), made(np.random.default_rng(4), 1e-3, 0.0, 1.0)
    row[[10_000, 31_000]] += 1.0  # a thousand times the NET, in 4 of 57 segments
    robust, truth = estimate(row), estimate(clean)
    assert abs(robust.net - truth.net) < 3 * truth.net_error
    good = np.ones(N, bool)
    good[20_000:20_500] = False
    row = clean.copy()
    row[20_000:20_500] = np.nan
    part = estimate(row, good)
    assert part.segments < truth.segments
    assert abs(part.net - truth.net) < 3 * truth.net_error
    assert estimate(np.where(np.arange(N) % 1000 == 0, np.nan, clean)) is None
    assert estimate(np.zeros(N)) is None


def test_the_median_of_few_deviates():
    assert median_bias(1) == 1
    rng = np.random.default_rng(5)
    for k in (3, 9):
        medians = np.median(rng.exponential(size=(100_000, k)), axis=1)
        assert abs(medians.mean() - median_bias(k)) < 5 * medians.std() / np.sqrt(100_000)


def test_short_scans_are_refused():
    with pytest.raises(InputError, match="make no 8 segments"):
        segment_length(200, RATE, None, "here")
    with pytest.raises(InputError, match="make no 8 segments"):
        segment_length(N, RATE, 300.0, "here")
    assert segment_length(N, RATE, 20.0, "here") == 2000


def test_few_segments_bias_the_white_level_little():
    """Of 11 segments to 2 %: without sigma^2 / 2 of the logarithm by -2.8 %; 250 scans know it to
    0.3 %.
    """
    rng, length = np.random.default_rng(3), 64
    rows = rng.normal(size=(250, 6 * length)) * 10  # NET 1 K s(1/2) at 100 Hz
    found = [fit(*spectrum(row, np.ones(row.size, bool), 100.0, length)) for row in rows]
    nets = [noise.net for noise in found if noise is not None and noise.knee == 0]
    assert len(nets) > 240
    assert abs(np.mean(nets) - 1) < 0.02
