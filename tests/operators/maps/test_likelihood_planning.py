"""Plans of maximum-likelihood maps: what they hold, and how long they take."""

import numpy as np
import pytest

import zonda
from zonda.core.data import Data
from zonda.core.plan.planning import planning_of
from zonda.operators.maps.maximum_likelihood import MaximumLikelihoodMap
from zonda.plugins.checks.scenes import run, scan, scene

KEPT = []


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


@pytest.mark.parametrize(
    ("how", "half", "solutions"),
    [
        ({"refine": 0}, False, 1),
        ({}, False, 2),
        ({"refine": 2}, True, 4),
        ({"noise": "simulated"}, False, 1),
    ],
)
def test_the_time_of_iterations_grows_with_the_samples(how, half, solutions):
    step = MaximumLikelihoodMap(pixel="10 arcsec", half_difference=half, **how)
    short, long = scan(37, 3000), scan(37, 12000)
    part = Data(scene(short.instrument), [short])
    part.log.state(step.label, "iterations", "20")
    seconds, words = planning_of(step).finishing(2.0, part, [long, long])
    assert seconds == pytest.approx(2.0 * 8)
    each = 2.0 / (37 * 3000 * 20 * solutions) * 1e9
    assert f"about 20 iterations for each of {solutions} solutions" in words
    assert f"{each:.2g} ns a sample" in words


def test_slices_are_long_enough_for_the_noise():
    """A quarter of the least slice would have too few baselines."""
    step = MaximumLikelihoodMap(pixel="10 arcsec", baseline="0.5 s", trend=3)
    shortest = planning_of(step).shortest
    o = scan(5, int(np.ceil(shortest * 50)))
    o.sample_rate = 50.0
    step.check(Data(scene(o.instrument), []))
    assert step._length(o) == 25
    assert planning_of(zonda.BinMap(pixel="10 arcsec")).shortest == 0
