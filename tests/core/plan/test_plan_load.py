"""Plans of scenes whose noise depends on the load of the atmosphere: the depth they state, and
bounds audited.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import zonda
from zonda.core.errors import ZondaError
from zonda.core.numerics.smooth import SmoothField
from zonda.core.plan.audit import Checked, audit
from zonda.core.plan.bounds import Depth
from zonda.core.plan.planner import NAME
from zonda.core.plan.structure import only
from zonda.core.signal import Signal

SCENE = """
site: chajnantor
instrument:
  name: cam
  telescope: {{name: dish, diameter: 6 m}}
  band: {{name: b, low: {low} GHz, high: {high} GHz}}
  detectors: 37
  field_of_view: 10 arcmin
  fwhm: 20 arcsec
  main_beam_efficiency: 0.6
  illumination_efficiency: 0.9
  net: 1 mK s(1/2)
  knee: 1 Hz
  sample_rate: 50 Hz
time: 2024-07-25T11:00
target: 05h00m00s -20d00m00s
seed: 3
{budget}
operators:
  - {pointing}
  - WhiteNoise: {white}
  - AtmosphereLayers: {{pwv: 1.5 mm, layers: 3}}
  - PinkNoise
  - Efficiency: {efficiency}
  - HighpassFilter: {{frequency: 0.5 Hz}}
{filters}  - BinMap: {binning}
  - SaveMap
"""
DETECTOR, SKY = "{net: 1 mK s(1/2), reference: detector}", "{net: 1 mK s(1/2)}"
BACKGROUND = "{model: {name: background_limited, telescope_temperature: 10 K}}"
DAISY = "PointingDaisy: {scan_duration: 20 s, radius: 3 arcmin, speed: 1 arcmin/s}"


@pytest.fixture
def scene(tmp_path):
    def load(
        white,
        *,
        low=800,
        high=900,
        budget="",
        pointing=DAISY,
        efficiency="{}",
        filters="",
        binning="{pixel: 8 arcsec}",
        set_=(),
    ):
        path = tmp_path / "scene.yaml"
        path.write_text(
            SCENE.format(
                white=white,
                low=low,
                high=high,
                budget=budget,
                pointing=pointing,
                efficiency=efficiency,
                filters=filters,
                binning=binning,
            )
        )
        return zonda.load(path, overrides=list(set_))

    return load


def ran(file):
    """NET (n_det,) that each observation had, from a run that keeps nothing."""
    file = dataclasses.replace(
        file, steps=tuple(s for s in file.steps if s.key not in ("SaveMap", "HighpassFilter"))
    )
    return [o.focalplane.net for o in file.pipeline().run(file.scene(), threads=1).observations]


@pytest.mark.parametrize("white", [DETECTOR, BACKGROUND])
def test_the_stated_noise_is_that_of_the_run(scene, white):
    """NET times sqrt(f_s) of the run, to 1 %: its transmission is fitted, the plan's taken at some
    instants. A clear sky, whose transmission is 1, would have less than half of it, or nothing of
    the load."""
    file = scene(white)
    made = zonda.plan(file, threads=1)
    (net,) = ran(file)
    assert made.noise[0] == pytest.approx(np.sqrt(np.mean(net**2) * 50.0), rel=0.01)
    clear = zonda.plan(file, threads=1, drop=["AtmosphereLayers"])
    assert clear.noise[0] < made.noise[0] / 2


def test_the_lowest_scan_is_noisiest(scene):
    """Scans of a setting source: the noise of all of them, not of the first."""
    file = scene(
        DETECTOR,
        pointing=(
            "PointingDaisy: {scan_duration: 20 s, scans: 3, gap: 1 h, radius: 3 arcmin, speed: 1"
            " arcmin/s}"
        ),
    )
    made = zonda.plan(file, threads=1)
    nets = ran(file)
    levels = np.array([np.mean(net) for net in nets])
    assert levels.max() > 1.2 * levels.min()
    assert made.noise[0] == pytest.approx(np.sqrt(np.mean(np.square(nets)) * 50.0), rel=0.01)
    assert made.context.noise == pytest.approx(
        levels.min() * np.sqrt(50.0), rel=0.02
    )  # the quietest, over 10 arcmin of field
    assert made.context.fluctuation > levels.max() * np.sqrt(50.0) * 0.99


def test_weights_make_the_map_deeper(scene):
    """By (mean of sigma^2) (mean of sigma^-2): log-normal factors of 40 % differ by that."""
    noisy = "{net: 1 mK s(1/2), reference: detector, scatter: 40 %}"
    weighed = zonda.plan(scene(noisy), threads=1).context.depth
    alike = zonda.plan(
        scene(noisy, binning="{pixel: 8 arcsec, weights: uniform}"), threads=1
    ).context.depth
    (net,) = ran(scene(noisy))
    assert alike.weighed == alike.sample == weighed.sample
    assert weighed.weighed == pytest.approx(np.sqrt(50.0 / np.mean(net**-2.0)), rel=0.01)
    assert weighed.weighed < 0.9 * alike.weighed


@pytest.mark.parametrize(
    ("white", "options"),
    [
        (DETECTOR, {"drop": ["poles"]}),
        (BACKGROUND, {"drop": ["poles", "layer 1"]}),
        ("{net: 1 mK s(1/2), reference: detector, scatter: 30 %}", {"drop": ["PinkNoise"]}),
        (BACKGROUND, {"drop": ["PinkNoise"]}),
        (DETECTOR, {"drop": ["WhiteNoise"]}),
        (BACKGROUND, {"drop": ["AtmosphereLayers"]}),
    ],
)
def test_bounds_hold_under_load(scene, white, options):
    """The planner took the level behind a clear sky: the bound of the pink noise was a third of its
    error and less.
    """
    file = scene(white)
    made = zonda.plan(file, threads=1, **options)
    found = audit(file, made, threads=1)
    assert not found.violated, str(found)
    effects = {r.effect for r in found.rows}
    for name in options["drop"]:
        assert effects & {f"{name}.{NAME}", f"PinkNoise.{name}", f"AtmosphereLayers.{name}"}, str(
            found
        )
    assert "structure" not in effects
    assert ("white noise" in effects) == ("WhiteNoise" not in options["drop"])


@pytest.mark.parametrize("white", [DETECTOR, BACKGROUND])
def test_a_stated_budget_is_kept(scene, white):
    """Of so many kelvin that the pink noise behind a clear sky would fit, and that under the load
    does not.
    """
    probe = zonda.plan(scene(white), threads=1, drop=["poles"])
    (pink,) = [d for d in probe.decided if d.effect.name == "poles"]
    file = scene(
        white, budget=f"budget: {{map_rms: {pink.choice.bound['map_rms'] / 2:.3g} K, peak: 1000 K}}"
    )
    made = zonda.plan(file, threads=1)
    assert "PinkNoise" in made.operators
    assert made.bands[""].spent["map_rms"] <= made.bands[""].limits["map_rms"]
    found = audit(file, made, threads=1)
    assert not found.violated, str(found)


@pytest.mark.parametrize("efficiency", ["{scatter: 20 %}", "{calibration_error: 10 %}"])
def test_gains_that_differ_leave_what_the_detectors_have_in_common(scene, efficiency):
    """The detectors' mean takes out what they see alike only where their gains are equal."""
    filters = "  - CommonModeFilter: {method: mean}\n"
    file = scene(
        SKY,
        low=200,
        high=240,
        efficiency=efficiency,
        filters=filters,
        set_=["AtmosphereLayers.pwv_rms=3 %"],
    )
    found = audit(file, zonda.plan(file, threads=1, drop=["layer 0"]), threads=1)
    assert not found.violated, str(found)
    even = scene(SKY, low=200, high=240, filters=filters, set_=["AtmosphereLayers.pwv_rms=3 %"])
    bounds = [
        next(d for d in zonda.plan(f, threads=1).decided if d.effect.name == "layer 0").effect.size[
            "tod"
        ]
        for f in (even, file)
    ]
    assert bounds[1] > 1.2 * bounds[0]


