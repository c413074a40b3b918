"""Pink noise with the knee and the slope of each detector, as a table of `zonda noise` or a focal
plane states them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import zonda
from zonda.core.plan.planning import planning_of
from zonda.core.plan.pointing import context_of
from zonda.core.plan.structure import Structure
from zonda.operators.io.save_tod import load_tod, save_tod
from zonda.operators.noise.estimate import fit, spectrum

pytestmark = pytest.mark.filterwarnings("ignore:Pointing")

KNEES, SLOPES = np.tile([0.0, 0.5, 2.0, 5.0], 5), np.repeat([1.0, 1.7], 10)
"""Of 20 detectors, more than a tile of 16; Hz."""
NET = 1e-3
MEDIAN = float(np.median(KNEES))


def camera(
    folder: Path, knees: Any = KNEES, slopes: Any = SLOPES, dead: Any = (0,) * 20
) -> dict[str, Any]:
    lines = ["name, xi [arcmin], eta [arcmin], knee [Hz], slope, dead"]
    rows = enumerate(zip(knees, slopes, dead, strict=True))
    lines += [f"d{k:02d}, {k / 20}, 0, {knee}, {slope}, {lost}" for k, (knee, slope, lost) in rows]
    path = folder / f"array{len(list(folder.iterdir()))}.csv"
    path.write_text("\n".join(lines))
    return {
        "name": "camera",
        "telescope": {"name": "dish", "diameter": "6 m"},
        "focalplane": str(path),
        "net": f"{NET} K s(1/2)",
        "band": {"name": "b", "low": "130 GHz", "high": "170 GHz"},
        "main_beam_efficiency": 1,
        "illumination_efficiency": 1,
        "sample_rate": "50 Hz",
        "fwhm": "1 arcmin",
    }


def pink(instrument: Any, threads: int = 1, memory: int | None = None, **settings: Any) -> Any:
    scene = zonda.Scene(
        site="atacama",
        instrument=instrument,
        time="2024-06-25T07:00",
        target="az 180 deg el 50 deg",
        seed=1,
    )
    steps = [
        zonda.PointingStare(scan_duration="1600 s"),
        zonda.PinkNoise(**settings),
        zonda.Efficiency(),
    ]
    return zonda.Pipeline(steps).run(scene, threads=threads, memory=memory, keep=["pink"])


@pytest.mark.parametrize("shared", [0.0, 1.0])
def test_each_detector_has_its_own_spectrum(tmp_path: Path, shared: float) -> None:
    """White noise of the NET is added, so that `zonda noise` finds the knee: pulls below 4.5 of 2 x
    15 estimates.

    So has what all have in common: the same deviates, through each detector's filter.
    """
    streams = pink(camera(tmp_path), shared=shared).tod("pink")
    draw = np.random.default_rng(2)
    for row, knee, slope in zip(streams, KNEES, SLOPES, strict=True):
        if knee == 0:
            assert not row.any()
            continue
        row = row + draw.normal(0, NET * np.sqrt(50), len(row))
        found = fit(*spectrum(row, np.ones(len(row), bool), 50.0, 5000))
        assert found is not None
        assert (
            abs(found.knee - knee) < 4.5 * found.knee_error + 0.03 * knee
        )  # the filter's own error, 1.8 %
        assert abs(found.slope - slope) < 4.5 * found.slope_error + 0.05


def test_a_detector_has_the_bits_that_it_has_among_others_alike(tmp_path: Path) -> None:
    """Those with the median's slope and knee; for every number of threads and block size."""
    one = pink(camera(tmp_path)).tod("pink")
    alike = pink(camera(tmp_path, np.full(20, 2.0), np.full(20, 1.7))).tod("pink")
    mine = (KNEES == 2.0) & (SLOPES == 1.7)
    np.testing.assert_array_equal(one[mine], alike[mine])
    half = pink(camera(tmp_path), shared=0.5).tod("pink")
    for threads, memory in ((3, 1 << 30), (1, 4_000_000)):
        np.testing.assert_array_equal(one, pink(camera(tmp_path), threads, memory).tod("pink"))
        np.testing.assert_array_equal(
            half, pink(camera(tmp_path), threads, memory, shared=0.5).tod("pink")
        )


def test_the_step_stands_above_the_focal_plane(tmp_path: Path) -> None:
    one = pink(camera(tmp_path), knee="1 Hz", slope=1.2).tod("pink")
    other = pink(camera(tmp_path, np.ones(20), np.full(20, 1.2))).tod("pink")
    np.testing.assert_array_equal(one, other)


def test_the_plan_counts_the_states_of_each_slope_in_a_tile(tmp_path: Path) -> None:
    """Two slopes in the first tile of 16 detectors (10 and 6), one in the rest."""
    sizes = []
    for slopes in ([1.2] * len(SLOPES), SLOPES):
        instrument = camera(tmp_path, slopes=slopes)
        scene = zonda.Scene(
            site="atacama",
            instrument=instrument,
            time="2024-06-25T07:00",
            target="az 180 deg el 50 deg",
            seed=1,
        )
        steps = [
            zonda.PointingStare(scan_duration="16 s"),
            zonda.PinkNoise(shared=0.5),
            zonda.Efficiency(),
        ]
        pipeline = zonda.Pipeline([*steps, zonda.BinMap(pixel="1 arcmin")])
        context = context_of(pipeline, scene, Structure.of_all(pipeline))
        sizes.append(planning_of(context.operators[1]).memory(context.first))
    assert sizes[1] > sizes[0]


