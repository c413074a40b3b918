"""Singular modes against numpy by residual; what must never be removed; dead detectors; precision;
bits.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest
from pydantic import PrivateAttr

from zonda.core.errors import PipelineError
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.operators.filters.common_mode import UNDETERMINED, CommonModeFilter
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.bin_map import BinMap
from zonda.plugins.checks import scenes

N_DET, N = 40, 5000


def atmosphere_like(common, gradient, white, seed=0, n_det=N_DET, n=N):
    rng = np.random.default_rng(seed)
    series = np.cumsum(rng.standard_normal((4, n)), axis=1)
    series -= series.mean(axis=1, keepdims=True)
    series /= series.std(axis=1, keepdims=True)
    place = rng.uniform(-1, 1, (2, n_det))
    return (
        common * np.outer(1 + 0.02 * place[0], series[0])
        + gradient * (place.T @ series[1:3])
        + white * rng.standard_normal((n_det, n))
    )


def numpy_removed(a, modes):
    u, s, v = np.linalg.svd(a, full_matrices=False)
    return a - (u[:, :modes] * s[:modes]) @ v[:modes]


def run(bench, a, precision="float64", observation=None, threads=1, memory=1 << 30, **parameters):
    observation = observation or bench.observation(*a.shape)
    return bench.run(
        [CommonModeFilter(**parameters)],
        observation,
        {"signal": a},
        precision=precision,
        threads=threads,
        memory=memory,
    )


@pytest.mark.parametrize(
    "case", [(0.3, 0.0, 0.017), (0.3, 0.03, 0.017), (0.02, 0.01, 0.017), (10.0, 1.0, 0.0)]
)
@pytest.mark.parametrize("modes", [1, 2])
def test_equals_numpys_svd_by_residual(bench, case, modes):
    a = atmosphere_like(*case)
    result = run(bench, a, modes=modes, on_undetermined="remove", residual=1e-10)
    expected = numpy_removed(a, modes)
    assert np.linalg.norm(result.signal - expected) < 1e-7 * np.linalg.norm(expected)


def test_residual_is_reached_and_reported(bench):
    a = atmosphere_like(0.3, 0.03, 0.017)
    s = np.linalg.svd(a, compute_uv=False)
    result = run(bench, a, residual=1e-6)
    removed = a - result.signal
    u0 = np.linalg.svd(removed, full_matrices=False)[0][:, 0]
    value = np.linalg.norm(a.T @ u0) ** 2
    assert np.linalg.norm(a @ (a.T @ u0) - value * u0) / s[0] ** 2 < 1.1e-6
    reported = float(
        result.log["CommonModeFilter", "scan0: singular values / sqrt(detectors x samples)"].split(
            ","
        )[0]
    )
    assert abs(reported * np.sqrt(a.size) / s[0] - 1) < 1e-3  # four printed digits
    assert float(result.log["CommonModeFilter", "scan0: residual of the modes"].split()[0]) <= 1e-6


def test_leading_mode_orthogonal_to_the_mean_is_found(bench):
    rng = np.random.default_rng(3)
    a = np.outer(
        np.tile([1.0, -1.0], N_DET // 2), rng.standard_normal(N)
    ) + 0.1 * rng.standard_normal((N_DET, N))
    result = run(bench, a)
    assert result.signal.std() < 0.11
    two = np.array([[1.0], [-1.0]]) * rng.standard_normal(N) * 3 + 1e-3 * rng.standard_normal(
        (2, N)
    )
    assert run(bench, two).signal.std() < 2e-3


def test_mean_method(bench):
    a = atmosphere_like(0.3, 0.03, 0.017)
    result = run(bench, a, method="mean")
    np.testing.assert_allclose(result.signal, a - a.mean(axis=0), rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match="removes one mode"):
        CommonModeFilter(method="mean", modes=2)


@pytest.mark.parametrize(
    ("policy", "expected"), [("mean", "mean"), ("skip", "same"), ("remove", "svd")]
)
def test_closed_gap(bench, policy, expected):
    a = np.random.default_rng(4).standard_normal((N_DET, N))
    result = run(bench, a, on_undetermined=policy, residual=1e-8)
    wanted = {"mean": a - a.mean(axis=0), "same": a, "svd": numpy_removed(a, 1)}[expected]
    assert np.linalg.norm(result.signal - wanted) < 1e-5 * np.linalg.norm(a)
    assert result.log["CommonModeFilter", UNDETERMINED] == "1"


def test_second_mode_undetermined_is_skipped_and_the_first_removed(bench):
    a = atmosphere_like(0.3, 0.0, 0.017)
    result = run(bench, a, modes=2, residual=1e-8)
    assert np.linalg.norm(result.signal - numpy_removed(a, 1)) < 1e-5 * np.linalg.norm(
        result.signal
    )
    assert result.log["CommonModeFilter", UNDETERMINED] == "1"


def test_dead_constant_and_nan_detectors_are_flagged_and_take_no_part(bench):
    a = atmosphere_like(0.3, 0.03, 0.017)
    spoilt = a.copy()
    spoilt[3], spoilt[7], spoilt[11, 200] = 0.0, 4.25, np.nan
    result = run(bench, spoilt)
    assert np.flatnonzero(result.observations[0].detector_flags).tolist() == [3, 7, 11]
    assert result.log["CommonModeFilter", "detectors flagged: signal constant"] == "2"
    assert result.log["CommonModeFilter", "detectors flagged: signal not finite"] == "1"
    good = np.setdiff1d(np.arange(N_DET), [3, 7, 11])
    assert np.linalg.norm(result.signal[good] - numpy_removed(a[good], 1)) < 1e-4 * np.linalg.norm(
        result.signal[good]
    )


def test_all_dead_or_nothing_good(bench):
    result = run(bench, np.zeros((4, 300)))
    assert (result.signal == 0).all()
    assert result.observations[0].detector_flags.all()


def test_flagged_samples_are_left_out(bench):
    a = atmosphere_like(0.3, 0.03, 0.017)
    spoilt, observation = a.copy(), bench.observation(N_DET, N)
    bad = np.r_[0:10, 2040:2060, 4000:4100]
    observation.flags[bad] = 1
    spoilt[:, bad] = np.nan
    result = run(bench, spoilt, observation=observation, residual=1e-9)
    good = np.setdiff1d(np.arange(N), bad)
    assert not result.observations[0].detector_flags.any()
    expected = numpy_removed(a[:, good], 1)
    assert np.linalg.norm(result.signal[:, good] - expected) < 1e-6 * np.linalg.norm(expected)


def test_mean_emission_is_part_of_the_signal_in_float64_and_refused_in_float32(bench):
    a = atmosphere_like(0.3, 0.0, 0.017)
    mean = SmoothField.constant(np.linspace(60, 70, N_DET), N)
    whole = a + np.linspace(60, 70, N_DET)[:, None]
    result = bench.run(
        [CommonModeFilter()],
        bench.observation(N_DET, N),
        {"signal": a},
        means={"signal": mean},
        precision="float64",
    )
    assert np.linalg.norm(result.signal - numpy_removed(whole, 1)) < 1e-5 * np.linalg.norm(
        result.signal
    )
    with pytest.raises(PipelineError, match="mean emission") as err:
        bench.run(
            [CommonModeFilter()],
            bench.observation(N_DET, N),
            {"signal": a},
            means={"signal": mean},
            precision="float32",
        )
    assert "precision: float64" in str(err.value)
    bench.run(
        [HighpassFilter(), CommonModeFilter()],
        bench.observation(N_DET, N),
        {"signal": a},
        means={"signal": mean},
        precision="float32",
    )


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_identical_bits_for_threads_and_blocks(bench, precision):
    a = atmosphere_like(0.3, 0.05, 0.017, n_det=37, n=9001)
    results = [
        run(bench, a, precision, threads=t, memory=m).signal
        for t, m in ((1, 1 << 30), (3, 1 << 30), (2, 4 << 20))
    ]
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


def test_point_source_amplitude_survives_and_is_not_skewed(bench):
    """A source that each detector sees at another time keeps its amplitude but for its share of the
    mode, 1 / n_det.
    """
    t = np.arange(N)
    source = np.array([np.exp(-0.5 * ((t - 500 - 100 * d) / 9.0) ** 2) for d in range(N_DET)])
    a = atmosphere_like(0.5, 0.0, 0.0, seed=9) + 1e-3 * source
    cleaned = run(bench, a).signal
    peak = [cleaned[d, 500 + 100 * d] for d in range(N_DET)]
    assert abs(np.mean(peak) / 1e-3 - (1 - 1 / N_DET)) < 0.01


class Given(Operator):
    """A stream that is given."""

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    _values: np.ndarray = PrivateAttr(default_factory=lambda: np.zeros((0, 0)))

    def exec(self, block, state):
        (name,) = self.provides
        block.new(name)[...] = self._values[block.detectors, block.samples]


class Sky(Given):
    provides: ClassVar[frozenset[str]] = frozenset({"sky"})


class Noise(Given):
    provides: ClassVar[frozenset[str]] = frozenset({"white"})


class Air(Given):
    provides: ClassVar[frozenset[str]] = frozenset({"atmosphere"})


PARTS = ("sky", "atmosphere", "white")


class Sum(Operator):
    optional: ClassVar[frozenset[str]] = frozenset(PARTS)
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})

    def exec(self, block, state):
        block.new("signal")[...] = sum(block.detdata[n] for n in PARTS if n in block.detdata)


SEEN = 5
"""Detectors that see the sky; the others see none of it."""


def sky_and_noise(filters, sky=True, noise=True, dead=()):
    """``data`` with the signal ``alone`` of the sky; without noise, of a scene of the sky."""
    n_det, n = 12, 3000
    one, two, points = Sky(), Noise(), scenes.Points()
    one._values, two._values = (
        np.zeros((n_det, n)),
        np.random.default_rng(6).standard_normal((n_det, n)),
    )
    if sky:
        one._values[:SEEN] = 0.1 * np.sin(np.arange(n) / 70 + np.arange(SEEN)[:, None] / 9)
    two._values[list(dead)] = 0.0
    points._observation = scenes.scan(n_det, n)
    steps = [points, one, *([two] if noise else []), Sum(), *filters, BinMap(pixel="10 arcsec")]
    runs = {"alone": {"only": ["sky"]}} if noise else {}
    data = Pipeline(steps, runs=runs, precision="float64").run(
        scenes.scene(), threads=1, keep=["signal"]
    )
    return data, one._values


def counted(data, what, run=""):
    return data.log.get(f"{run}CommonModeFilter", what)


@pytest.mark.parametrize("method", ["svd", "mean"])
def test_detectors_that_see_no_sky_are_valid_zeros_in_a_signal_of_the_sky_alone(method):
    filters = [CommonModeFilter(method=method)]
    (data, _), (alone, sky) = sky_and_noise(filters), sky_and_noise(filters, noise=False)
    main, companion, only = data.products["map"], data.products["alone/map"], alone.products["map"]
    np.testing.assert_array_equal(companion.hits, main.hits)
    np.testing.assert_array_equal(only.hits, main.hits)
    np.testing.assert_array_equal(only.signal, companion.signal)
    assert counted(data, "detectors flagged: signal constant", "alone/") == 0
    expected = sky - sky.mean(axis=0) if method == "mean" else numpy_removed(sky, 1)
    tolerance = (
        1e-12 if method == "mean" else 1e-6
    )  # svd: modes to a residual of 1e-6 of the leading one
    np.testing.assert_allclose(
        alone.observations[0].detdata["signal"], expected, rtol=0, atol=tolerance
    )


@pytest.mark.parametrize("method", ["svd", "mean"])
def test_a_detector_that_is_dead_is_excluded_from_the_signal_of_the_sky(method):
    data, _ = sky_and_noise(
        [CommonModeFilter(method=method)], dead=(SEEN + 1,)
    )  # it sees no sky either
    main, companion = data.products["map"], data.products["alone/map"]
    assert counted(data, "detectors flagged: signal constant") == 1
    np.testing.assert_array_equal(companion.hits, main.hits)


@pytest.mark.parametrize("method", ["svd", "mean"])
def test_the_complete_signal_alone_shows_which_detectors_are_dead(method):
    """One is not finite in the atmosphere, which another signal does not contain: it is excluded
    from all.
    """
    n_det, n = 6, 2000
    parts, points = [Sky(), Air(), Noise()], scenes.Points()
    parts[0]._values, parts[1]._values = (
        np.ones((n_det, 1)) * np.sin(np.arange(n) / 70),
        np.zeros((n_det, n)),
    )
    parts[2]._values = np.random.default_rng(6).standard_normal((n_det, n))
    parts[1]._values[3] = np.nan
    points._observation = scenes.scan(n_det, n)
    runs = {"airless": {"without": ["atmosphere"]}, "alone": {"only": ["sky"]}}
    steps = [points, *parts, Sum(), CommonModeFilter(method=method), BinMap(pixel="10 arcsec")]
    data = Pipeline(steps, runs=runs, precision="float64").run(scenes.scene(), threads=1)
    main, airless, alone = (
        data.products[name].hits for name in ("map", "airless/map", "alone/map")
    )
    assert main.sum() == (n_det - 1) * n
    np.testing.assert_array_equal(airless, main)
    np.testing.assert_array_equal(alone, main)


@pytest.mark.parametrize("method", ["svd", "mean"])
def test_a_detector_that_does_not_see_the_atmosphere_is_dead(method):
    """Also in a scene without noise: a dead one must not dilute the mode, nor write it into the
    map.
    """
    n_det, n, points, air, rng = 6, 2000, scenes.Points(), Air(), np.random.default_rng(6)
    air._values = np.cumsum(rng.standard_normal(n)) + 1e-3 * rng.standard_normal((n_det, n))
    air._values[3] = 0.0
    points._observation = scenes.scan(n_det, n)
    steps = [points, air, Sum(), CommonModeFilter(method=method), BinMap(pixel="10 arcsec")]
    data = Pipeline(steps, precision="float64").run(scenes.scene(), threads=1, keep=["signal"])
    assert counted(data, "detectors flagged: signal constant") == 1
    assert data.products["map"].hits.sum() == (n_det - 1) * n
    left = np.delete(data.observations[0].detdata["signal"], 3, axis=0)
    assert left.std() == pytest.approx(
        1e-3 * np.sqrt(4 / 5), rel=0.05
    )  # 10 000 numbers: 0.8 %; six times that


@pytest.mark.parametrize("method", ["svd", "mean"])
def test_a_sky_that_no_detector_sees_is_a_map_of_zeros(method):
    data, _ = sky_and_noise([CommonModeFilter(method=method, modes=1)], sky=False)
    main, companion = data.products["map"], data.products["alone/map"]
    np.testing.assert_array_equal(companion.hits, main.hits)
    assert (companion.signal[companion.hits > 0] == 0).all()
    assert data.log.get("CommonModeFilter", "detectors flagged: signal constant") == 0


@pytest.mark.parametrize(
    "parameters", [{"on_undetermined": "remove", "residual": 1e-10}, {"method": "mean"}]
)
def test_wafer_by_wafer_each_is_filtered_as_if_it_were_alone(bench, parameters):
    one, two = atmosphere_like(0.3, 0.03, 0.017), atmosphere_like(0.5, 0.01, 0.017, seed=1)
    a, wafer = np.empty((2 * N_DET, N)), np.arange(2 * N_DET) % 2
    a[wafer == 0], a[wafer == 1] = one, two
    a[4] = np.nan  # dead
    observation = bench.observation(*a.shape)
    observation.focalplane.wafer = wafer
    found = run(bench, a, observation=observation, group="wafer", **parameters)
    for number, alone in enumerate((one, two)):
        alone = np.delete(alone, 2, 0) if number == 0 else alone
        expected = alone - alone.mean(0) if "method" in parameters else numpy_removed(alone, 1)
        rows = np.flatnonzero((wafer == number) & np.isfinite(a[:, 0]))
        assert np.linalg.norm(found.signal[rows] - expected) < 1e-7 * np.linalg.norm(expected)
    assert found.log["CommonModeFilter", "scan0, wafer 1: modes removed"].startswith("1 ")
    assert found.log["CommonModeFilter", "detectors flagged: signal not finite"] in (1, "1")


def test_wafers_take_the_modes_of_the_complete_signal(bench):
    """Equation (3), wafer by wafer: what is removed of a part B of the data is u (B^T u)^T."""
    from zonda.core.stream import Stream

    a, b = atmosphere_like(0.3, 0.03, 0.017), atmosphere_like(0.01, 0.02, 0.003, seed=2)
    observation = bench.observation(*a.shape)
    observation.focalplane.wafer = np.arange(N_DET) // 20
    step = CommonModeFilter(group="wafer", on_undetermined="remove")
    of_all = step.measure(Stream("signal", observation, a, {}, 1))
    of_part = step.measure(
        Stream("signal", observation, b, {}, 1, signal="signal/noiseless"), of_all
    )
    for wafer, part in enumerate(of_part.parts):
        rows = observation.focalplane.wafer == wafer
        np.testing.assert_allclose(
            part.times[0], b[rows].T @ part.detectors[0, rows], rtol=1e-9, atol=1e-12
        )
        assert not part.detectors[0, ~rows].any()
