"""`AtmosphereLayers` as a whole: rms, structure function, evaluation at nodes, invariances,
corners.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from zonda.core.assembly.signals import Chain
from zonda.core.configuration.time import Instant
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import ZondaError
from zonda.core.focalplane import Focalplane
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.plan.planning import planning_of
from zonda.core.registry import declared
from zonda.core.run.segments import cut
from zonda.core.run.views import View
from zonda.core.scene import Scene
from zonda.core.site import Site
from zonda.operators.atmosphere import fluctuations, resolution
from zonda.operators.atmosphere.distribution import Fluctuation
from zonda.operators.atmosphere.fluctuations import AtNodes, OfDetectors
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.atmosphere.model import Wind, beam_sigma
from zonda.operators.atmosphere.turbulence import sampling, tiles
from zonda.operators.atmosphere.turbulence.covariance import beam_correlation, beam_structure
from zonda.operators.atmosphere.turbulence.geometry import axes, crossing, rays, scan_planes
from zonda.operators.atmosphere.turbulence.lattice import Turbulence
from zonda.operators.atmosphere.turbulence.nodes import differential_rms

_spec = importlib.util.spec_from_file_location("direct", Path(__file__).with_name("direct.py"))
assert _spec
assert _spec.loader
_direct = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_direct)
at_points = _direct.at_points

Floats = NDArray[np.float64]
PWV = 7.7e-3
SITE = Site(
    name="here",
    latitude="38.4331 deg",
    longitude="-79.8398 deg",
    altitude="825 m",
    climatology="green_bank",
)
START = "2024-11-25T07:00:00Z"


def instrument(
    detectors: int = 223, field: str = "4.2 arcmin", diameter: str = "100 m"
) -> Instrument:
    return Instrument(
        name="camera",
        telescope=Telescope(name="dish", diameter=diameter),
        band=Band(name="90 GHz", low="78 GHz", high="108 GHz"),
        detectors=detectors,
        field_of_view=field,
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1 mK s(1/2)",
        sample_rate="100 Hz",
    )


def quaternions(azimuth: Floats, elevation: Floats) -> Floats:
    """Rz(-az) Ry(pi/2 - el), multiplied out: (n, 4)."""
    a, b = -azimuth / 2, (np.pi / 2 - elevation) / 2
    return np.stack(
        [
            -np.sin(a) * np.sin(b),
            np.cos(a) * np.sin(b),
            np.sin(a) * np.cos(b),
            np.cos(a) * np.cos(b),
        ],
        axis=1,
    )


def observe(
    seconds: float = 60.0,
    rate: float = 100.0,
    elevation: float = 57.0,
    azimuth: float = 150.0,
    *,
    scan: float = 0.0,
    camera: Instrument | None = None,
    offsets: tuple[Any, Any] | None = None,
    seed: int = 1,
    index: int = 0,
    start: str = START,
) -> Observation:
    """A stare, or a circle of radius ``scan`` arcmin in 20 s."""
    t = np.arange(max(1, round(seconds * rate))) / rate
    turn = 2 * np.pi * t / 20
    el = np.radians(elevation + scan / 60 * np.sin(turn))
    az = np.radians(azimuth + scan / 60 * np.cos(turn) / np.cos(np.radians(elevation)))
    q = quaternions(az, el)
    camera = camera or instrument()
    plane = camera.focalplane()
    if offsets is not None:
        xi, eta = (np.asarray(v, np.float64) for v in offsets)
        one = np.ones(len(xi))
        plane = Focalplane([f"d{k}" for k in range(len(xi))], xi, eta, one * 4e-5, one, one, one)
    return Observation(
        f"scan{index}",
        index,
        SITE,
        camera,
        plane,
        Instant.parse(start),
        t,
        rate,
        q,
        q,
        (0.0, 0.0),
        seed,
    )


def operator(**parameters: Any) -> AtmosphereLayers:
    return AtmosphereLayers(
        **{"pwv": "7.7 mm", "layer_response": "column", **parameters}
    )  # equation (1), of the water


def whole(
    observation: Observation,
    state: AtNodes | OfDetectors,
    name: str = "emission",
    dtype: type = np.float64,
) -> Floats:
    """(n_det, n_samp)."""
    n_det, n = observation.n_detectors, observation.n_samples
    out = np.empty((n_det, n), dtype)
    state.into(slice(0, n_det), slice(0, n), {name: out})
    return out


def water(op: AtmosphereLayers, observation: Observation) -> Floats:
    """y of every detector and sample: relative fluctuation of the water, from the emission and its
    slope (y << 1).
    """
    emission = whole(observation, op.prepare(observation))
    band = op.model(observation).band
    u = rays(
        axes(observation.boresight_azel), observation.focalplane.xi, observation.focalplane.eta
    )
    slope = (
        band.emission(PWV * 1.001, np.arcsin(u[2])) - band.emission(PWV * 0.999, np.arcsin(u[2]))
    ) / 0.002
    return emission / slope


def layers_of(op: AtmosphereLayers, observation: Observation) -> list[Any]:
    return op.model(observation).layers


def expected_variance(op: AtmosphereLayers, observation: Observation) -> float:
    """Variance of y after the beam."""
    return sum(
        (op.pwv_rms * m.amplitude) ** 2 * beam_correlation(0.0, op.outer_scale, m.sigma)[0]
        for m in layers_of(op, observation)
    )


# --------------------------------------------------------------------------------------------------
# statistics


@pytest.mark.parametrize("seconds", [30.0, 120.0, 2700.0])
def test_mean_and_rms_are_ensemble_properties_whatever_the_duration(seconds: float) -> None:
    # 25 seeds x 16 lines of sight >= 2 km = 4 r0 apart at the layer. The scan mean of y^2 varies by
    # at most 2 v^2 and that of y by at most v, whatever the duration, so the standard errors are at
    # most sqrt(2 k2 / n) v = 8 % v and sqrt(k1 v / n), n = 400, with k_m = sum of rho^m over the 16
    # lines of sight, rho(separation) their correlation. 4 of each are allowed.
    op = operator(
        layers=1, lowest="4000 m", pwv_rms="1 %", wind={"speed": "20 m/s", "direction": "250 deg"}
    )
    xi, eta = (v.ravel() * 0.5 for v in np.mgrid[-1.5:2, -1.5:2])
    observations = [observe(seconds, 0.2, 75.0, seed=seed, offsets=(xi, eta)) for seed in range(25)]
    y = np.array([water(op, o) for o in observations])
    v = expected_variance(op, observations[0])
    separation = (
        4000
        / np.sin(np.radians(75.0))
        * np.hypot(np.subtract.outer(xi, xi), np.subtract.outer(eta, eta))
    )
    rho = beam_correlation(separation, 500.0, 42.5)
    k1, k2 = (float((rho**m).sum(1).mean()) for m in (1, 2))
    n = 25 * 16
    assert np.mean(y**2) == pytest.approx(v, rel=4 * np.sqrt(2 * k2 / n))
    assert np.mean(y) == pytest.approx(0, abs=4 * np.sqrt(k1 * v / n))


@pytest.mark.parametrize("direction", ["along", "across"])
def test_structure_function_between_detectors_through_the_whole_operator(direction: str) -> None:
    # Two lines of sight r = 12 m apart in one layer seen through a 42.5 m beam. D = <(y1 - y2)^2> =
    # 2 p^2 S(r). The estimate averages d^2 over 30 seeds of 2700 s at 30 m/s; its relative variance
    # is 2 / n_eff with 1 / n_eff = mean over lags of rho(lag)^2, rho the correlation of d from the
    # analytic covariance.
    r, height, elevation, speed, seeds, seconds = 12.0, 2000.0, 50.0, 30.0, 30, 2700.0
    distance = height / np.sin(np.radians(elevation))
    half = r / distance / 2
    op = operator(layers=1, lowest="2000 m", wind={"speed": f"{speed} m/s", "direction": "270 deg"})
    # Looking north with a west wind: xi is along the wind, eta across it.
    offsets = ([-half, half], [0.0, 0.0]) if direction == "along" else ([0.0, 0.0], [-half, half])
    squares = []
    for seed in range(seeds):
        o = observe(seconds, 1.0, elevation, 0.0, seed=seed, offsets=offsets)
        y = water(op, o)
        squares.append(np.mean((y[0] - y[1]) ** 2))
    sigma = layers_of(op, o)[0].sigma
    s = beam_structure(r, 500.0, sigma)[0]
    lag = speed * np.arange(0, int(seconds))
    near = lag < 3000
    far = [
        np.hypot(lag[near] + r * a, r * b)
        for a, b in (((1, 0), (-1, 0)) if direction == "along" else ((0, 1), (0, -1)))
    ]
    rho = np.zeros(len(lag))
    rho[near] = (
        2 * beam_correlation(lag[near], 500.0, sigma)
        - sum(beam_correlation(v, 500.0, sigma) for v in far)
    ) / (2 * s)
    per_scan = (2 * (rho**2 * (1 - lag / seconds / speed)).sum() - 1) / len(lag)
    error = np.sqrt(2 * per_scan / seeds)
    assert error < 0.02
    assert np.mean(squares) == pytest.approx(2 * op.pwv_rms**2 * s, rel=4 * error)


def test_rms_after_the_beam_is_the_option() -> None:
    before, after = operator(pwv_rms="2 %"), operator(pwv_rms="2 %", pwv_rms_after_beam=True)
    camera = instrument(detectors=1, field="0 deg")
    a, b = water(before, observe(camera=camera)), water(after, observe(camera=camera))
    ratio = 0.02 / np.sqrt(expected_variance(before, observe(camera=camera)))
    assert 1.01 < ratio < 1.2
    np.testing.assert_allclose(b / a, ratio, rtol=2e-3)  # the slope of the emission changes with y


def test_large_rms_takes_the_log_normal_map_and_keeps_mean_and_rms() -> None:
    # Single lines of sight of n = 1500 seeds, through the map itself: y = exp(s g - s^2 v / 2) - 1
    # with g normal.
    op, law = operator(pwv_rms="40 %", pwv_rms_after_beam=True), Fluctuation(0.4, True, 0.9)
    g = np.random.default_rng(0).standard_normal(400_000) * np.sqrt(0.9)
    y = law(g)
    assert y.min() > -1
    assert y.mean() == pytest.approx(0, abs=4 * 0.4 / np.sqrt(len(g)))
    assert y.std() == pytest.approx(0.4, rel=0.02)
    o = observe(5.0)
    op.prepare(o)
    assert ("AtmosphereLayers", "distribution of the PWV", "log-normal") in list(o.log)
    covariance = np.mean(law(g) * law(g))  # exp(s^2 v) - 1 = p^2
    assert covariance == pytest.approx(0.16, rel=0.03)


# ---------------------------------------------------------------------------------------------
# evaluation at nodes


@pytest.mark.parametrize(
    ("diameter", "field", "tolerance"),
    [("100 m", "4.2 arcmin", 0.01), ("100 m", "4.2 arcmin", 0.5), ("12 m", "30 arcmin", 0.05)],
)
def test_nodes_agree_with_direct_evaluation_within_the_stated_bound(
    diameter: str, field: str, tolerance: float
) -> None:
    # Every detector and sample evaluated directly in the same realization. The bound is an ensemble
    # rms; one realization of 80 s has some tens of independent errors, hence the factor 3. The
    # lattice's own interpolation is common to both.
    camera = instrument(detectors=61, field=field, diameter=diameter)
    op = operator(layers=3, tolerance=tolerance)
    o = observe(80.0, 50.0, scan=4.0, camera=camera)
    state = op.prepare(o)
    # `tolerance` is a fraction of what the focal-plane mean leaves; from here on of the whole
    # fluctuation.
    left = differential_rms(o.focalplane.xi, o.focalplane.eta, layers_of(op, o))
    tolerance *= op.pwv_rms * left / np.sqrt(expected_variance(op, o))
    model = op.model(o)
    band, track = model.band, model.plane
    u = rays(axes(o.boresight_azel), o.focalplane.xi, o.focalplane.eta)
    g = np.zeros(u.shape[1:])
    for layer, beam in zip(model.layers, model.turbulence, strict=True):
        across, along = track.positions(crossing(u), o.seconds, layer.height, layer.wind)
        g += layer.amplitude * at_points(beam, across, along)
    elevation = np.arcsin(u[2])
    direct = band.emission_difference(PWV, PWV * op.pwv_rms * g, elevation)
    rms = (
        np.sqrt(expected_variance(op, o))
        * np.mean(band.emission_difference(PWV, 0.01 * PWV, elevation))
        / 0.01
    )
    error = whole(o, state) - direct
    assert isinstance(state, AtNodes)
    assert state.fields["emission"].step > 1
    assert state.fields["emission"].weights.shape[1] < 61
    assert np.sqrt(np.mean(error**2)) < 3 * np.sqrt(2) * tolerance * rms
    relative = np.expm1(band.log_transmission_difference(PWV, PWV * op.pwv_rms * g, elevation))
    assert (
        np.sqrt(np.mean((whole(o, state, "transmission") - relative) ** 2))
        < 10 * tolerance * relative.std() + 1e-7
    )
    # The mean, in float64: within the same share of the fluctuation.
    mean = o.smooth["atmosphere"].evaluate(slice(0, 61), slice(0, o.n_samples))
    assert mean.dtype == np.float64
    wrong = mean - band.emission(PWV, elevation)
    # Largest at the very ends, where the path is extrapolated.
    assert np.sqrt(np.mean(wrong**2)) < 3 * tolerance * rms
    assert abs(wrong).max() < 20 * tolerance * rms
    opaque = o.smooth["transmission"].evaluate(slice(0, 61), slice(0, o.n_samples))
    assert abs(opaque - band.transmission(PWV, elevation)).max() < tolerance * 1e-2


def test_tiles_and_chunks_do_not_change_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    def series() -> Floats:
        return whole(o := observe(300.0, 10.0, scan=4.0), operator(layers=2).prepare(o))

    made: list[tuple[int, int]] = []
    coefficients = tiles.coefficients

    def watched(fields: Sequence[Turbulence], i0: int, i1: int, j0: int, j1: int) -> Any:
        made.append((i1 - i0, j1 - j0))
        return coefficients(fields, i0, i1, j0, j1)

    monkeypatch.setattr(tiles, "coefficients", watched)
    expected = series()
    assert len(made) == 2  # a piece for each layer
    monkeypatch.setattr(
        tiles, "SPARE", -1
    )  # of the path's end nothing is in the piece: the others' tiles serve
    np.testing.assert_array_equal(series(), expected)
    assert len(made) > 4
    monkeypatch.setattr(tiles, "ONE_PIECE", 0)
    monkeypatch.setattr(tiles, "SPARE", 2)
    made.clear()
    np.testing.assert_array_equal(series(), expected)
    once = len(made)
    for longest, kept, times in ((16, 512 << 20, 1024), (32, 0, 7), (256, 1 << 20, 100)):
        monkeypatch.setattr(fluctuations, "TIMES_AT_ONCE", times)
        monkeypatch.setattr(fluctuations, "POINTS_AT_ONCE", times)
        monkeypatch.setattr(tiles, "LONGEST", longest)
        monkeypatch.setattr(tiles, "BYTES_KEPT", kept)
        monkeypatch.setattr(sampling, "TIMES_AT_ONCE", times)
        made.clear()
        np.testing.assert_array_equal(series(), expected)
        assert {along for _, along in made} == {longest + 3}
        assert len({across for across, _ in made}) <= 2  # as wide as each layer's path
    monkeypatch.setattr(tiles, "LONGEST", 8)
    made.clear()
    series()
    assert len(made) > 4 * once
    monkeypatch.setattr(tiles, "WIDEST", 0)
    for name, narrow in (("STRIP", 1 << 20), ("SQUARE", 0)):
        monkeypatch.setattr(tiles, "NARROW", narrow)
        for sides in ((3, 4), (5, 5)):
            monkeypatch.setattr(tiles, name, sides)
            made.clear()
            np.testing.assert_array_equal(series(), expected)
            assert set(made) == {((1 << sides[0]) + 3, (1 << sides[1]) + 3)}
    monkeypatch.setattr(sampling, "CELLS_IN_ALL", 300)
    with pytest.raises(ZondaError, match="lattice points of the turbulence"):
        series()


def test_the_default_job_is_compressed_by_nodes_and_steps() -> None:
    o = observe(120.0, scan=4.0)
    state = operator().prepare(o)
    assert isinstance(state, AtNodes)
    assert state.fields["emission"].weights.shape[1] <= 9
    assert state.fields["emission"].step >= 64
    said = {what: text for who, what, text in o.log if who == "AtmosphereLayers"}
    assert "Chebyshev" in said["nodes"]
    assert "samples" in said["step in time"]
    assert "0.500% of the mean before the beam" in said["PWV rms"]
    assert said["PWV rms after the beam, per layer"].count("m:") == 10


# ------------------------------------------------------------------------------------------ bits,
# seeds, invariances


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bits_do_not_depend_on_the_block(dtype: type) -> None:
    o = observe(90.0, scan=3.0)
    op = operator(layers=3)
    state = op.prepare(o)

    def run(detectors: slice, samples: slice) -> dict[str, Any]:
        block = Block(o, detectors, samples, dtype=dtype)
        op.exec(block, state)
        return block.detdata

    everything = run(slice(0, 223), slice(0, o.n_samples))
    for detectors, samples in (
        (slice(16, 48), slice(2048, 6144)),
        (slice(208, 223), slice(8192, o.n_samples)),
    ):
        part = run(detectors, samples)
        for name in ("atmosphere", "transmission"):
            assert part[name].dtype == dtype
            np.testing.assert_array_equal(part[name], everything[name][detectors, samples])


def test_exec_adds_to_what_is_there() -> None:
    o = observe(10.0)
    op = operator(layers=2)
    state = op.prepare(o)
    block = Block(o, slice(0, 16), slice(0, 500))
    block.new("atmosphere")[:] = 2.0
    op.exec(block, state)
    np.testing.assert_allclose(
        block.detdata["atmosphere"] - 2, whole(o, state)[:16, :500], atol=1e-6
    )


def test_same_seed_same_bits_and_two_seeds_are_incoherent() -> None:
    op = operator(layers=4, outer_scale="100 m")
    camera = instrument(detectors=1, field="0 deg")

    def series(seed: int) -> Floats:
        return whole(o := observe(2000.0, 1.0, camera=camera, seed=seed), op.prepare(o))[0]

    a, b = series(1), series(2)
    np.testing.assert_array_equal(a, series(1))
    # At > 5 m/s past r0 = 100 m, 2000 s hold > 50 independent pieces: |correlation| < 4 / sqrt(50).
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.57
    assert not np.array_equal(a, b)


def test_two_operators_have_independent_air() -> None:
    a, b = operator(), operator(name="other")
    o = observe(5.0)
    assert not np.allclose(whole(o, a.prepare(o)), whole(o, b.prepare(o)), rtol=0.1)


@pytest.mark.parametrize("angle", [37.0, 180.0, 271.0])
def test_turning_telescope_and_wind_together_changes_nothing(angle: float) -> None:
    wind = {"speed": "12 m/s", "direction": "200 deg"}
    turned = {"speed": "12 m/s", "direction": f"{200 + angle} deg"}
    one, two = observe(20.0, azimuth=40.0, scan=4.0), observe(20.0, azimuth=40.0 + angle, scan=4.0)
    a, b = (
        whole(o, operator(layers=3, wind=w).prepare(o)) for o, w in ((one, wind), (two, turned))
    )
    np.testing.assert_allclose(a, b, atol=1e-9)


def test_zero_wind_and_a_stare_give_identical_samples() -> None:
    o = observe(30.0)
    op = operator(wind={"speed": "0 m/s"})
    state = op.prepare(o)
    for name in ("emission", "transmission"):
        values = whole(o, state, name)
        assert np.isfinite(values).all()
        assert values.std(axis=0).max() > 0
        assert np.ptp(values, axis=1).max() <= 1e-12 * abs(values).max()


def test_frozen_flow_carries_the_air_to_the_next_detector() -> None:
    # A detector downwind sees the same air r / v later (one layer; the shift along eta = 0 is level
    # with the boresight).
    distance = 2000.0 / np.sin(np.radians(50.0))
    r = 60.0
    op = operator(
        layers=1,
        lowest="2000 m",
        wind={"speed": "10 m/s", "direction": "270 deg"},
        tolerance="0.1 %",
    )
    o = observe(60.0, 10.0, 50.0, 0.0, offsets=([0.0, r / distance], [0.0, 0.0]))
    west, east = water(op, o)
    np.testing.assert_allclose(east[60:], west[:-60], atol=2e-3 * op.pwv_rms)


def test_consecutive_scans_see_the_same_air_continuously() -> None:
    # The second scan starts where the first one ends, 0.3 deg away; at 60 s the pointing jumps, the
    # air does not.
    op = operator(tolerance="0.1 %")
    whole_scan = observe(120.0, 10.0)
    first = observe(60.0, 10.0, index=0)
    second = observe(60.0, 10.0, index=1, start="2024-11-25T07:01:00Z")
    scene = Scene(site=SITE, instrument=instrument(), time=START)
    op.observe(Data(scene, [first, second]))
    parts = [whole(o, op.prepare(o))[:20] for o in (first, second)]
    alone = operator(tolerance="0.1 %")
    alone.observe(Data(scene, [whole_scan]))
    expected = whole(whole_scan, alone.prepare(whole_scan))[:20]
    np.testing.assert_allclose(
        np.concatenate(parts, axis=1), expected, atol=1e-4 * expected.std() + 5e-6
    )
    moved = observe(
        60.0, 10.0, azimuth=153.0, elevation=57.2, index=1, start="2024-11-25T07:01:00Z"
    )
    op.observe(Data(scene, [first, moved]))
    values = whole(moved, op.prepare(moved))[:20]
    # 3 deg at 3 km is 150 m of other air, far less than r0: the values stay correlated, and no
    # realization is redrawn.
    assert abs(values[:, 0] - parts[0][:, -1]).max() < 2 * 0.005 * 34


# --------------------------------------------------------------------------------------------------
# corners


@pytest.mark.parametrize(
    ("seconds", "rate"), [(0.01, 100.0), (0.02, 100.0), (0.5, 100.0), (0.5, 1.0)]
)
def test_short_scans_of_one_detector(seconds: float, rate: float) -> None:
    o = observe(seconds, rate, camera=instrument(detectors=1, field="0 deg"))
    op = operator(wind={"speed": "0 m/s"})
    values = whole(o, op.prepare(o))
    assert values.shape == (1, max(1, round(seconds * rate)))
    assert np.isfinite(values).all()
    assert (values != 0).all()


ONE_AND_MANY = (1, "0 deg"), (7, "6 arcmin")


def test_one_line_of_sight_on_a_cone() -> None:
    # It has one elevation; axes beyond the ends, where the scan turns round, are no unit vectors.
    azimuth = 78 + 5 * np.cos(np.arange(1000) / 120)
    alone, camera = (
        whole(o, operator(wind={"speed": "0 m/s"}).prepare(o))[0]
        for o in (swept(50.0, azimuth, instrument(detectors=n, field=f)) for n, f in ONE_AND_MANY)
    )
    # the same air, laid out by polynomials of another range, on tiles of another region
    np.testing.assert_allclose(alone, camera, atol=1e-4 * camera.std())


def test_no_fluctuation_when_none_is_asked_for() -> None:
    o = observe(10.0)
    state = operator(pwv_rms="0 %").prepare(o)
    assert not whole(o, state).any()
    assert not whole(o, state, "transmission").any()
    assert o.smooth["atmosphere"].evaluate(slice(0, 1), slice(0, 1))[0, 0] > 20


@pytest.mark.parametrize("elevation", [5.0, 30.0, 89.8])
def test_low_and_high_elevations(elevation: float) -> None:
    o = observe(10.0, elevation=elevation)
    assert np.isfinite(whole(o, operator().prepare(o))).all()
    mean = o.smooth["atmosphere"].evaluate(slice(0, 223), slice(0, 1))[:, 0]
    # Emission falls with elevation, smoothly through the limit: a parabola in eta leaves < 3 mK
    # over 4 arcmin.
    left = mean - np.polyval(np.polyfit(o.focalplane.eta, mean, 2), o.focalplane.eta)
    assert abs(left).max() < 3e-3
    assert np.corrcoef(mean, o.focalplane.eta)[0, 1] < -0.99


def test_detectors_below_a_telescopes_limit_see_the_air_there() -> None:
    o = observe(10.0, elevation=5.0)
    op = operator()
    op.prepare(o)
    band = op.model(o).band
    lowest = int(o.focalplane.eta.argmin())
    elevation = np.radians(5.0) + np.arctan(o.focalplane.eta[lowest])
    assert elevation < np.radians(4.97)
    mean = o.smooth["atmosphere"].evaluate(slice(lowest, lowest + 1), slice(0, 1))[0, 0]
    # the band's table is within 1e-5, 2 mK; the telescope's limit itself is 0.6 K away
    assert abs(mean - band.transfer(PWV, [elevation])[0][0]) < 4e-3


@pytest.mark.parametrize("seconds", [60.0, 64.3, 516.0])
def test_mean_emission_is_as_good_at_the_ends_of_a_scan_as_inside(seconds: float) -> None:
    o = observe(seconds, elevation=30.0, scan=4.0)
    op = operator()
    op.prepare(o)
    band = op.model(o).band
    field, n = o.smooth["atmosphere"], o.n_samples
    d = int(o.focalplane.eta.argmax())
    truth = band.emission(
        PWV,
        np.arcsin(rays(axes(o.boresight_azel), o.focalplane.xi[[d]], o.focalplane.eta[[d]])[2, 0]),
    )
    error = abs(field.evaluate(slice(d, d + 1), slice(0, n))[0] - truth)
    edge = 2 * field.step
    inside = error[edge:-edge].max()
    # The path beyond the ends is extrapolated to third order; second order made the ends three
    # times worse than the rest.
    assert max(error[:edge].max(), error[-edge:].max()) < 2 * inside


def test_elevations_far_below_the_limit_are_an_error() -> None:
    with pytest.raises(ZondaError, match=r"4\.5 to 90 deg"):
        operator().prepare(observe(1.0, elevation=4.0))


def test_below_the_horizon_is_an_error() -> None:
    with pytest.raises(ZondaError, match="below the horizon"):
        operator().prepare(observe(1.0, elevation=-3.0))


def swept(elevation: float, azimuths: Floats, camera: Instrument | None = None) -> Observation:
    """A scan through given azimuths [deg] at constant elevation, 100 Hz."""
    o = observe(len(azimuths) / 100, elevation=elevation, camera=camera)
    o.boresight_azel = quaternions(
        np.radians(azimuths), np.full(len(azimuths), np.radians(elevation))
    )
    return o


def back_and_forth(throw: float) -> Floats:
    """4000 azimuths of one period, ``throw`` deg from end to end."""
    return 180 + throw / 2 * np.sin(2 * np.pi * np.arange(4000) / 4000)


@pytest.mark.parametrize(
    ("elevation", "throw", "field", "bound"),
    [
        (50.0, 60.0, "1 arcmin", 1e-3),
        (30.0, 60.0, "2 deg", 3e-3),
        (50.0, 93.0, "2 deg", 2e-3),
        (50.0, 60.0, "35 deg", 0.18),
    ],
)
def test_wide_throws_unroll_the_cone(
    elevation: float, throw: float, field: str, bound: float
) -> None:
    # Pairs of detectors, any azimuth of the scan: squared separation on the plane against that
    # across the line of sight.
    camera = instrument(detectors=61, field=field, diameter="6 m")
    o = swept(elevation, back_and_forth(throw), camera)
    track = scan_planes([o])[0]
    assert track.kind == "cone"
    assert track.bound < bound
    u = rays(axes(o.boresight_azel[::200]), o.focalplane.xi, o.focalplane.eta)
    near = 1e-4  # towards xi and eta of every detector: the metric itself
    for step in ((near, 0.0), (0.0, near), (near, near)):
        other = rays(
            axes(o.boresight_azel[::200]), o.focalplane.xi + step[0], o.focalplane.eta + step[1]
        )
        on_plane = ((track.unroll(crossing(other)) - track.unroll(crossing(u))) ** 2).sum(0)
        across = np.cross(u, other, axis=0)
        sky = (across**2).sum(0) / (
            u[2] * other[2]
        )  # (theta z)^2 per squared metre of height, z that of the pair
        assert abs(on_plane / sky - 1).max() < track.bound + 3 * near / np.sin(
            np.radians(elevation - 20)
        )
    operator(layers=2, tolerance="20 %").prepare(
        swept(elevation, back_and_forth(throw)[:400], camera)
    )


def test_a_narrow_scan_keeps_one_plane_and_the_horizon_falls_back() -> None:
    narrow = scan_planes([observe(40.0, elevation=50.0, scan=4.0)])[0]
    assert (narrow.kind, narrow.cone) == ("transverse", None)
    assert narrow.bound < 0.01
    np.testing.assert_array_equal(narrow.drift, narrow.matrix)
    o = swept(50.0, np.linspace(0, 360, 2000))
    track = scan_planes([o])[0]
    assert track.kind == "horizontal"
    assert track.bound == pytest.approx(1 / np.tan(np.radians(50.0)) ** 2, rel=0.01)
    operator(layers=2, tolerance="20 %").prepare(o)
    said = {what: text for _, what, text in o.log}
    assert "horizontal" in said["plane of the turbulence"]


def test_the_cone_is_the_plane_to_first_order_and_wind_drifts_within_its_bound() -> None:
    o = swept(50.0, back_and_forth(60.0))
    track = scan_planes([o])[0]
    h = 1e-5
    for e in np.eye(2):
        moved = track.unroll((track.centre + h * e)[:, None]) - track.unroll(track.centre[:, None])
        np.testing.assert_allclose(moved[:, 0] / h, track.matrix @ e, atol=1e-4)
    # The drift of any wind, as a vector, against that of the unrolled cone at every azimuth.
    X = crossing(rays(axes(o.boresight_azel[::100]), np.zeros(1), np.zeros(1)))[:, 0]
    for angle in np.radians(np.arange(0, 360, 15)):
        wind = np.array([np.sin(angle), np.cos(angle)])
        true = (track.unroll(X + h * wind[:, None]) - track.unroll(X)) / h
        wrong = np.hypot(*((track.drift @ wind)[:, None] - true)) / np.hypot(*true)
        assert wrong.max() < track.drift_bound + 1e-4
    assert 0.1 < track.drift_bound < 0.3


def test_transverse_plane_measures_separations_across_the_line_of_sight() -> None:
    # Detectors 1 arcmin apart in any direction, at any elevation, are z theta apart on the plane.
    for elevation in (20.0, 57.0, 89.0):
        o = observe(1.0, elevation=elevation)
        track = scan_planes([o])[0]
        theta = np.radians(1 / 60)
        angle = np.linspace(0, 2 * np.pi, 9)
        u = rays(
            axes(o.boresight_azel[:1]),
            np.r_[0, theta * np.cos(angle)],
            np.r_[0, theta * np.sin(angle)],
        )
        x, y = track.positions(crossing(u), np.zeros(1), 1000.0, np.array([3.0, 4.0]))
        r = np.hypot(x[1:] - x[0], y[1:] - y[0])[:, 0]
        np.testing.assert_allclose(r, 1000 / np.sin(np.radians(elevation)) * theta, rtol=3e-3)


def test_rays_agree_with_azimuth_and_elevation() -> None:
    az, el = np.radians([10.0, 200.0]), np.radians([30.0, 70.0])
    u = rays(axes(quaternions(az, el)), np.array([0.0, 1e-4, 0.0]), np.array([0.0, 0.0, 1e-4]))
    np.testing.assert_allclose(
        u[:, 0], [np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)], atol=1e-14
    )
    azimuth, elevation = np.arctan2(u[0], u[1]) % (2 * np.pi), np.arcsin(u[2])
    np.testing.assert_allclose(azimuth[1] - az, 1e-4 / np.cos(el), rtol=1e-6)
    np.testing.assert_allclose(elevation[2] - el, 1e-4, rtol=1e-6)


def test_wind_directions_are_where_the_wind_comes_from() -> None:
    np.testing.assert_allclose(
        Wind(speed="10 m/s", direction="270 deg").vector, [10, 0], atol=1e-14
    )
    np.testing.assert_allclose(Wind(speed="10 m/s", direction="0 deg").vector, [0, -10], atol=1e-14)


def test_winds_and_weights_per_layer() -> None:
    o = observe(1.0)
    op = operator(
        layers=2,
        wind=[{"speed": "3 m/s"}, {"speed": "5 m/s", "direction": "0 deg"}],
        weights="equal",
    )
    one, two = op.model(o).layers
    np.testing.assert_allclose([one.amplitude, two.amplitude], np.sqrt(0.5))
    np.testing.assert_allclose([one.wind, two.wind], [[3, 0], [0, -5]], atol=1e-14)
    vapour, profile = operator().model(o).layers, op.model(o).profile
    assert sum(v.amplitude**2 for v in vapour) == pytest.approx(1)
    assert [v.amplitude for v in vapour] == sorted((v.amplitude for v in vapour), reverse=True)
    np.testing.assert_allclose(
        vapour[3].wind, [profile.at(2000.0).wind_east, profile.at(2000.0).wind_north]
    )


def test_climatology_gives_the_pwv_where_none_is_asked_for() -> None:
    o = observe(1.0)
    AtmosphereLayers().prepare(o)
    said = {what: text for _, what, text in o.log}
    assert said["mean PWV"].endswith("mm (of the weather)")


def test_near_field_beam() -> None:
    camera = instrument()
    assert beam_sigma(camera.telescope, camera.band, 0.0) == pytest.approx(100 / 2.3548, rel=1e-4)
    far = 1e9
    rayleigh = np.pi * 50**2 * camera.band.centre / 299792458
    assert beam_sigma(camera.telescope, camera.band, far) == pytest.approx(
        100 / 2.3548 * far / rayleigh, rel=1e-4
    )


def test_the_beam_is_that_of_the_distance_along_the_line_of_sight() -> None:
    camera = instrument(diameter="6 m", detectors=7)
    o = observe(1.0, elevation=30.0, camera=camera)
    one, *_, last = layers_of(operator(), o)
    assert one.distance == pytest.approx(1000.0, rel=2e-4)  # 500 m / sin 30 deg
    # A shell of radius R + h is met at sqrt(R^2 sin^2 e + 2 R h + h^2) - R sin e: 12 m nearer than
    # a flat layer.
    radius = 6371000.0
    shell = np.sqrt((radius / 2) ** 2 + 2 * radius * 5000 + 5000**2) - radius / 2
    assert last.distance == pytest.approx(shell, rel=1e-6)
    assert 10 < 10000 - last.distance < 14
    assert last.sigma == pytest.approx(beam_sigma(camera.telescope, camera.band, shell))
    assert (
        last.sigma > 1.3 * one.sigma
    )  # far beyond the Rayleigh distance of 8.8 km the beam has widened


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"layers": 3, "wind": [{"speed": "3 m/s"}]}, "1 winds for 3 layers"),
        ({"lowest": "6 km"}, "lowest must be below highest"),
        ({"pwv_rms": "-1 %"}, "must be at least"),
        ({"pwv": "0 mm"}, "greater than"),
        ({"layers": 0}, "must be at least"),
        ({"tolerance": 0.0}, "must be at least"),
    ],
)
def test_bad_parameters(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ZondaError, match=message):
        AtmosphereLayers(**parameters)


def test_an_outer_scale_beyond_the_measured_range_is_refused() -> None:
    with pytest.raises(ZondaError, match="outer scale"):
        operator(outer_scale="1e9 m").prepare(observe(1.0))


# --------------------------------------------------------------------------------------------------
# products


def test_outputs_are_the_fluctuations_along_each_line_of_sight() -> None:
    o = observe(60.0, scan=4.0, camera=instrument(detectors=7))
    op = operator(layers=3, outputs=["pwv", "opacity", "path_delay"])
    state = op.prepare(o)
    block = Block(o, slice(0, 7), slice(0, o.n_samples), dtype=np.float64)
    op.exec(block, state)
    assert (
        set(block.detdata)
        == {"atmosphere", "transmission", "pwv", "opacity", "path_delay"}
        == op.provides
    )
    y = water(operator(layers=3), o)
    elevation = np.arcsin(rays(axes(o.boresight_azel), o.focalplane.xi, o.focalplane.eta)[2])
    pwv = block.detdata["pwv"]
    # Airmass of a shell some 1.5 km up: 1 / sin(elevation) to 1e-3 at 57 deg. Emission is linear in
    # y to some 1e-3.
    np.testing.assert_allclose(pwv, PWV * y / np.sin(elevation), rtol=0.01, atol=0.005 * pwv.std())
    np.testing.assert_allclose(
        np.exp(-block.detdata["opacity"]) - 1, block.detdata["transmission"], atol=1e-8
    )
    assert np.corrcoef(block.detdata["opacity"].ravel(), pwv.ravel())[0, 1] > 0.999
    ratio = block.detdata["path_delay"] / pwv
    assert np.ptp(ratio) < 1e-6
    # Bevis et al. (1994): 6.2 to 6.5 over the world's weather; here vapour at about 0 C (0.35 % per
    # K).
    assert 6.3 < ratio.mean() < 6.8
    said = {what: text for _, what, text in o.log}
    assert said["wet path delay"].startswith(f"{ratio.mean():.3f} times")


def test_outputs_are_made_only_where_asked_for() -> None:
    assert operator().provides == {"atmosphere", "transmission"}
    assert declared(AtmosphereLayers, "provides") == {
        "atmosphere",
        "transmission",
        "pwv",
        "opacity",
        "path_delay",
    }, "what may be asked for"
    o = observe(5.0)
    assert set(operator().prepare(o).fields) == {"emission", "transmission"}
    with pytest.raises(ZondaError, match="outputs"):
        operator(outputs=["ozone"])


def test_outputs_can_be_kept_by_a_pipeline(bench: Any) -> None:
    o = observe(20.0, camera=instrument(detectors=3))
    op = operator(layers=2, outputs=["pwv", "path_delay"])
    run = bench.run([op], o, keep=("pwv", "path_delay", "atmosphere"))
    kept = run.observations[0].detdata
    assert kept["pwv"].shape == kept["path_delay"].shape == (3, o.n_samples)
    assert 1e-6 < kept["pwv"].std() < 1e-3  # m: 0.5 % of 7.7 mm


def test_delay_per_vapour_is_that_of_bevis() -> None:
    from zonda.operators.atmosphere.response import delay_per_vapour

    # Bevis et al. (1994): T_m = 270 K, 0.15 being a rule of thumb for its inverse.
    assert 1 / delay_per_vapour(np.array([270.0]), np.ones(1)) == pytest.approx(0.154, abs=1e-3)
    mixed = delay_per_vapour(np.array([290.0, 250.0]), np.array([3.0, 1.0]))
    assert (
        delay_per_vapour(np.array([290.0]), np.ones(1))
        < mixed
        < delay_per_vapour(np.array([250.0]), np.ones(1))
    )


# ----------------------------------------------------------------------------------- without
# focal-plane compression


def test_wide_field_per_detector_evaluation_agrees_with_direct_evaluation() -> None:
    # A 6 m telescope with 10 deg: no grid of nodes pays. Every detector and sample directly, in the
    # same air.
    camera = instrument(detectors=61, field="10 deg", diameter="6 m")
    op = operator(layers=3, tolerance="1 %")
    o = swept(50.0, 180 + 12 * np.sin(2 * np.pi * np.arange(3000) / 6000), camera)
    state = op.prepare(o)
    assert isinstance(state, OfDetectors)
    assert state.step > 1
    direct, band, elevation = directly(op, o)
    left = direct - direct.mean(0)
    wrong = whole(o, state) - band.emission_difference(PWV, PWV * op.pwv_rms * direct, elevation)
    slope = np.mean(band.emission_difference(PWV, 0.01 * PWV, elevation)) / 0.01 * op.pwv_rms
    # The bound is on the ensemble; this realization of 30 s holds some tens of independent errors:
    # factor 3.
    assert np.sqrt(np.mean((wrong / slope) ** 2)) < 3 * 0.01 * np.sqrt(np.mean(left**2))


def test_layers_take_steps_of_their_own_within_the_same_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(resolution, "PAYS_FROM", 0)
    camera = instrument(detectors=61, field="10 deg", diameter="6 m")
    op = operator(layers=4, lowest="300 m", tolerance="1 %")
    o = swept(50.0, 180 + 12 * np.sin(2 * np.pi * np.arange(3000) / 6000), camera)
    state = op.prepare(o)
    said = {what: text for _, what, text in o.log}
    assert "by layer" in said["step in time"]
    direct, band, elevation = directly(op, o)
    left = direct - direct.mean(0)
    wrong = whole(o, state) - band.emission_difference(PWV, PWV * op.pwv_rms * direct, elevation)
    slope = np.mean(band.emission_difference(PWV, 0.01 * PWV, elevation)) / 0.01 * op.pwv_rms
    assert np.sqrt(np.mean((wrong / slope) ** 2)) < 3 * 0.01 * np.sqrt(np.mean(left**2))


def test_units_and_tiles_do_not_change_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = instrument(detectors=37, field="10 deg", diameter="6 m")

    def series() -> Floats:
        o = swept(50.0, 180 + 4 * np.sin(2 * np.pi * np.arange(1000) / 500), camera)
        state = operator(layers=2, lowest="3 km").prepare(o)
        assert isinstance(state, OfDetectors)
        # in another order, and some of it twice
        out = np.empty((37, 1000))
        for detectors, samples in (
            (slice(16, 37), slice(300, 1000)),
            (slice(0, 37), slice(0, 500)),
            (slice(0, 37), slice(500, 1000)),
        ):
            state.into(
                detectors,
                samples,
                {
                    "emission": (
                        part := np.empty(
                            (detectors.stop - detectors.start, samples.stop - samples.start)
                        )
                    )
                },
            )
            out[detectors, samples] = part
        return out

    expected = series()
    monkeypatch.setattr(tiles, "ONE_PIECE", 0)
    np.testing.assert_array_equal(series(), expected)
    monkeypatch.setattr(tiles, "WIDEST", 0)
    monkeypatch.setattr(tiles, "SQUARE", (6, 6))
    monkeypatch.setattr(tiles, "BYTES_KEPT", 1 << 20)
    np.testing.assert_array_equal(series(), expected)
    monkeypatch.setattr(fluctuations, "UNIT_DETECTORS", 16)
    monkeypatch.setattr(fluctuations, "UNIT_SAMPLES", 256)
    monkeypatch.setattr(fluctuations, "BYTES_KEPT", 0)
    np.testing.assert_array_equal(series(), expected)


def test_many_threads_make_the_same_units() -> None:
    from concurrent.futures import ThreadPoolExecutor

    camera = instrument(detectors=37, field="10 deg", diameter="6 m")

    def prepared() -> tuple[Observation, OfDetectors]:
        o = swept(50.0, 180 + 4 * np.sin(2 * np.pi * np.arange(1000) / 500), camera)
        state = operator(layers=2, lowest="3 km").prepare(o)
        assert isinstance(state, OfDetectors)
        return o, state

    expected = whole(*prepared())
    o, state = prepared()
    with ThreadPoolExecutor(4) as pool:
        for values in pool.map(lambda _: whole(o, state), range(8)):
            np.testing.assert_array_equal(values, expected)


def test_a_thread_that_would_wait_makes_what_comes_next(monkeypatch: pytest.MonkeyPatch) -> None:
    import threading

    camera = instrument(detectors=37, field="10 deg", diameter="6 m")
    o = swept(50.0, 180 + 4 * np.sin(2 * np.pi * np.arange(1000) / 500), camera)
    expected = whole(o, operator(layers=1, lowest="3 km").prepare(o))
    monkeypatch.setattr(fluctuations, "UNIT_SAMPLES", 256)
    state = operator(layers=1, lowest="3 km").prepare(o)
    begun, later, real = threading.Event(), threading.Event(), OfDetectors._draw

    def slow(self: OfDetectors, others: Any, unit: int, number: int) -> Any:
        if number == 0:
            begun.set()
            assert later.wait(60), "nobody made another unit meanwhile"
        else:
            later.set()
        return real(self, others, unit, number)

    monkeypatch.setattr(OfDetectors, "_draw", slow)
    found: list[Floats] = []
    threads = [threading.Thread(target=lambda: found.append(whole(o, state))) for _ in range(2)]
    threads[0].start()
    assert begun.wait(60)
    threads[1].start()
    for thread in threads:
        thread.join()
    for values in found:
        np.testing.assert_array_equal(values, expected)
    assert len(found) == 2


@pytest.mark.parametrize("kept", [128 << 20, 0])
def test_a_pipeline_gives_the_same_bits_in_any_order_of_blocks(
    kept: int, bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Where the units do not all fit, the executor takes blocks of all detectors in order of time,
    # even before a filter in time.
    from zonda.operators.filters.highpass import HighpassFilter

    camera = instrument(detectors=37, field="10 deg", diameter="6 m")
    o = swept(50.0, 180 + 4 * np.sin(2 * np.pi * np.arange(12000) / 4000), camera)
    monkeypatch.setattr(fluctuations, "BYTES_KEPT", kept)
    monkeypatch.setattr(fluctuations, "ALL_KEPT", kept)
    steps = [operator(layers=1, lowest="3 km")]
    state = steps[0].prepare(o)
    assert planning_of(steps[0]).in_time_order(o) is (kept == 0)
    assert [
        s.in_time_order for s in cut([View(Chain([*steps, HighpassFilter(frequency="0.1 Hz")]), o)])
    ] == ([True, False] if kept == 0 else [False])
    kept_streams = bench.run(steps, o, keep=("atmosphere",)).observations[0].detdata["atmosphere"]
    np.testing.assert_allclose(
        kept_streams, whole(o, state, dtype=np.float32).astype(float), rtol=0, atol=0
    )


def directly(op: AtmosphereLayers, o: Observation) -> tuple[Floats, Any, Floats]:
    """(sum of the layers, band, elevation) at every detector and sample."""
    model = op.model(o)
    band, track = model.band, model.plane
    u = rays(axes(o.boresight_azel), o.focalplane.xi, o.focalplane.eta)
    g = np.zeros(u.shape[1:])
    for layer, beam in zip(model.layers, model.turbulence, strict=True):
        across, along = track.positions(crossing(u), o.seconds, layer.height, layer.wind)
        g += layer.amplitude * at_points(beam, across, along)
    return g, band, np.arcsin(u[2])


@pytest.mark.parametrize("angle", [37.0, 180.0])
def test_turning_a_wide_throw_and_the_wind_together_changes_nothing(angle: float) -> None:
    def series(turn: float) -> Floats:
        o = swept(
            50.0,
            turn + back_and_forth(60.0)[:1000],
            instrument(detectors=7, field="2 deg", diameter="6 m"),
        )
        op = operator(
            layers=2, wind={"speed": "12 m/s", "direction": f"{40 + turn} deg"}, tolerance="5 %"
        )
        return whole(o, op.prepare(o))

    one, two = series(0.0), series(angle)
    np.testing.assert_allclose(
        two[:, 160:-160], one[:, 160:-160], atol=2e-6 * one.std()
    )  # float32 splines
    # The path beyond the ends of the scan is extrapolated by components: felt within some steps,
    # far less than the tolerance.
    np.testing.assert_allclose(two, one, atol=5e-3 * one.std())


@pytest.mark.parametrize("direction", [0.0, 90.0, 180.0, 45.0])
def test_wind_along_across_and_against_the_scan(direction: float) -> None:
    # A scan at constant speed s along a parallel of elevation and a wind w: consecutive samples lie
    # |s - w| dt apart on the layer, and so do they on the plane; s = w along the scan would see the
    # same air for ever.
    az = 180 + np.arange(500) * 0.002 / np.cos(np.radians(50.0))
    o = swept(50.0, az, instrument(detectors=1, field="0 deg"))
    track = scan_planes([o])[0]
    speed = np.radians(0.2) * 2000 / np.sin(np.radians(50.0))
    # Looking south with growing azimuth: the line of sight moves west.
    wind = speed * np.array([-np.cos(np.radians(direction)), np.sin(np.radians(direction))])
    u = rays(axes(o.boresight_azel), np.zeros(1), np.zeros(1))
    across, along = track.positions(crossing(u), o.seconds, 2000.0, wind)
    step = np.hypot(np.diff(across[0]), np.diff(along[0])) * 100
    foreshortened = np.array([wind[0], wind[1] * np.sin(np.radians(50.0))])
    expected = np.hypot(-speed - foreshortened[0], -foreshortened[1])
    np.testing.assert_allclose(
        step, expected, atol=0.03 * speed
    )  # the path is an arc: 1.5 deg of azimuth