def test_it_is_added_to_what_is_there(tmp_path: Path) -> None:
    """A detector without pink noise of its own keeps the bits of the first step's."""
    scene = zonda.Scene(
        site="atacama",
        instrument=camera(tmp_path),
        time="2024-06-25T07:00",
        target="az 180 deg el 50 deg",
        seed=1,
    )
    first = zonda.PinkNoise(knee="1 Hz", slope=1.2)
    one, both = (
        zonda.Pipeline([zonda.PointingStare(scan_duration="20 s"), *steps, zonda.Efficiency()])
        .run(scene, threads=1, keep=["pink"])
        .tod("pink")
        for steps in ([first], [first, zonda.PinkNoise()])
    )
    for row, knee in enumerate(KNEES):
        assert np.array_equal(one[row], both[row]) == (knee == 0)
    assert one.any(axis=1).all()


def short(instrument: Any, *steps: Any) -> Any:
    scene = zonda.Scene(
        site="atacama",
        instrument=instrument,
        time="2024-06-25T07:00",
        target="az 180 deg el 50 deg",
        seed=1,
    )
    return zonda.Pipeline(
        [zonda.PointingStare(scan_duration="20 s"), *steps, zonda.Efficiency()]
    ).run(scene, threads=1)


def test_slopes_that_differ_are_rounded_to_tenths_of_0_1_to_3(tmp_path: Path) -> None:
    """Recorded data may state any."""
    scene = zonda.Scene(
        site="atacama",
        instrument=camera(tmp_path),
        time="2024-06-25T07:00",
        target="az 180 deg el 50 deg",
        seed=1,
    )
    steps = [
        zonda.PointingStare(scan_duration="20 s"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.SaveTOD(),
    ]
    (path,) = (
        zonda.Pipeline(steps).run(scene, output=tmp_path / "out", threads=1).products["tod_file"]
    )
    tod = load_tod(path)
    tod.columns |= {"knee": np.ones(20), "slope": np.repeat([0.02, 0.96, 1.34, 2.97, 3.4], 4)}
    step = zonda.LoadTOD(file=save_tod(tmp_path / "other.h5", tod), signal="none")
    data = zonda.Pipeline([step, zonda.PinkNoise(poles=16), zonda.Efficiency()]).run(
        step.scene(), threads=1
    )
    np.testing.assert_allclose(
        data.observations[0].focalplane.slope, np.repeat([0.1, 1.0, 1.3, 3.0, 3.0], 4)
    )


@pytest.mark.parametrize(
    ("knees", "slopes", "expected"),
    [
        (np.ones(20), np.ones(20), "(f / 1 Hz)^-1 from"),
        (KNEES, np.ones(20), "knee 0 to 5 Hz; at the median (f / 1.25 Hz)^-1 from"),
        (np.ones(20), SLOPES, "slope 1 to 1.7; at the median (f / 1 Hz)^-1.35 from"),
        (KNEES, SLOPES, "knee 0 to 5 Hz, slope 1 to 1.7; at the median (f / 1.25 Hz)^-1.35 from"),
    ],
)
def test_the_log_says_how_far_detectors_differ(
    tmp_path: Path, knees: Any, slopes: Any, expected: str
) -> None:
    data = short(camera(tmp_path, knees, slopes), zonda.PinkNoise())
    (told,) = [text for _, what, text in data.log if what == "power over that of white noise"]
    assert told.startswith(expected)


def test_the_closed_form_is_the_mean_of_the_detectors_that_work(tmp_path: Path) -> None:
    """As the measured spectra, in which dead detectors are not."""
    dead = np.zeros(20, int)
    dead[[2, 3, 13]] = 1
    (observation,) = short(camera(tmp_path, dead=dead), zonda.PinkNoise()).observations
    assert observation.good_detectors.sum() == 17
    f, (law,) = np.array([0.01, 0.3, 4.0]), observation.closed_forms["pink"]
    used = zip(KNEES[dead == 0], SLOPES[dead == 0], strict=True)
    np.testing.assert_allclose(
        law(f),
        np.mean([2 * NET**2 * (knee / f) ** slope for knee, slope in used], axis=0),
        rtol=1e-9,
    )


def test_the_focal_plane_refers_the_knee_to_the_white_noise(tmp_path: Path) -> None:
    """NET^2 (knee / f)^slope is the same for twice the NET and another knee; the closed form is the
    mean of the detectors.
    """
    (observation,) = short(
        camera(tmp_path), zonda.WhiteNoise(), zonda.PinkNoise(net=f"{2 * NET} K s(1/2)")
    ).observations
    np.testing.assert_allclose(observation.focalplane.knee, KNEES * 2 ** (2 / SLOPES), rtol=1e-12)
    f = np.array([0.01, 0.3, 4.0])
    expected = np.mean(
        [
            2 * (2 * NET) ** 2 * (knee / f) ** slope
            for knee, slope in zip(KNEES, SLOPES, strict=True)
        ],
        axis=0,
    )
    (law,) = observation.closed_forms["pink"]
    np.testing.assert_allclose(law(f), expected, rtol=1e-9)
