"""Halves of a map by detectors, time and direction: what is left of what, and sums that add up
whatever is combined.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from astropy.io import fits

from zonda.core.errors import ZondaError
from zonda.core.maps.map_file import write_map
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.maps.map_sums import MapSums
from zonda.operators.maps.parameters import DIFFERENCES, halves_of
from zonda.testing import check_operator

N_DET, N = 37, 12000
SPLITS = ["detectors", "halves", "directions", "radii"]


def noise(observation, seed=2):
    rms = observation.focalplane.net[:, None] * math.sqrt(observation.sample_rate)
    return rms * np.random.default_rng(seed).standard_normal(
        (observation.n_detectors, observation.n_samples)
    )


@pytest.mark.parametrize("split", ["scans", *SPLITS])
def test_halves_are_all_samples_once(bench, split):
    observation = bench.observation(N_DET, 900)
    seen = sum(np.outer(d, s).astype(int) for d, s in halves_of(split, observation))
    np.testing.assert_array_equal(seen, 1)


@pytest.mark.parametrize("split", SPLITS)
def test_the_map_itself_keeps_its_bits(bench, split):
    """Sums are integers: those of two halves are those of all. What is dropped is counted once."""
    maps = {}
    for choice in (True, split):
        many = [bench.observation(N_DET, 3000, index=i) for i in range(3)]
        many[1].flags[100:200] = 1
        many[2].detector_flags[4] = 1
        x = {o.name: noise(o, o.index) for o in many}
        x["scan0"][3, 50] = np.nan
        steps = [BinMap(pixel="6 arcsec", half_difference=choice, width="1.5 arcmin")]
        maps[choice] = bench.run(steps, many, {"signal": lambda o, x=x: x[o.name]})
    for plane in ("signal", "hits", "weights", "noise"):
        np.testing.assert_array_equal(
            getattr(maps[split].map, plane), getattr(maps[True].map, plane)
        )
    said = {key: value for key, value in maps[split].log.items() if "samples" in key[1]}
    assert said == {key: value for key, value in maps[True].log.items() if "samples" in key[1]}
    assert maps[split].log["BinMap", "half-difference of"] == DIFFERENCES[split]


@pytest.mark.parametrize("split", SPLITS)
def test_of_one_scan_its_variance_is_that_of_the_map(bench, split):
    """The variance of (m_1 - m_2) sqrt(w_1 w_2) / (w_1 + w_2) is 1 / (w_1 + w_2): four standard
    errors of n unit normals.
    """
    observation = bench.observation(N_DET, N)
    t = np.arange(N) / observation.sample_rate
    observation.boresight_azel = bench.quaternions(
        -1.0 - 3e-4 * np.sin(2 * np.pi * t / 9.1), 0.9, 0.0
    )
    product = bench.run(
        [BinMap(pixel="6 arcsec", half_difference=split)],
        observation,
        {"signal": noise(observation)},
    ).map
    use = np.isfinite(product.half_difference) & (product.hits > 30)
    n = int(use.sum())
    assert n > 300
    assert abs((product.half_difference / product.noise)[use].var() - 1) < 4 * math.sqrt(2 / n)
    assert product.difference == DIFFERENCES[split]


def test_each_shows_what_differs_between_its_halves(bench):
    """A level of the odd detectors, of the second halves, of falling azimuth: each is in one
    difference and in no other.
    """
    observation = bench.observation(N_DET, N)
    t = np.arange(N) / observation.sample_rate
    lon = -1.0 - 3e-4 * np.sin(2 * np.pi * t / 9.1)
    observation.boresight_azel = bench.quaternions(lon, 0.9, 0.0)
    rising = np.gradient(np.unwrap(observation.azimuth)) > 0
    assert 0.4 < rising.mean() < 0.6
    radius = np.hypot(observation.focalplane.xi, observation.focalplane.eta)
    inner = halves_of("radii", observation)[0][0]
    assert inner.sum() == 19
    assert radius[inner].max() <= radius[~inner].min()
    levels = {
        "detectors": np.outer(np.arange(N_DET) % 2 == 0, np.ones(N)),
        "halves": np.outer(np.ones(N_DET), np.arange(N) < N / 2),
        "directions": np.outer(np.ones(N_DET), rising),
        "radii": np.outer(inner, np.ones(N)),
    }
    for level, x in levels.items():
        for split in SPLITS:
            again = bench.observation(N_DET, N)
            again.boresight_azel = observation.boresight_azel
            product = bench.run(
                [BinMap(pixel="12 arcsec", half_difference=split)], again, {"signal": x - 0.5}
            ).map
            half, w = product.half_difference, product.hits > 200
            use = w & np.isfinite(half)
            assert use.sum() > 50
            if level == split:  # m_1 - m_2 = 1: sqrt(w_1 w_2) / (w_1 + w_2) is at most a half
                assert half[use].max() == pytest.approx(0.5, abs=0.01)
                assert half[use].min() > 0
            else:  # of either sign, as pixels happen to be seen
                assert abs(half[use].mean()) < 0.15


@pytest.mark.parametrize("split", SPLITS)
def test_sums_of_parts_are_those_of_all(bench, split):
    """An odd number of scans before does not exchange the halves; sums survive being written."""
    kept = []

    class Kept(BinMap):
        """Keeps its sums."""

        def finalize(self, data):
            kept.append(data.partial[self.label])
            super().finalize(data)

    def sums(indices):
        many = [bench.observation(N_DET, 2000, index=i) for i in indices]
        step = Kept(
            pixel="6 arcsec", half_difference=split, width="3 arcmin", centre="icrs 75 deg 20 deg"
        )
        bench.run([step], many, {"signal": lambda o: noise(o, o.index)})
        return MapSums.of(kept.pop().arrays())

    merged = sums([0])
    merged += sums([1, 2])
    whole = sums([0, 1, 2])
    np.testing.assert_array_equal(merged.sums, whole.sums)
    assert not merged.of_scans


def test_the_file_says_what_was_subtracted(bench, tmp_path):
    product = bench.run(
        [BinMap(pixel="6 arcsec", half_difference="halves")],
        bench.observation(N_DET, 3000),
        {"signal": np.ones((N_DET, 3000))},
    ).map
    with fits.open(write_map(product, tmp_path / "map.fits", False)) as file:
        assert file["HALF_DIFFERENCE"].header["JACKKNIF"] == "first - second half of each scan"
        assert "JACKKNIF" not in file[0].header


@pytest.mark.parametrize("noise", ["net", "scatter"])
def test_contract(noise):
    check_operator(BinMap(pixel="6 arcsec", half_difference="detectors", noise=noise))


def test_a_choice_that_is_nearly_right_is_suggested():
    with pytest.raises(ZondaError, match="did you mean 'detectors'"):
        BinMap(pixel="6 arcsec", half_difference="detector")
