"""What must hold end to end for any scene: small runs of the whole chain, a few examples each.

Properties of single operators are tested beside them; these are of pipelines.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import zonda
from zonda.core.configuration.time import Instant
from zonda.core.data import Data, Observation
from zonda.core.operator import Operator
from zonda.plugins.checks import scenes
from zonda.plugins.checks.scenes import camera, differing, scan, sky_file

from .checks import determinism as campaigns

few = settings(
    max_examples=3, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
seeds = st.integers(0, 2**62)
WIND = {"speed": "12 m/s", "direction": "200 deg"}
PLANES = ("signal", "hits", "weights", "noise")


def chain(*sky: Operator, filters: tuple[Operator, ...] = (), **binning: Any) -> list[Operator]:
    air = zonda.AtmosphereLayers(pwv="7.7 mm", layers=2, wind=WIND)
    return [
        *sky,
        air,
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
        *filters,
        zonda.BinMap(**{"pixel": "5 arcsec", **binning}),
    ]


def run(steps: list[Operator], observation: Observation, **settings: Any) -> Data:
    return scenes.run(steps, observation, **{"precision": "float64", **settings})


def blobs(seed: int, n: int = 121) -> np.ndarray:
    """Some Gaussian sources and a slope, K_RJ, 2 arcsec pixels."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((n, n)) - n // 2
    sky = 1e-4 * rng.standard_normal() * x / n
    for _ in range(5):
        a, b = rng.uniform(-40, 40, 2)
        sky = sky + 1e-3 * rng.standard_normal() * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 50)
    return sky


@few
@given(seed=seeds, a=st.floats(-3, 3), b=st.floats(-3, 3))
def test_linear_in_the_sky_without_singular_modes(seed: int, a: float, b: float) -> None:
    """map(a s1 + b s2 + rest) = a map(s1 + rest) + b map(s2 + rest) + (1 - a - b) map(rest), the
    same air over each sky.
    """
    one, two = blobs(seed), blobs(seed + 1)

    def mapped(sky: np.ndarray) -> np.ndarray:
        with sky_file(sky, 2.0) as path:
            data = run(
                chain(zonda.SkyMap(file=path), filters=(zonda.HighpassFilter(),)),
                scan(19, 3000, radius=1),
            )
        return data.products["map"].signal

    whole = mapped(a * one + b * two)
    parts = a * mapped(one) + b * mapped(two) + (1 - a - b) * mapped(np.zeros_like(one))
    # float64; the sums are rounded to 1.5e-11 K a sample, times |a| + |b| + |1 - a - b| + 1 <= 14
    assert np.nanmax(abs(whole - parts)) < 3e-10
    assert np.array_equal(np.isnan(whole), np.isnan(parts))


@few
@given(seed=seeds, a=st.floats(-3, 3))
def test_linear_in_the_sky_with_frozen_modes(seed: int, a: float) -> None:
    """With the modes of the complete data, map(sky + white + pink) = map(sky) + map(white) +
    map(pink), for any sky.

    float64. The sums of w d are rounded to 2^-36 K a sample, w >= 2^(-1/2), so each map errs by at
    most 2^-37 2^(1/2) = 1e-11 K; filters round signals of 0.1 K to 2^-53 of it in each of about a
    hundred additions, 1e-15 K.
    """
    kinds = {"sky": ["sky"], "white": ["white"], "pink": ["pink"]}
    runs: dict[str, Any] = {name: {"only": only, "modes": "full"} for name, only in kinds.items()}
    runs |= {"rest": {"without": ["sky"], "modes": "full"}, "alone": {"only": ["sky"]}}
    points = scenes.Points()
    points._observation = scan(19, 3000, radius=1)
    points._observation.seed = seed
    with sky_file(blobs(seed), 2.0) as path:
        steps = [
            points,
            zonda.SkyMap(file=path, scale=a),
            zonda.WhiteNoise(scatter=0.1),
            zonda.PinkNoise(shared=0.9),
        ]
        filters = [
            zonda.HighpassFilter(),
            zonda.CommonModeFilter(modes=2, on_undetermined="remove"),
        ]
        steps += [zonda.Efficiency(), *filters, zonda.BinMap(pixel="5 arcsec")]
        data = zonda.Pipeline(steps, runs=runs, precision="float64").run(
            scenes.scene(camera(19)), threads=1
        )
    maps = {name: data.products[f"{name}/map"].signal for name in runs} | {
        "": data.products["map"].signal
    }
    assert np.nanmax(abs(maps["sky"] + maps["rest"] - maps[""])) < 5e-11
    assert np.nanmax(abs(maps["white"] + maps["pink"] - maps["rest"])) < 5e-11
    assert all(
        np.array_equal(np.isnan(m), np.isnan(maps[""]))
        for name, m in maps.items()
        if name != "alone"
    )
    if abs(a) > 0.1:
        assert np.nanmax(abs(maps["alone"] - maps["sky"])) > 1e-6, "the sky's own modes are others"


