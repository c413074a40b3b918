"""Angles of detectors on the sky against the textbook's vectors, and meridians against each
other.
"""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zonda.core.numerics.projection import directions
from zonda.core.numerics.quaternions import detector_quaternions, multiply, rotate
from zonda.core.polarization import PolarizationAngles, between_meridians, turned_by
from zonda.plugins.checks.scenes import scan

NORTH = np.array([0.0, 0.0, 1.0])


def an_observation(plate=False):
    o = scan(7, 600, radius=40.0)
    rng = np.random.default_rng(3)
    o.focalplane.polarization_angle[:] = rng.uniform(-4, 7, 7)
    if plate:
        o.hwp_angle = np.mod(12.6 * o.seconds + 0.3, 2 * np.pi)
    return o


def angles(o, pole=NORTH):
    found = np.empty((2, o.n_detectors, o.n_samples))
    PolarizationAngles.of(o, o.boresight_radec, pole).fill(np.arange(o.n_detectors), 0, *found)
    return found


def psi(o):
    """(n_det, n_samp) by `StokesWeights`'s formula (TOAST 3, ops_stokes_weights.cpp): from the
    meridian's south towards east.
    """
    plane, found = o.focalplane, []
    for q in detector_quaternions(plane.xi, plane.eta, plane.polarization_angle):
        whole = multiply(o.boresight_radec, np.broadcast_to(q, (o.n_samples, 4)))
        d, axis = (rotate(whole, np.array(v)).T for v in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
        y = axis[0] * d[1] - axis[1] * d[0]
        x = -axis[0] * d[2] * d[0] - axis[1] * d[2] * d[1] + axis[2] * (d[0] ** 2 + d[1] ** 2)
        found.append(np.arctan2(y, x))
    return np.array(found)


def test_angles_are_toasts():
    o = an_observation()
    cosine, sine = angles(o)
    np.testing.assert_allclose(
        cosine, np.cos(2 * psi(o)), rtol=0, atol=1e-14
    )  # rounding of a few products
    np.testing.assert_allclose(sine, np.sin(2 * psi(o)), rtol=0, atol=1e-14)


def test_a_half_wave_plate_turns_by_four_times_its_angle():
    o = an_observation(plate=True)
    whole = 2 * psi(o) + 4 * (o.hwp_angle - o.focalplane.polarization_angle[:, None])
    np.testing.assert_allclose(angles(o), [np.cos(whole), np.sin(whole)], rtol=0, atol=4e-14)


def test_an_axis_to_the_south_sees_q_and_one_to_the_south_east_u():
    """COSMO: from south to east. On the meridian the focal plane of an upright boresight has +X
    towards the south.
    """
    o = scan(1, 1, radius=0.0)
    for angle, expected in ((0.0, (1, 0)), (np.pi / 4, (0, 1)), (np.pi / 2, (-1, 0))):
        o.focalplane.polarization_angle[:] = angle
        np.testing.assert_allclose(angles(o)[:, 0, 0], expected, atol=1e-15)


@pytest.mark.parametrize("cuts", [[0, 600], [0, 1, 130, 513, 600]])
def test_bits_depend_neither_on_blocks_nor_on_which_detectors(cuts):
    o = an_observation(plate=True)
    whole, of = angles(o), PolarizationAngles.of(o, o.boresight_radec, NORTH)
    for d in ([0, 1, 2], [3], [4, 5, 6]):
        for start, stop in pairwise(cuts):
            part = np.empty((2, len(d), stop - start))
            of.fill(np.array(d), start, *part)
            np.testing.assert_array_equal(part, whole[:, d, start:stop])


directions_of = st.tuples(st.floats(-1, 1), st.floats(-3.1, 3.1)).map(
    lambda v: np.array(
        [np.sqrt(1 - v[0] ** 2) * np.cos(v[1]), np.sqrt(1 - v[0] ** 2) * np.sin(v[1]), v[0]]
    )
)


@settings(deadline=None)
@given(directions_of, directions_of)
def test_turned_q_and_u_are_seen_the_same(pole, other):
    """Q cos 2 psi + U sin 2 psi is the same for meridians through any pole."""
    o = an_observation()
    d = directions(o.boresight_radec, o.focalplane.xi, o.focalplane.eta)
    far = (abs(d @ pole) < 0.999).all() and (abs(d @ other) < 0.999).all()
    q_and_u = np.stack([np.full(d.shape[:2], 0.3), np.full(d.shape[:2], -0.7)])
    new = turned_by(q_and_u, between_meridians(d, pole, other))
    assert np.isfinite(new).all()
    np.testing.assert_allclose(np.hypot(*new), np.hypot(0.3, 0.7), rtol=1e-12)
    if far:  # rounding of an angle grows as 1 / sin of the distance from the pole
        before, after = (values * angles(o, p) for values, p in ((q_and_u, pole), (new, other)))
        np.testing.assert_allclose(after.sum(axis=0), before.sum(axis=0), rtol=0, atol=1e-11)
