"""Quaternions of boresights, and directions on the sphere."""

import math

import numpy as np
import pytest

from zonda.core.numerics.projection import rotation_matrices
from zonda.core.numerics.quaternions import (
    Upright,
    conjugate,
    from_angles,
    multiply,
    rotate,
    shortest_rotation,
)
from zonda.core.numerics.sphere import angle_between, angles, local_axes, unit_vectors


@pytest.fixture
def rotations() -> np.ndarray:
    q = np.random.default_rng(1).standard_normal((50, 4))
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def test_algebra_is_that_of_matrices(rotations: np.ndarray) -> None:
    a, b = rotations[:25], rotations[25:]
    np.testing.assert_allclose(
        rotation_matrices(multiply(a, b)), rotation_matrices(a) @ rotation_matrices(b), atol=1e-14
    )
    np.testing.assert_allclose(
        rotation_matrices(conjugate(a)), np.moveaxis(rotation_matrices(a), 1, 2), atol=1e-14
    )
    vector = unit_vectors(1.0, 0.4)
    np.testing.assert_allclose(rotate(a, vector), rotation_matrices(a) @ vector, atol=1e-14)


def test_shortest_rotation_is_along_the_great_circle() -> None:
    a, b = unit_vectors(np.linspace(0, 3, 20), 0.3), unit_vectors(np.linspace(0.1, 2, 20), -0.5)
    q = shortest_rotation(a, b)
    np.testing.assert_allclose(rotate(q, a), b, atol=1e-15)
    np.testing.assert_allclose(2 * np.arccos(q[:, 3]), np.arccos(np.sum(a * b, axis=1)), atol=1e-14)


def test_directions_there_and_back() -> None:
    longitude, latitude = np.linspace(-3, 3, 30), np.linspace(-1.5, 1.5, 30)
    found = angles(unit_vectors(longitude, latitude))
    np.testing.assert_allclose(found, [longitude, latitude], atol=1e-14)
    np.testing.assert_allclose(
        angle_between(unit_vectors(longitude, 0.0), unit_vectors(0.0, 0.0)),
        abs(longitude),
        atol=1e-7,
    )


def test_local_axes_are_the_derivatives() -> None:
    towards, east, north = local_axes(0.7, 0.4)
    h = 1e-6
    np.testing.assert_allclose(towards, unit_vectors(0.7, 0.4), atol=1e-15)
    np.testing.assert_allclose(
        east, (unit_vectors(0.7 + h, 0.4) - towards) / h / math.cos(0.4), atol=2e-6
    )
    np.testing.assert_allclose(north, (unit_vectors(0.7, 0.4 + h) - towards) / h, atol=2e-6)


@pytest.mark.parametrize("sweep", [0.1, 2.0, 2.7, 3.2, 40.0])
@pytest.mark.parametrize("start", [0.0, 1.0, math.pi - 1e-9, -math.pi, 3.0])
def test_upright_is_from_angles(sweep: float, start: float) -> None:
    """Within 150 deg of the first direction by half angles, else by angles; through south, round
    the sky, up to the zenith.
    """
    way = np.linspace(0, 1, 4001)
    longitude, latitude = start + sweep * way, 1.57 * np.sin(7 * way)
    found = Upright()(unit_vectors(longitude, latitude))
    expected = from_angles(longitude, latitude)
    expected *= np.sign(
        (found[0] * expected[0]).sum()
    )  # the first longitude is counted from -pi to pi
    assert (
        np.abs(found - expected).max() < 3e-13
    )  # near the zenith a direction's rounding turns it: 1e-16 / cos(1.57)
    assert np.linalg.norm(np.diff(found, axis=0), axis=1).max() < 0.1
    assert np.abs(np.linalg.norm(found, axis=1) - 1).max() < 1e-15


@pytest.mark.parametrize("sweep", [0.1, 2.7, 3.2, 40.0, -40.0])
def test_upright_goes_on_from_chunk_to_chunk(sweep: float) -> None:
    """There and back again: signs are those of the whole, whichever way a chunk is worked out."""
    longitude = 1.0 + sweep * np.sin(np.linspace(0, 3, 5001)) ** 2
    directions = unit_vectors(longitude, 0.9 * np.cos(7 * longitude))
    upright = Upright()
    found = np.concatenate([upright(part) for part in np.array_split(directions, 23)])
    assert (
        np.abs(found - from_angles(longitude, 0.9 * np.cos(7 * longitude))).max() < 2e-14
    )  # of angles of 40 rad
    assert sweep > 0.1 or sweep < 0 or np.array_equal(found, Upright()(directions))


def test_upright_where_there_is_no_longitude() -> None:
    found = Upright()(np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.0, -1.0]]))
    assert np.isfinite(found).all()
    assert (
        np.abs(rotation_matrices(found)[:, :, 2] - [[0, 0, 1], [0.6, 0, 0.8], [0, 0, -1]]).max()
        < 1e-15
    )
    assert Upright()(np.empty((0, 3))).shape == (0, 4)
