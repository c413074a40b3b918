"""The half-difference of the scans is noise alone, with the variance of the map's own noise,
however unequal the halves are.
"""

import math

import numpy as np
import pytest

from zonda.operators.maps.bin_map import BinMap

N_DET = 37


@pytest.mark.parametrize(
    "lengths", [(30000, 6000), (9000, 9000, 9000), (20000, 4000, 12000, 4000, 20000)]
)
@pytest.mark.parametrize("scattered", [False, True])
def test_its_variance_is_that_of_the_map(bench, lengths, scattered):
    """m_e and m_o have variances 1 / w_e and 1 / w_o: sqrt(w_e w_o) / (w_e + w_o) of their
    difference has 1 / (w_e + w_o).
    """
    many = [bench.observation(N_DET, n, index=i) for i, n in enumerate(lengths)]
    rng = np.random.default_rng(2)
    drawn = {}
    for o in many:
        if scattered:
            o.focalplane.net = o.focalplane.net * np.linspace(0.5, 2.0, N_DET)
        drawn[o.name] = (
            o.focalplane.net[:, None]
            * math.sqrt(o.sample_rate)
            * rng.standard_normal((N_DET, o.n_samples))
        )
    product = bench.run([BinMap(pixel="6 arcsec")], many, {"signal": lambda o: drawn[o.name]}).map
    assert product.scans == [o.name for o in many]
    use = np.isfinite(product.half_difference) & (product.hits > 30)
    n = int(use.sum())
    assert n > 500
    half, whole = ((p / product.noise)[use] for p in (product.half_difference, product.signal))
    error = math.sqrt(2 / n)  # of the variance of n independent unit normals
    assert abs(half.var() - 1) < 4 * error
    assert abs(whole.var() - 1) < 4 * error
    # m_e - m_o and w_e m_e + w_o m_o are uncorrelated: the noise map is another realization, not a
    # copy
    assert abs(np.corrcoef(half, whole)[0, 1]) < 5 / math.sqrt(n)


def test_the_sky_is_gone_whatever_the_weights(bench):
    """The same pointing in a long and a short scan: no sky is left, though one half has five times
    the samples.
    """
    long, short = bench.observation(N_DET, 30000, index=0), bench.observation(N_DET, 6000, index=0)
    short.index, short.name = 1, "scan1"
    product = bench.run(
        [BinMap(pixel="6 arcsec")],
        [long, short],
        {"signal": lambda o: np.full((N_DET, o.n_samples), 0.25)},
    ).map
    both = np.isfinite(product.half_difference)
    assert both.sum() > 500
    assert np.abs(product.half_difference[both]).max() < 1e-10  # fixed-point steps of 1.5e-11 K
    np.testing.assert_allclose(product.signal[both], 0.25, rtol=0, atol=1e-10)


def test_pixels_of_one_half_alone_have_none(bench):
    """Where only even or only odd scans looked there is no difference to take."""
    here = bench.observation(N_DET, 4000, index=0)
    there = bench.observation(
        N_DET, 4000, index=1, centre=(bench.CENTRE[0], bench.CENTRE[1] + 400 * bench.ARCSEC)
    )
    product = bench.run(
        [BinMap(pixel="6 arcsec")],
        [here, there],
        {"signal": lambda o: np.ones((N_DET, o.n_samples))},
    ).map
    first = bench.run(
        [BinMap(pixel="6 arcsec")], [here], {"signal": lambda o: np.ones((N_DET, o.n_samples))}
    ).map
    assert product.hits.sum() == 2 * N_DET * 4000
    assert np.isfinite(product.half_difference).sum() < 0.8 * (product.hits > 0).sum()
    assert first.half_difference is None