def test_what_is_dropped_whole_is_charged_its_effects(scene):
    """It was charged to what no output depends on, whose bound is rounding: every audit was
    violated.
    """
    file = scene(SKY)
    made = zonda.plan(file, threads=1, drop=["PinkNoise"])
    (pink,) = [d for d in made.decided if d.operator == "PinkNoise"]
    (poles,) = [d for d in zonda.plan(file, threads=1).decided if d.operator == "PinkNoise"]
    assert pink.choice.bound == poles.effect.size
    assert made.bands[""].spent["map_rms"] >= pink.choice.bound["map_rms"]
    assert "PinkNoise" not in made.operators
    assert "PinkNoise" not in [s.key for s in made.apply(file).steps]
    assert "PinkNoise" not in made.operators
    assert zonda.plan(file, threads=1, drop=["WhiteNoise", "PinkNoise"]).noise[0] == 0.0


def pink_rms(file):
    """rms of the pink noise at the detector, mK, as the run states it."""
    file = dataclasses.replace(
        file, steps=tuple(s for s in file.steps if s.key not in ("SaveMap", "HighpassFilter"))
    )
    log = file.pipeline().run(file.scene(), threads=1).log
    (text,) = (
        text
        for name, what, text in log.figures()
        if name == "PinkNoise" and what.startswith("rms at the detector")
    )
    return float(text)


