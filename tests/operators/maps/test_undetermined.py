"""Patterns that the data hardly determine, where they are known."""

import numpy as np
import pytest

import zonda
from zonda.operators.maps.baseline_noise import BaselineNoise, polynomials
from zonda.operators.maps.normal_equations import NormalEquations, WeighedScan
from zonda.operators.maps.undetermined import undetermined
from zonda.plugins.checks.scenes import run

from .test_maximum_likelihood import SIGMA, drifts, observation
from .test_normal_equations import N_DET, N_PIX, compressed, noise_of, pointing


def system(pixel, free, degree):
    """Normal equations of detectors whose polynomials are taken off."""
    noise = noise_of(np.random.default_rng(2).uniform(0.5, 2, N_DET), free, modes=free + 1)
    _, scan = compressed(np.zeros(pixel.shape), pixel)
    noise = BaselineNoise(**{**vars(noise), "lines": polynomials(scan.shape[1], degree)})
    places = lambda pixels: np.array([pixels, 0 * pixels], float)  # noqa: E731
    return NormalEquations([WeighedScan(scan, noise)], 1, N_PIX, places=places)


@pytest.mark.parametrize("free", [0, 1])
def test_they_are_the_lowest_eigenvectors(free):
    equations = system(pointing(np.random.default_rng(1), flagged=False), free, 1)
    found = undetermined(equations, 4)
    seen = equations.weights[0] > 0
    root = np.sqrt(equations.weights[0][seen])
    matrix = np.array([equations.apply(one[None])[0][seen] for one in np.eye(N_PIX)[seen]])
    values, vectors = np.linalg.eigh(matrix / root / root[:, None])
    # a residual of 1e-3 of a value, squared, shifts it by no more than that over the gap
    np.testing.assert_allclose(found.values, np.maximum(values[:4], 0), rtol=0.02, atol=1e-12)
    for k, pattern in enumerate(found.maps[:2, 0, seen] * root):
        overlap = abs(pattern @ vectors[:, k]) / np.sqrt((pattern**2).sum())
        assert overlap == pytest.approx(1, abs=0.01)
    assert np.abs(found.maps).max(axis=(1, 2)) == pytest.approx(1)


def test_patches_that_no_detector_connects():
    """Offsets of detectors take the mean of each patch: two patterns, that and no other."""
    t = np.arange(144)
    one = np.rint(9 + 9 * np.sin(t / 5.9) * np.cos(t / 16)).astype(np.int32)
    pixel = np.stack([one, one, one + 20, one + 20, one + 20])
    equations = system(pixel, 0, 0)
    equations.scans[0].noise.shared[:] = 0.0  # a mode would be shared by both
    found = undetermined(equations, 3)
    assert (found.values[:2] < 1e-8).all()
    assert found.values[2] > 0.05
    seen = equations.weights[0] > 0
    for pattern in found.maps[:2, 0]:
        for patch in (slice(0, 20), slice(20, 40)):
            assert np.ptp(pattern[patch][seen[patch]]) < 1e-3
    assert np.linalg.matrix_rank(found.maps[:2, 0][:, [5, 25]]) == 2


def test_a_free_mode_and_offsets_take_mean_and_plane(tmp_path):
    o, rng = observation(), np.random.default_rng(1)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(37, o.n_samples))
    maker = zonda.MaximumLikelihoodMap(pixel="15 arcsec", half_difference=False, patterns=4)
    found = run([maker], o, noise).products["map"]
    known = found.known
    basis = (
        np.array([np.ones(known.sum()), *np.nonzero(known)], float) * found.weights[known] ** 0.5
    )
    q = np.linalg.qr(basis.T)[0]
    for k in range(1, 5):
        plane = found.planes[f"undetermined_{k}"]
        pattern = plane.values[0][known] * found.weights[known] ** 0.5
        share = ((q.T @ pattern) ** 2).sum() / (pattern**2).sum()
        # the first three are mean and plane, to which more is added where that is told less well;
        # the fourth has next to nothing of them: patterns are orthogonal in the weights
        assert share > 0.98 if k < 4 else share < 0.05, k
        assert "Ritz value" in plane.title
        assert np.nanmax(np.abs(plane.values)) == 1
    found.write(tmp_path / "map.fits")
    again = zonda.read_map(tmp_path / "map.fits").planes["undetermined_2"]
    np.testing.assert_array_equal(again.values, found.planes["undetermined_2"].values)


def test_none_where_none_is_asked_for():
    o, rng = observation(), np.random.default_rng(1)
    maker = zonda.MaximumLikelihoodMap(pixel="15 arcsec", half_difference=False)
    found = run([maker], o, SIGMA * rng.normal(size=(37, o.n_samples))).products["map"]
    assert not any(name.startswith("undetermined") for name in found.planes)
