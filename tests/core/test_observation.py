"""Observations: a scan at some of its samples."""

import dataclasses

import numpy as np

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
