"""Every effect of a survey has a row in `zonda plan` with a bound that follows its parameters."""

from __future__ import annotations

import numpy as np
import pytest

import zonda
from zonda.core.plan.audit import audit
from zonda.core.plan.planning import planning_of
from zonda.core.plan.pointing import context_of
from zonda.core.plan.structure import Structure

CAMERA = {
    "name": "camera",
    "telescope": {"name": "dish", "diameter": "6 m"},
    "band": {"name": "b", "low": "130 GHz", "high": "170 GHz"},
    "polarization": "pairs",
    "detectors": 38,
    "field_of_view": "20 arcmin",
    "main_beam_efficiency": 0.8,
    "illumination_efficiency": 0.9,
    "net": "300 uK s(1/2)",
    "knee": "0.2 Hz",
    "sample_rate": "50 Hz",
}
SKY = np.zeros((3, 60, 60))
SKY[:, 28:32, 28:32] = np.array([2e-3, 1e-3, -5e-4])[:, None, None]


def scene():
    return zonda.Scene(
        site="llano_de_chajnantor",
        instrument=CAMERA,
        time="2022-08-01T11:00",
        target="75d -30d",
        seed=2,
    )


def sizes(step: zonda.Operator) -> dict[str, dict[str, float]]:
    """By effect of a step, the bound on what leaving it out costs, in a pipeline with sky,
    atmosphere and noise.
    """
    places: dict[type, int] = {
        zonda.HalfWavePlate: 0,
        zonda.Leakage: 1,
    }  # the others act on the calibrated signal
    front, middle, behind = ([step] if places.get(type(step), 2) == k else [] for k in range(3))
    steps = [
        zonda.PointingDaisy(radius="20 arcmin", speed="10 arcmin/s", scan_duration="20 s"),
        zonda.SkyMap(
            map=SKY,
            unit="K_RJ",
            pixel_size="1 arcmin",
            centre="target",
            polarization_convention="cosmo",
        ),
        *front,
        zonda.AtmosphereLayers(pwv="1 mm"),
        *middle,
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        *behind,
        zonda.HighpassFilter(frequency="0.2 Hz"),
        zonda.BinMap(pixel="1 arcmin", stokes="IQU"),
    ]
    pipeline = zonda.Pipeline(steps)
    context = context_of(pipeline, scene(), Structure.of_all(pipeline))
    mine = next(o for o in context.operators if type(o) is type(step))
    found = planning_of(mine).estimate(context)
    return {effect.name: dict(effect.size) for effect in found.effects}


@pytest.mark.parametrize(
    ("small", "large", "effect", "metric", "ratio"),
    [
        (zonda.Leakage(share="1 %"), zonda.Leakage(share="3 %"), "leakage", "tod", 3),
        (zonda.Crosstalk(level="0.1 %"), zonda.Crosstalk(level="0.5 %"), "crosstalk", "tod", 5),
        (zonda.GainDrift(rms="0.1 %"), zonda.GainDrift(rms="0.4 %"), "gain drift", "tod", 4),
    ],
)
def test_bounds_follow_the_parameters(small, large, effect, metric, ratio):
    one, other = sizes(small)[effect], sizes(large)[effect]
    assert one[metric] > 0
    assert other[metric] == pytest.approx(ratio * one[metric], rel=1e-9)


@pytest.mark.parametrize(
    ("step", "effect"),
    [
        (zonda.PolynomialFilter(order=2), "polynomials"),
        (zonda.GroundFilter(), "template in azimuth"),
        (zonda.TimeConstant(), "time constant"),
    ],
)
def test_filters_say_what_leaving_them_out_costs(step, effect):
    size = sizes(step)[effect]
    assert all(v > 0 for v in size.values())
    assert size["transfer"] <= 1


def test_a_half_wave_plate_changes_at_most_twice_the_sky():
    """The brightest pixel of I is 2 mK before the beam: polarized, it cannot be brighter."""
    size = sizes(zonda.HalfWavePlate(frequency="2 Hz"))["half-wave plate"]
    assert 0 < size["tod"] <= 2 * 2e-3 * (1 + 1e-9)


def test_crosstalk_of_a_table_is_bounded_by_the_detector_with_most(tmp_path):
    """Two sources of 1 % and -2 % for one detector: 3 %, though the sum is -1 %."""
    names = zonda.Instrument(**CAMERA).focalplane().names
    rows = [(names[0], names[3], 0.01), (names[0], names[7], -0.02), (names[5], names[6], 0.005)]
    (tmp_path / "shares.csv").write_text(
        "detector, source, share\n" + "\n".join(f"{a}, {b}, {c}" for a, b, c in rows) + "\n"
    )
    table = sizes(zonda.Crosstalk(file=tmp_path / "shares.csv"))["crosstalk"]
    level = sizes(zonda.Crosstalk(level="0.5 %"))["crosstalk"]
    assert table["transfer"] == pytest.approx(0.03)
    assert level["transfer"] == pytest.approx(
        0.06
    )  # pairs: six neighbouring pixels have twelve detectors
    assert table["tod"] == pytest.approx(level["tod"] / 2)


def test_bound_of_leakage_holds(tmp_path):
    """With and without it, a slice simulated: the stream, and the map of I, change by less than
    stated.
    """
    path = tmp_path / "leak.yaml"
    path.write_text("""
site: llano_de_chajnantor
instrument: {name: c, telescope: {name: dish, diameter: 6 m}, band: {name: b, low: 130 GHz, high: 170 GHz}, polarization: pairs,
  detectors: 38, field_of_view: 20 arcmin, main_beam_efficiency: 0.8, illumination_efficiency: 0.9, net: 300 uK s(1/2),
  sample_rate: 50 Hz}
time: 2022-08-01T11:00
target: 75d -30d
operators:
  - PointingDaisy: {radius: 20 arcmin, speed: 10 arcmin/s, scan_duration: 20 s}
  - AtmosphereLayers: {pwv: 1 mm}
  - Leakage: {share: 2 %}
  - WhiteNoise
  - Efficiency
  - HighpassFilter: {frequency: 0.2 Hz}
  - BinMap: {pixel: 1 arcmin, stokes: IQU}
  - SaveMap
""")
    file = zonda.load(path)
    made = zonda.plan(file, prune_all=False, drop=["Leakage"], threads=1)
    found = audit(file, made, threads=1)
    rows = [r for r in found.rows if r.effect.startswith("Leakage")]
    assert {r.metric for r in rows} >= {"tod", "map_rms"}
    assert not found.violated, str(found)
    assert next(r for r in rows if r.metric == "tod").actual > 0
