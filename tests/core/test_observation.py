"""Observations: a scan at some of its samples."""

import dataclasses

import numpy as np
from astropy.coordinates import SkyCoord

import zonda
from zonda.core.observation import KeptStreams
from zonda.plugins.checks.scenes import scan


def test_a_thinned_scan_has_every_array_of_samples_at_these_alone() -> None:
    whole = scan(3, samples=100)
    n = whole.n_samples
    whole.hwp_angle, whole.recorded_azimuth = np.linspace(0, 1, n), np.linspace(2, 3, n)
    whole.pointed_radec = whole.boresight_radec + 1e-6
    for at in (slice(10, 30), np.arange(0, n, 7)):
        thin = whole.thinned(at)
        assert thin.n_samples == len(np.arange(n)[at])
        for field in dataclasses.fields(whole):
            one = getattr(whole, field.name)
            if isinstance(one, np.ndarray) and len(one) == n:
                np.testing.assert_array_equal(getattr(thin, field.name), one[at])
        np.testing.assert_array_equal(thin.sky_boresight, whole.sky_boresight[at])


def test_positions_of_detectors_are_those_that_a_map_counts() -> None:
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d"
    )
    steps = [
        zonda.PointingDaisy(scan_duration="5 s", radius="4 arcmin"),
        zonda.BinMap(contents="hits", pixel="10 arcsec"),
    ]
    data = zonda.Pipeline(steps).run(scene)
    product = data["map"]
    ra, dec = data.observations[0].detector_positions()
    assert ra.shape == (data.observations[0].n_detectors, data.observations[0].n_samples)
    x, y = product.wcs.world_to_pixel(SkyCoord(ra.ravel(), dec.ravel(), unit="rad"))
    hits = np.zeros_like(product.hits)
    np.add.at(hits, (np.rint(y).astype(int), np.rint(x).astype(int)), 1)
    # a sample within rounding of an edge of a pixel may be counted on its other side
    assert np.abs(hits - product.hits).sum() <= 4
    assert product.hits.sum() == ra.size


def test_an_array_that_a_step_keeps_is_that_array():
    """Not a copy, which would lose what is written into it; also where several threads ask."""
    from concurrent.futures import ThreadPoolExecutor

    kept = KeptStreams({"sky": (np.ones((2, 3), np.float32), None)})
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: kept.setdefault("mine", np.zeros((2, 3))), range(200)))
    assert all(array is made[0] for array in made)
    kept["mine"][0] += 1
    assert kept["mine"][0].tolist() == [1, 1, 1]
    assert kept["sky"].dtype == np.float64
    assert sorted(kept) == ["mine", "sky"]
    assert len(kept) == 2
    del kept["mine"]
    assert "mine" not in kept
