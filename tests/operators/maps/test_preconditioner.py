"""Smooth patterns of the preconditioner against dense linear algebra, and iterations with them."""

from dataclasses import replace

import healpy
import numpy as np
import pytest

from zonda.operators.maps.baseline_noise import BaselineNoise, polynomials
from zonda.operators.maps.compressed_scan import RunsOfTiles, Tile
from zonda.operators.maps.grid import HealpixGrid, TangentGrid
from zonda.operators.maps.normal_equations import NormalEquations, WeighedScan
from zonda.operators.maps.preconditioner import orthonormal
from zonda.operators.maps.shared_modes import leading

SIDE, N_DET, N, LENGTH, RATE = 28, 6, 4000, 8, 40.0
GRID = TangentGrid((0.0, 0.0), 1e-3, (SIDE, SIDE))


def scan(tilt, noise):
    """To and fro at a constant speed, while the field drifts across: few directions."""
    t = np.arange(N)
    along = 2 * np.abs((t / 150) % 2 - 1) - 1
    across = 1.6 * (t / N - 0.5) + 0.04 * (np.arange(N_DET)[:, None] - N_DET / 2)
    x = 13 + 13 * np.clip(along * np.cos(tilt) - across * np.sin(tilt), -1, 1)
    y = 13 + 13 * np.clip(along * np.sin(tilt) + across * np.cos(tilt), -1, 1)
    pixel = (np.rint(y) * SIDE + np.rint(x)).astype(np.int32)
    nothing = np.zeros((N_DET, 0))
    found = RunsOfTiles(N_DET, N, LENGTH)
    tile = Tile.of(np.zeros(pixel.shape), pixel, 0, LENGTH, False, np.zeros((0, 2), int))
    found.add(np.arange(N_DET), tile)

    def find(some):
        return pixel[some], nothing[some], nothing[some]

    return WeighedScan(found.scan(RATE, GRID.n_pixels, find), noise)


