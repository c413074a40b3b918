"""Crosstalk: neighbours, matrices of a file, and what is wrong with files."""

from __future__ import annotations

import numpy as np
import pytest

import zonda.testing
from zonda.core.data import Data
from zonda.core.errors import InputError, ZondaError
from zonda.operators.detectors.crosstalk import Crosstalk, neighbours


def test_it_keeps_the_contract():
    zonda.testing.check_operator(Crosstalk(level="1 %"))


def test_neighbours_of_a_hexagon(bench):
    """Six at one spacing; fewer at the rim; the sum is what a matrix makes of it."""
    observation = bench.observation(37, 500)
    plane = observation.focalplane
    number = np.diff(neighbours(plane, 0.01).indptr)
    apart = np.hypot(plane.xi[:, None] - plane.xi, plane.eta[:, None] - plane.eta)
    np.fill_diagonal(apart, np.inf)
    matrix = 0.01 * (apart < 1.2 * apart.min())
    np.testing.assert_array_equal(number, (matrix > 0).sum(axis=1))
    assert sorted(np.unique(number)) == [3, 4, 6]  # corners, sides, inner ones of 37
    x = np.random.default_rng(0).standard_normal((37, 500))
    found = bench.run(
        [Crosstalk(level="1 %")], observation, {"signal": x}, precision="float64"
    ).signal
    np.testing.assert_allclose(found, x + matrix @ x, rtol=0, atol=1e-14)


def test_detectors_in_one_place_are_no_neighbours(bench):
    plane = bench.observation(7, 10).focalplane
    columns = ("xi", "eta", "fwhm", "main_beam_efficiency", "illumination_efficiency", "net")
    twice = type(plane)(
        [*plane.names, *(f"{n}b" for n in plane.names)],
        **{k: np.tile(getattr(plane, k), 2) for k in columns},
    )
    found = neighbours(twice, 0.01)  # each neighbour counts twice, the partner not at all
    assert found.nnz == 4 * neighbours(plane, 0.01).nnz
    assert not any(s % 7 == d % 7 for d, s in zip(*found.nonzero(), strict=True))


def test_samples_that_are_not_finite_stay_alone(bench):
    x = np.random.default_rng(2).standard_normal((7, 100))
    x[3, 50] = np.nan
    found = bench.run(
        [Crosstalk()], bench.observation(7, 100), {"signal": x}, precision="float64"
    ).signal
    np.testing.assert_array_equal(np.isnan(found), np.isnan(x))


def write(path, rows, heading="detector,source,share"):
    path.write_text("\n".join([heading, *rows]) + "\n")
    return path


def test_shares_from_a_file(bench, tmp_path):
    observation = bench.observation(3, 100)
    a, b, c = observation.focalplane.names
    path = write(tmp_path / "shares.csv", [f"{a},{c},0.02", f"{a},{b},-0.01", f"{c},{a},0.5"])
    x = np.random.default_rng(1).standard_normal((3, 100))
    found = bench.run(
        [Crosstalk(file=path)], observation, {"signal": x}, precision="float64"
    ).signal
    np.testing.assert_allclose(
        found, [x[0] + 0.02 * x[2] - 0.01 * x[1], x[1], x[2] + 0.5 * x[0]], rtol=0, atol=1e-15
    )


@pytest.mark.parametrize(
    ("rows", "heading", "match"),
    [
        (["A,B,0.1"], "detector,source", "line 2: has 3 values, not 2"),
        (
            ["nobody,{1},0.1"],
            "detector,source,share",
            "line 2: detector 'nobody' is no detector of the focal plane",
        ),
        (["{0},{0},0.1"], "detector,source,share", "a detector's share of itself"),
        (["{0},{1},0.1", "{0},{1},0.2"], "detector,source,share", "there twice"),
        (["{0},{1},nan"], "detector,source,share", "line 2: share is 'nan', not a finite number"),
        (["{0},{1},much"], "detector,source,share", "line 2: share is 'much'"),
        (["{0},{1}"], "detector,source", "has no column 'share'"),
        ([], "detector,source,share", "has no rows"),
    ],
)
def test_bad_files(bench, tmp_path, rows, heading, match):
    observation = bench.observation(3, 100)
    path = write(
        tmp_path / "shares.csv",
        [row.format(*observation.focalplane.names) for row in rows],
        heading,
    )
    with pytest.raises(InputError, match=match) as caught:
        bench.run([Crosstalk(file=path)], observation, {"signal": np.zeros((3, 100))})
    assert "shares.csv" in str(caught.value)
    with pytest.raises(InputError, match=match):  # before a run
        Crosstalk(file=path).check(Data(None, observations=[observation]))


def test_either_a_level_or_a_file(tmp_path):
    path = write(tmp_path / "shares.csv", ["a,b,0.1"])
    with pytest.raises((ValueError, ZondaError), match="either level"):
        Crosstalk(level="1 %", file=path)
