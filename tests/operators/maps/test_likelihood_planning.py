"""Plans of maximum-likelihood maps: what they hold, and how long they take."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import zonda
from zonda.core.configuration.pipeline_file import parse
from zonda.core.data import Data
from zonda.core.numerics.quaternions import from_angles
from zonda.core.plan.planner import plan
from zonda.core.plan.planning import planning_of
from zonda.operators.maps import planning
from zonda.operators.maps.grid import Looking
from zonda.operators.maps.maximum_likelihood import MaximumLikelihoodMap
from zonda.operators.maps.noise_record import NoiseRecord
from zonda.operators.maps.normal_equations import NormalEquations, Work
from zonda.plugins.checks.scenes import run, scan, scene

from ...scenes import camera

KEPT = []

CROWDED = f"""\
{camera(76)}operators:
  - PointingDaisy: {{radius: 2 arcmin, speed: 50 arcsec/s, scan_duration: 60 s}}
  - AtmosphereLayers: {{pwv: 5 mm, layers: 2}}
  - WhiteNoise
  - Efficiency
  - MaximumLikelihoodMap: {{pixel: 2 arcsec, half_difference: false, tolerance: 1e-6}}
  - SaveMap
"""


class Keeps(MaximumLikelihoodMap):
    """The map maker; its compressed scans are kept."""

    def finalize(self, data):
        KEPT[:] = data.partial[f"{self.label} scans"].scans
        super().finalize(data)


@pytest.mark.parametrize("stokes", ["I", "IQU"])
@pytest.mark.parametrize("baseline", ["0.1 s", "0.4 s"])
def test_compressed_scans_are_as_large_as_planned(stokes, baseline):
    o, rng = scan(37, 6000, radius=3.0), np.random.default_rng(1)
    o.focalplane.polarization_angle[:] = np.resize(np.radians([0, 90, 45, 135]), 37)
    o.focalplane.polarization_efficiency[:] = 0.9
    noise = 1e-3 * rng.normal(size=(o.n_detectors, o.n_samples))
    step = Keeps(pixel="10 arcsec", stokes=stokes, baseline=baseline, half_difference=False)
    data = run([step], o, noise)
    (one,) = KEPT
    held = one.scan.nbytes + sum(array.nbytes for pair in one.data.values() for array in pair)
    maker = next(m for m in data.pipeline.operators if isinstance(m, Keeps))
    maker.observe(Data(scene(o.instrument), [o]))
    planned = planning_of(maker).compressed(o)
    # an upper bound: a boresight crosses at most 4 / pi as many pixels as it passes, 1.1 of these
    # are planned, and some runs end where baselines do
    assert held < planned < 1.4 * held
    assert f"{planned / 1e9:.3g} GB" in " ".join(planning_of(maker).states([o]))


@pytest.mark.parametrize("projection", ["TAN", "CAR"])
def test_runs_are_counted_on_the_grid(projection):
    """At 75 deg of declination CAR pixels are four times as high as wide, and runs 1.4 times as many
    as those of square pixels of the same area.
    """
    o, turn = scan(37, 6000), 2 * np.pi * np.arange(6000) / 2000
    reach, (ra, dec) = np.radians(0.05), np.radians([75.0, 75.0])
    along = ra + reach * np.cos(turn) / np.cos(dec), dec + reach * np.sin(turn)
    o = replace(o, boresight_radec=from_angles(*along), centre=(float(ra), float(dec)))
    step = MaximumLikelihoodMap(pixel="10 arcsec", projection=projection, baseline="2 s")
    step.observe(Data(scene(o.instrument), [o]))
    pixel = Looking.of(o, step.grid).pixels(np.arange(37), 0, o.n_samples)
    changes = (np.diff(pixel, axis=1) != 0).mean()
    # a tenth more is planned, and 1 / 200 for ends of baselines
    assert changes < planning_of(step).runs(o) < 1.2 * changes + 1 / 200


@pytest.mark.parametrize(
    ("how", "half", "solutions"),
    [
        ({"refine": 0}, False, 1),
        ({}, False, 3),
        ({"refine": 2}, True, 6),
        ({"noise": "simulated"}, False, 1),
    ],
)
def test_the_time_of_products_grows_with_the_samples_and_that_of_the_map_does_not(
    how, half, solutions
):
    step = MaximumLikelihoodMap(pixel="10 arcsec", half_difference=half, **how)
    short, long = scan(37, 3000), scan(37, 12000)

    def over(products, seconds):
        part = Data(scene(short.instrument), [short])
        work = Work(products, seconds)
        part.products["noise_model"] = NoiseRecord(
            [], [], [], np.zeros(0), 0, (1, 0), 1e-4, step.label, "", work
        )
        return part

    plans = planning_of(step)
    plans.whole = over(50, 99.0)
    seconds, words = plans.finishing(2.0, over(10, 0.5), [long, long])
    # 50 products, each of 8 times the slice's samples and of one map
    assert seconds == pytest.approx(50 * (0.05 * 8 + 0.15))
    assert f"about 50 products with the normal equations for {solutions} solutions" in words
    assert f"{0.05 / (37 * 3000) * 1e9:.2g} ns a sample" in words


def test_a_plan_takes_few_products_with_large_maps(monkeypatch):
    """However small the tolerance is, and however many pixels there are. With all iterations and
    patterns in each of the slices, there would be more than 400 products with large maps."""
    products = []
    added = NormalEquations._added

    def counting(self, of):
        products.append(self.n_pixels)
        return added(self, of)

    monkeypatch.setattr(NormalEquations, "_added", counting)
    monkeypatch.setattr(planning, "MOST_COUNTED", 4000)
    file = parse(CROWDED, name="crowded", folder=Path())
    made = plan(file, measure=True)
    assert made.timing is not None
    (words,) = made.timing.basis.values()
    large = [n for n in products if n > 4000 * 1.2]
    assert min(large) > 20_000
    assert len(large) < 80
    # all iterations are counted, on large pixels
    small = len(products) - len(large)
    assert small > 40
    assert f"about {small} products" in words


def test_slices_are_long_enough_for_the_noise():
    """A quarter of the least slice would have too few baselines."""
    step = MaximumLikelihoodMap(pixel="10 arcsec", baseline="0.5 s", trend=3)
    shortest = planning_of(step).shortest
    o = scan(5, int(np.ceil(shortest * 50)))
    o.sample_rate = 50.0
    step.check(Data(scene(o.instrument), []))
    assert step._length(o) == 25
    assert planning_of(zonda.BinMap(pixel="10 arcsec")).shortest == 0
