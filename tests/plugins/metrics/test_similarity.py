"""The Anderson-Darling test between halves of a stream."""

import numpy as np
import pytest

from zonda.core.errors import InputError
from zonda.plugins.metrics.streams import AndersonDarling, p_value

RATE = 100.0


def test_white_noise_passes_as_often_as_it_should():
    draws = np.random.default_rng(1).standard_normal((200, 2000))
    found = np.array([p_value(draw, RATE, None, 1) for draw in draws])
    # under the null p is uniform: below 0.05 in 5 % of 200 draws, 10 +- 3.1; within 3 sigma. Above
    # the table's end, 0.25, in 75 %
    assert abs(np.count_nonzero(found < 0.05) - 10) <= 10
    assert abs(np.count_nonzero(found >= 0.25) - 150) <= 3 * 6.2


def test_red_noise_fails_until_it_is_filtered_and_thinned():
    rng = np.random.default_rng(2)
    raw, filtered = [], []
    for _ in range(8):
        walk = np.cumsum(rng.standard_normal(12000)) + rng.standard_normal(12000)
        raw.append(p_value(walk, RATE, None, 1))
        filtered.append(p_value(walk, RATE, 2.0, 50))
    assert np.median(raw) <= 0.001
    assert np.median(filtered) > 0.05


def test_halves_of_different_laws_fail():
    rng = np.random.default_rng(3)
    assert (
        p_value(np.concatenate([rng.normal(0, 1, 3000), rng.normal(0, 1.3, 3000)]), RATE, None, 1)
        <= 0.001
    )


@pytest.mark.parametrize("stream", [np.zeros(1000), np.arange(12.0)])
def test_what_cannot_be_tested(stream):
    with pytest.raises(InputError, match="halves of the stream"):
        p_value(stream, RATE, None, 1)


def test_a_run_without_streams():
    import zonda

    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d"
    )
    with pytest.raises(InputError, match="there is no product of streams"):
        AndersonDarling().find(zonda.Data(scene), [])