@pytest.mark.parametrize("white", ["{net: 3 mK s(1/2)}", BACKGROUND])
def test_a_component_alone_keeps_its_level(scene, white):
    """Pink noise that refers to the white noise, and noise under the load of the atmosphere, though
    neither is simulated.
    """
    file = scene(white)
    header = file.header.model_copy(update={"runs": {"pink_alone": Signal(only=["pink"])}})
    alone = only(file, ["pink"])
    assert pink_rms(alone) == pink_rms(file)
    bare = [
        dataclasses.replace(f, steps=file.steps[:-1])
        for f in (alone, dataclasses.replace(file, header=header))
    ]
    narrowed, whole = (f.pipeline().run(f.scene(), threads=1).products for f in bare)
    np.testing.assert_array_equal(narrowed["map"].signal, whole["pink_alone/map"].signal)


@pytest.mark.parametrize("white", ["{net: 3 mK s(1/2)}", BACKGROUND])
def test_without_white_noise_pink_noise_has_the_level_of_the_plan(scene, white):
    """It then refers to the instrument's NET, in the run as in what the plan charges; their
    difference is within the bound.
    """
    file = scene(white)
    made = zonda.plan(file, threads=1, drop=["WhiteNoise"])
    (charged,) = [d for d in made.decided if d.operator == "WhiteNoise"]
    alike = made.apply(scene("{net: 1 mK s(1/2)}"))  # the instrument's NET
    assert pink_rms(made.apply(file)) == pink_rms(alike)
    left = zonda.plan(made.apply(file), threads=1).context.traits["PinkNoise"].rms
    full = zonda.plan(file, threads=1).context
    change = full.bound(abs(full.traits["PinkNoise"].rms - left))["map_rms"]
    assert charged.choice.bound["map_rms"] >= change > 0


@pytest.mark.parametrize(
    ("name", "words"),
    [("Efficiency", "HighpassFilter reads its signal"), ("PointingDaisy", "boresight")],
)
def test_what_others_cannot_do_without_is_not_dropped(scene, name, words):
    with pytest.raises(ZondaError, match=words):
        zonda.plan(scene(SKY), threads=1, drop=[name])


def test_a_stare_has_its_hits_where_its_detectors_pass(scene):
    """Detectors far apart cover little of the map's extent: hits are counted where there are
    any.
    """
    file = scene(SKY, pointing="PointingStare: {scan_duration: 20 s}")
    made = zonda.plan(file, threads=1)
    bare = dataclasses.replace(file, steps=tuple(s for s in file.steps if s.key != "SaveMap"))
    hits = bare.pipeline().run(bare.scene(), threads=1).products["map"].hits
    # the grid of the map lies otherwise than that on which pixels are counted: a streak falls into
    # one row of pixels or two
    assert made.noise[2] == pytest.approx(np.quantile(hits[hits > 0], 0.9), rel=0.5)


def test_a_smoothed_map_is_not_what_the_noise_is_stated_of(scene):
    file = scene(SKY, binning="{pixel: 8 arcsec, smooth: beam}")
    found = audit(file, zonda.plan(file, threads=1), threads=1)
    assert not any(row.effect == "white noise" for row in found.rows)


def test_a_prediction_is_missed_on_either_side():
    row = Checked("white noise", "of the plan", "map_rms", 1.0, 1.1, 0.01, within=0.2)
    assert (row.verdict, row.violated) == ("agrees", False)
    for actual in (0.7, 1.3):
        assert dataclasses.replace(row, actual=actual).verdict == "DISAGREES"
    assert Depth(0.0, 0.0).sample == 0.0


def test_the_largest_mean_emission_takes_no_memory_for_all_instants(scene):
    """Of 3000 nodes the one where the emission peaks counts; 2000 detectors at all of them would be
    48 MB for each field.
    """
    import copy
    import tracemalloc

    made = zonda.plan(scene(SKY), threads=1)
    (o,) = made.context.observations
    n_det, nodes, peak = (
        2000,
        3000,
        1111,
    )  # not among the 64 that are evenly spaced: 1111 is no multiple of 2999 / 63
    observation = copy.copy(o)
    observation.focalplane = copy.copy(o.focalplane)
    observation.focalplane.main_beam_efficiency = np.full(n_det, 0.6)
    observation.focalplane.illumination_efficiency = np.full(n_det, 0.9)
    emission = np.full((1, nodes), 20.0)
    emission[0, peak] = 30.0
    weights = np.linspace(0.5, 1.0, n_det)[:, None]
    observation.smooth = {
        "atmosphere": SmoothField(weights, emission, 64, o.n_samples),
        "transmission": SmoothField(np.ones((n_det, 1)), emission * -0.01 + 1, 64, o.n_samples),
    }
    context = dataclasses.replace(made.context, observations=[observation])
    tracemalloc.start()
    found = context.mean_emission
    _, held = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found == pytest.approx(0.9 / 0.6 * 30.0 / 0.7)
    assert held < 12e6