@few
@given(angle=st.floats(1, 359), azimuth=st.floats(0, 360), elevation=st.floats(30, 80))
def test_turning_scan_wind_and_field_together_changes_nothing(
    angle: float, azimuth: float, elevation: float
) -> None:
    def air(turn: float) -> np.ndarray:
        wind = {"speed": "12 m/s", "direction": f"{200 + turn} deg"}
        layers = zonda.AtmosphereLayers(pwv="7.7 mm", layers=2, wind=wind)
        o = scan(7, 2500, azimuth=azimuth + turn, elevation=elevation)
        return run([layers], o, keep=("atmosphere",)).observations[0].detdata["atmosphere"]

    # Rounding alone. A turned direction errs by some eps; a layer is seen at up to 5 km / tan(30 deg)
    # = 9 km, so positions err by some 1e-11 m. The field, 0.3 K at most, changes over the beam's
    # sigma of some metres: by less than 0.3 K x 1e-11 m / 1 m = 3e-12 K.
    np.testing.assert_allclose(air(angle), air(0.0), rtol=0, atol=3e-12)


@few
@given(samples=st.integers(1, 30_000), nanoseconds=st.integers(0, 10**9))
def test_the_time_of_day_alone_changes_no_bit_of_noise_and_air(
    samples: int, nanoseconds: int
) -> None:
    """Random numbers and drift count from the start of the run: the same scan later has the same
    streams.
    """

    def streams(start: Instant) -> dict[str, np.ndarray]:
        o = scan(7, samples)
        o.start = start
        data = run(chain()[:-1], o, keep=("white", "pink", "atmosphere", "signal"))
        return data.observations[0].detdata

    now, later = (streams(Instant(scenes.START.nanoseconds + shift)) for shift in (0, nanoseconds))
    for name, stream in now.items():
        assert differing(stream, later[name]) == 0, name


@few
@given(declination=st.floats(-40, 80), whole_turns=st.sampled_from([-1, 1, 2]))
def test_right_ascension_and_full_turns(declination: float, whole_turns: int) -> None:
    """The same target, 360 deg on: the same bits where the value is exact (75 deg), 1e-12 rad where
    it is not.
    """

    def pointed(ra: float) -> Observation:
        scene = scenes.scene(camera(3), target=f"{ra!r} deg {declination!r} deg")
        data = Data(scene.model_copy(update={"site": ANYWHERE}))
        zonda.PointingDaisy(scan_duration="2 s").observe(data)
        return data.observations[0]

    for ra, allowed in ((75.0, 0.0), (75.1, 1e-12)):
        one, other = pointed(ra), pointed(ra + 360.0 * whole_turns)
        for name in ("boresight_azel", "boresight_radec"):
            assert abs(getattr(one, name) - getattr(other, name)).max() <= allowed


ANYWHERE = scenes.SITE.model_copy(
    update={"latitude": np.radians(20.0), "longitude": np.radians(-50.0)}
)
"""From where the targets above are up at that time."""


@few
@given(seed=seeds)
def test_the_order_of_detectors_changes_no_map(seed: int) -> None:
    """Places and signals permuted alike: the same bits without singular modes, rounding with
    them.
    """
    rng = np.random.default_rng(seed)
    order = rng.permutation(19)
    common = np.cumsum(rng.standard_normal(3000)) * 1e-2
    signal = common * (1 + 0.1 * rng.standard_normal((19, 1))) + 1e-2 * rng.standard_normal(
        (19, 3000)
    )

    def mapped(places: np.ndarray, *filters: Operator) -> Any:
        o = scan(19, 3000)
        xi, eta = o.focalplane.xi[places], o.focalplane.eta[places]
        return scenes.run(
            [*filters, zonda.BinMap(pixel="5 arcsec", width="14 arcmin")],
            scan(19, 3000, offsets=(xi, eta)),
            signal[places],
        )

    same = np.arange(19)
    for filters in ((), (zonda.HighpassFilter(),)):
        one, other = (mapped(p, *filters).products["map"] for p in (same, order))
        assert sum(differing(getattr(one, plane), getattr(other, plane)) for plane in PLANES) == 0
    modes = (zonda.HighpassFilter(), zonda.CommonModeFilter(residual=1e-11))
    one, other = (mapped(p, *modes).products["map"] for p in (same, order))
    assert np.array_equal(one.hits, other.hits)
    # |du| <= residual / (1 - (sigma_2 / sigma_1)^2) <= 2e-11 in either run, times v <= sqrt(19) max
    # |signal|; sums to 1.5e-11 K
    np.testing.assert_allclose(
        one.signal, other.signal, rtol=0, atol=4e-11 * np.sqrt(19) * abs(signal).max() + 3e-11
    )


