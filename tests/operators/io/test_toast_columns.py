"""Columns of TOAST's table of detectors."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable

from zonda.operators.io.toast_hdf5 import columns_of


@pytest.mark.parametrize(
    ("columns", "efficiency"),
    [
        ({}, None),
        ({"gamma": [0.0, 1.0] * u.rad}, 1.0),
        ({"gamma": [0.0, 1.0] * u.rad, "pol_leakage": [0.25, 0.25]}, 0.6),
        ({"gamma": [0.0, 1.0] * u.rad, "polarization_efficiency": [0.0, 0.0]}, 0.0),
    ],
)
def test_polarization_efficiency_is_that_of_toasts_weights(columns, efficiency):
    """(1 - epsilon) / (1 + epsilon), epsilon 0 where a table with angles states none; zonda's own
    column stands above.
    """
    found = columns_of(QTable(columns | {"name": ["a", "b"]}), np.arange(2)).get(
        "polarization_efficiency"
    )
    assert (found is None) == (efficiency is None)
    if efficiency is not None:
        np.testing.assert_allclose(found, efficiency, rtol=1e-15)