def survey(places=GRID.places):
    """Two scans that cross at 50 deg, with slow noise and a free mode that is not quite uniform."""
    n_base = N // LENGTH
    f = np.maximum(np.arange(n_base // 2 + 1), 0.5)
    rows = 1 + 0.1 * np.random.default_rng(1).normal(size=(N_DET, 30))
    modes = leading(rows, 2, np.zeros((0, N_DET)))
    own, edges = 1 + 3e3 / f**1.5, np.arange(len(f) + 1)
    shared = np.stack([1e7 / f**3, 1e5 / f**2], axis=1)
    lines, white, values = polynomials(n_base, 1), np.ones(N_DET), np.ones(2)
    noise = BaselineNoise(
        white, LENGTH, lines, modes, 1, values, f, edges, own, shared, own, white, own
    )
    return NormalEquations([scan(0.44, noise), scan(-0.44, noise)], 1, GRID.n_pixels, 1, places)


def dense(system):
    """A (n, n) of the pixels with samples, and these."""
    seen = np.flatnonzero(system.weights[0] > 0)
    unit = np.zeros((1, GRID.n_pixels))
    columns = []
    for p in seen:
        unit[0, p] = 1
        columns.append(system.apply(unit)[0][seen])
        unit[0, p] = 0
    matrix = np.array(columns)
    return (matrix + matrix.T) / 2, seen


def test_few_iterations_make_the_map_of_least_squares():
    plain, two = survey(None), survey()
    matrix, seen = dense(plain)
    y, x = np.divmod(np.arange(GRID.n_pixels), SIDE)
    sky = np.zeros((1, GRID.n_pixels))
    noise = 0.1 * np.random.default_rng(2).normal(size=seen.size)
    sky[0, seen] = (np.sin(x / 9) + np.cos(y / 7 + x / 12))[seen] + noise
    right = plain.apply(sky)
    one, other = plain.solve(right, 1e-6, 500), two.solve(right, 1e-6, 500)
    best = np.linalg.lstsq(matrix, right[0, seen], rcond=1e-9)[0]
    errors = []
    for found in (one, other):
        error = found.values[0, seen] - best
        errors.append((error - error.mean()).std() / best.std())
    assert one.smooth is None
    assert other.smooth is not None
    # behind those before patterns were added, 26 iterations instead of 83
    begin = other.before
    assert len(other.history) - begin < (len(one.history) - begin) / 2
    assert errors[1] < 1e-5
    assert errors[1] < errors[0]
    # the smallest Ritz values of W^-1 A, but for the mean, are those of smooth patterns
    root = np.sqrt(plain.weights[0][seen])
    low = np.linalg.eigvalsh(matrix / np.outer(root, root))
    determined = low[low > 1e-8]
    assert determined[0] <= other.ritz[0] < 1.5 * determined[0]


def test_bits_do_not_depend_on_threads():
    sky = np.random.default_rng(7).normal(size=(1, GRID.n_pixels))
    found = []
    for threads in (1, 2):
        system = replace(survey(), threads=threads)
        found.append(system.solve(system.apply(sky), 1e-7, 500))
    one, two = found
    assert one.smooth is not None
    np.testing.assert_array_equal(one.values, two.values)
    assert one.history == two.history


def test_an_easy_map_needs_no_patterns():
    system = survey()
    sky = np.random.default_rng(3).normal(size=(1, GRID.n_pixels)) * (system.weights > 0)
    found = system.solve(system.apply(sky), 0.05, 500)
    assert found.smooth is None
    assert found.before == 0


def test_the_second_term_is_the_dense_one():
    system = survey()
    matrix, seen = dense(system)
    smooth = system.smooth
    rng, n = np.random.default_rng(4), GRID.n_pixels
    z = np.array([smooth.pattern(row, n)[seen] for row in smooth.rows])
    # the combinations that E is 1 of; products of some 700 pixels, and of E's condition, 1e4
    np.testing.assert_allclose(z @ matrix @ z.T, np.eye(len(z)), atol=1e-9)
    # a free mode and a line of each detector take the mean: 28 patterns without it
    assert len(z) == 27
    r = np.zeros(n)
    r[seen] = rng.normal(size=seen.size)
    made = smooth.correct(r)
    expected = z.T @ (z @ r[seen])
    np.testing.assert_allclose(made[seen], expected, atol=1e-10 * np.abs(expected).max())
    assert not made[system.weights[0] == 0].any()


def test_dependent_rows_are_left_out():
    rows = np.random.default_rng(5).normal(size=(4, 9))
    rows = np.concatenate([rows[:2], rows[:1] + rows[1:2], rows[2:]])
    gram = rows @ rows.T
    found = orthonormal(gram, 1e-8 * np.diag(gram))
    assert found.shape == (4, 5)
    np.testing.assert_allclose(found @ gram @ found.T, np.eye(4), atol=1e-12)


@pytest.mark.parametrize(("lon", "lat"), [(0.0, 20.0), (130.0, 89.0), (250.0, -50.0)])
def test_places_of_healpix_pixels_are_angles(lon, lat):
    """Distances on the plane are those on the sphere, at longitude 0 and at poles too."""
    middle = healpy.ang2vec(lon, lat, lonlat=True)
    pixels = np.sort(healpy.query_disc(64, middle, np.radians(8)))
    grid = HealpixGrid(64, False, pixels)
    at = grid.places(np.arange(len(pixels)))
    vectors = np.array(healpy.pix2vec(64, pixels))
    rng = np.random.default_rng(6)
    a, b = rng.integers(0, len(pixels), (2, 200))
    angle = 2 * np.arcsin(np.linalg.norm(vectors[:, a] - vectors[:, b], axis=0) / 2)
    # parallels shrink by 1 - cos 8 deg at the rim
    np.testing.assert_allclose(np.hypot(*(at[:, a] - at[:, b])), angle, rtol=0.011, atol=1e-12)