@few
@given(threads=st.integers(1, 6), megabytes_each=st.integers(5, 20), seed=seeds)
def test_blocks_and_threads_change_no_bit(threads: int, megabytes_each: int, seed: int) -> None:
    filters = (zonda.HighpassFilter(), zonda.CommonModeFilter())
    o = [scan(37, 5000) for _ in range(2)]
    for each in o:
        each.seed = seed
    one = run(chain(filters=filters), o[0], precision="float32")
    other = run(
        chain(filters=filters),
        o[1],
        precision="float32",
        threads=threads,
        memory=threads * megabytes_each * 1_000_000,
    )
    assert (
        sum(
            differing(getattr(one.products["map"], p), getattr(other.products["map"], p))
            for p in PLANES
        )
        == 0
    )


@pytest.mark.nightly
@few
@given(workers=st.integers(1, 7))
def test_workers_change_no_bit_of_a_campaign(workers: int) -> None:
    """Tasks are done in whatever order the threads take them; the whole file is compared, log and
    headers too.
    """
    from concurrent.futures import ThreadPoolExecutor

    with TemporaryDirectory() as folder, ThreadPoolExecutor(workers) as executor:
        assert (
            campaigns._campaign(Path(folder) / "out", executor, workers)
            == campaigns._campaign_once()
        )


def whitened(stream: np.ndarray) -> np.ndarray:
    """Second differences of each detector, which leave nothing slow: rows of unit variance."""
    d = np.diff(np.asarray(stream, np.float64), 2, axis=1)
    return (d - d.mean(axis=1, keepdims=True)) / d.std(axis=1, keepdims=True)


@few
@given(seed=seeds)
def test_operators_observations_and_seeds_share_nothing(seed: int) -> None:
    """White and pink noise of two operators, two observations, two seeds: uncorrelated within the
    standard error.

    Second differences of white noise have, over lags, a sum of squared autocorrelations of 35/18;
    so r^2 = 35/18 / n.
    """
    made = []
    for number, index in ((seed, 0), (seed, 1), (seed + 1, 0)):
        o = scan(7, 20_000)
        o.seed, o.index = number, index
        steps = [zonda.WhiteNoise(), zonda.PinkNoise()]
        data = run(list(steps), o, keep=("white", "pink"))
        again = scan(7, 20_000)
        again.seed, again.index = number, index
        other = run(
            [zonda.WhiteNoise(name="other"), zonda.PinkNoise(name="another")],
            again,
            keep=("white", "pink"),
        )
        made += [
            whitened(d.observations[0].detdata[name])
            for d in (data, other)
            for name in ("white", "pink")
        ]
    error = np.sqrt(35 / 18 / made[0].size)
    for k, one in enumerate(made):
        for other_stream in made[k + 1 :]:
            assert abs((one * other_stream).mean()) < 5 * error
        assert abs((one * np.roll(one, 1, axis=0)).mean()) < 5 * error  # neighbours


@few
@given(seed=seeds)
def test_the_air_of_two_operators_and_two_seeds_is_unlike(seed: int) -> None:
    """Air is smooth: 200 s at 200 m/s past r0 = 50 m (behind a beam of 42 m) hold at least 40 km /
    (pi 100 m) = 127 pieces.
    """

    def air(number: int, **name: Any) -> np.ndarray:
        o = scan(1, 20_000, radius=0)
        o.seed = number
        layers = zonda.AtmosphereLayers(
            pwv="7.7 mm",
            layers=1,
            lowest="1 km",
            outer_scale="50 m",
            wind={"speed": "200 m/s"},
            **name,
        )
        series = run([layers], o, keep=("atmosphere",)).observations[0].detdata["atmosphere"][0]
        return (series - series.mean()) / series.std()

    one = air(seed)
    for other in (air(seed + 1), air(seed, name="other")):
        assert abs((one * other).mean()) < 5 / np.sqrt(127)
    assert differing(one, air(seed)) == 0


pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
