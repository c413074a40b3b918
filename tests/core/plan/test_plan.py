"""The planner: what it chooses, what it says, what it refuses; and every bound against the error
itself.
"""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

import zonda
from zonda.core import cli
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.loaded import Limits
from zonda.core.data import Data
from zonda.core.errors import ZondaError
from zonda.core.plan import decide as deciding
from zonda.core.plan.bounds import Choice, Context, Coverage, Effect, Saving, figure, full, kelvin
from zonda.core.plan.decide import Decided, limits
from zonda.core.plan.planner import for_run
from zonda.core.plan.pointing import cover, samples_of

SHORT = ["PointingDaisy.scan_duration=40 s", "PointingDaisy.scans=1"]


@pytest.fixture(scope="module")
def file():
    return zonda.load("mustang2_cluster", overrides=SHORT)


@pytest.fixture(scope="module")
def made(file):
    return zonda.plan(file, threads=1)


# ---- choosing


def decide(effects, allowed, **options):
    (found,) = deciding.decide([[Decided("A", e) for e in effects]], [allowed], **options)
    return {d.effect.name: d for d in found}


def effect(name, *coarser):
    """Forms by (bound, share that they saved; 0: they save nothing in this scene)."""
    choices = [
        Choice(
            "coarse",
            f"{name} {k}",
            {"k": k},
            bound={"map_rms": b},
            saves=Saving("a scene", s) if s else None,
        )
        for k, (b, s) in enumerate(coarser)
    ]
    return Effect(name, (full("in full"), *choices))


def test_the_largest_saving_first_and_within_the_budget():
    found = decide(
        [
            effect("small", (0.2, 0.03)),
            effect("large", (0.9, 0.2)),
            effect("smaller", (0.05, 0.02)),
        ],
        {"map_rms": 1.0},
    )
    assert {name: d.chosen for name, d in found.items()} == {"small": 0, "large": 1, "smaller": 1}
    assert found["small"].reason == "coarser exceeds the budget"


def test_of_equal_savings_the_smallest_error_first():
    found = decide(
        [effect(f"layer {k}", (b, 0.1)) for k, b in enumerate((0.6, 0.2, 0.5))], {"map_rms": 1.0}
    )
    assert [d.chosen for d in found.values()] == [0, 1, 1]


def test_the_form_that_saves_most_of_those_that_fit():
    forms = (0.1, 0.1), (0.5, 0.2), (2.0, 0.5)
    assert decide([effect("one", *forms)], {"map_rms": 1.0})["one"].chosen == 2


def test_a_form_of_several_bands_is_the_finest_that_one_of_them_needs():
    """Forms are matched by their settings; one that a band lacks is not offered."""
    low, high = effect("one", (0.1, 0.01), (0.2, 0.5)), effect("one", (0.1, 0.01), (2.0, 0.5))
    alone = effect("other", (0.1, 0.5))
    bands = [[Decided("A", low), Decided("A", alone)], [Decided("A", high)]]
    found = deciding.decide(bands, [{"map_rms": 1.0}] * 2)
    assert [[d.chosen for d in band] for band in found] == [[1, 0], [1]]
    assert found[0][1].reason == "coarser exceeds the budget of a band"
    found = deciding.decide(bands, [{"map_rms": 1.0}, {"map_rms": 0.0}])
    assert [[d.chosen for d in band] for band in found] == [[0, 0], [0]]
    found = deciding.decide(bands, [{"map_rms": 1.0}, {"map_rms": 3.0}])
    assert [[d.chosen for d in band] for band in found] == [[2, 0], [2]]
    found = deciding.decide(bands, [{"map_rms": 1.0}] * 2, forced={"A.one", "A.other"})
    assert [[d.chosen for d in band] for band in found] == [[2, 0], [2]]
    assert found[0][0].reason == found[1][0].reason == "--drop"
    assert found[0][1].reason == "--drop: the bands have no coarser form in common"


def test_no_saving_no_error():
    found = decide([effect("free", (0.1, 0))], {"map_rms": 1.0})["free"]
    assert found.chosen == 0
    assert found.reason == "coarser only with --drop"


def test_seconds_that_a_planning_class_states_are_tried_last():
    """Plugins of before state seconds: more than none is a saving, after those that are measured."""
    old = Choice("coarse", "old", {"k": 1}, bound={"map_rms": 0.6}, seconds=1e9)
    idle = Choice("coarse", "idle", {"k": 1}, bound={"map_rms": 0.0})
    effects = [Effect("old", (full("x"), old)), Effect("idle", (full("x"), idle))]
    assert [d.chosen for d in decide(effects, {"map_rms": 1.0}).values()] == [1, 0]
    found = decide([*effects, effect("measured", (0.5, 0.02))], {"map_rms": 1.0})
    assert [d.chosen for d in found.values()] == [0, 0, 1]


def test_a_budget_of_nothing_takes_what_costs_nothing():
    found = decide([effect("exact", (0.0, 0.1)), effect("error", (1e-30, 0.1))], {"map_rms": 0.0})
    assert found["exact"].chosen == 1
    assert found["error"].chosen == 0


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bound_that_is_not_a_number_allows_nothing(bad):
    assert decide([effect("one", (bad, 0.5))], {"map_rms": 1.0})["one"].chosen == 0


def test_every_metric_has_its_own_budget():
    choice = Choice(
        "dropped", "gone", bound={"map_rms": 0.1, "transfer": 0.1}, saves=Saving("a scene", 0.1)
    )
    found = decide([Effect("one", (full("x"), choice))], {"map_rms": 1.0, "transfer": 0.01})
    assert found["one"].chosen == 0


def test_keep_drop_and_no_prune():
    one = effect("one", (0.1, 0.1), (3.0, 0.2))
    assert decide([one], {"map_rms": 1.0}, kept={"A.one"})["one"].chosen == 0
    assert decide([one], {"map_rms": 1.0}, forced={"A.one"})["one"].chosen == 2
    assert decide([one], {"map_rms": 1.0}, prune_all=False)["one"].chosen == 0


def test_what_is_dropped_by_hand_takes_of_the_budget():
    found = decide(
        [effect("one", (0.9, 0.1)), effect("two", (0.5, 0.1))], {"map_rms": 1.0}, forced={"A.one"}
    )
    assert found["two"].chosen == 0


# ---- budgets


def test_limits():
    assert limits(0.1, 2.0, 30.0) == {
        "map_rms": 0.2,
        "peak": 0.2,
        "transfer": 0.01,
        "tod": 3.0,
        "psd": 0.1,
    }
    stated = limits(Limits(map_rms="3 uK"), 2.0, 30.0)
    assert stated["map_rms"] == stated["peak"] == pytest.approx(3e-6)
    assert stated["transfer"] == 0.01


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("-5 %", "must be at least"),
        (".nan", "budget"),
        ("200 %", "must be at most"),
        ("{map_rms: 3 s}", "temperature"),
        ("{map_rms: -3 uK}", "must be at least"),
        ("{map: 3 uK}", "map_rms"),
        ("{}", "state at least one"),
    ],
)
def test_a_wrong_budget_is_refused_at_its_place(text, words):
    with pytest.raises(ConfigurationError) as caught:
        zonda.load("mustang2_cluster", overrides=[f"budget={text}"])
    assert words in str(caught.value)
    assert "budget" in str(caught.value)


def test_a_budget_in_the_file(file):
    stated = zonda.load(
        "mustang2_cluster", overrides=[*SHORT, "budget={map_rms: 3 uK, transfer: 0.1 %}"]
    )
    found = zonda.plan(stated, threads=1)
    assert found.bands[""].limits["map_rms"] == pytest.approx(3e-6)
    assert found.bands[""].limits["transfer"] == pytest.approx(1e-3)
    nothing = zonda.plan(
        zonda.load("mustang2_cluster", overrides=[*SHORT, "budget=0 %"]), threads=1
    )
    assert all(d.chosen == 0 for d in nothing.decided)


# ---- names


@pytest.mark.parametrize(
    ("name", "near"), [("pols", "poles"), ("PinkNois", "PinkNoise"), ("ozon", "ozone")]
)
@pytest.mark.parametrize("option", ["keep", "drop"])
def test_an_unknown_name_is_answered_with_the_nearest(file, option, name, near):
    with pytest.raises(ZondaError) as caught:
        zonda.plan(file, threads=1, **{option: [name]})
    assert f"'{near}'" in caught.value.cure
    assert name in str(caught.value)


def test_what_cannot_be_dropped(file):
    with pytest.raises(ZondaError, match="cannot be dropped: it is not simulated"):
        zonda.plan(file, threads=1, drop=["refraction"])
    with pytest.raises(ZondaError, match="cannot be dropped: it has no coarser form"):
        zonda.plan(file, threads=1, drop=["ozone"])


def test_an_operator_may_be_dropped(file):
    found = zonda.plan(file, threads=1, drop=["PinkNoise"]).apply(file)
    assert "PinkNoise" not in [s.key for s in found.steps]


# ---- what comes of it


def test_within_the_budget(made):
    for metric, limit in made.bands[""].limits.items():
        assert made.bands[""].spent[metric] <= limit
    assert {"map_rms", "peak", "transfer", "tod", "psd"} == set(made.bands[""].limits)


def test_what_runs_is_an_ordinary_pipeline(file):
    planned = zonda.plan(file, threads=1, drop=["sampling order", "layer 9", "layer 8"]).apply(file)
    text = planned.resolved_yaml()
    from zonda.core.configuration.pipeline_file import parse

    again = parse(text, name="again", folder=None)
    assert [o.model_dump() for o in again.operators] == [o.model_dump() for o in planned.operators]
    assert {s.key: s.operator for s in planned.steps}["SkyMap"].interpolation == "linear"
    assert sorted({s.key: s.operator for s in planned.steps}["AtmosphereLayers"].omit) == [8, 9]
    assert all(d.chosen == 0 for d in zonda.plan(again, threads=1).decided), (
        "a planned file is not planned further"
    )


def test_a_namesake_left_out_does_not_change_the_random_numbers():
    text = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
operators:
  - PointingStare: {scan_duration: 2 s}
  - WhiteNoise: {net: 1 mK s(1/2)}
  - WhiteNoise: {net: 2 mK s(1/2)}
  - Efficiency
  - BinMap
"""
    from zonda.core.configuration.pipeline_file import parse

    file = parse(text)
    planned = zonda.plan(file, threads=1, drop=["WhiteNoise"]).apply(file)
    assert [o.label for o in planned.pipeline().operators] == [
        "PointingStare",
        "WhiteNoise.2",
        "Efficiency",
        "BinMap",
    ]


def test_the_table_and_json(made):
    shown = str(made)
    for words in (
        "noise: ",
        "added by this plan",
        "AtmosphereLayers\n",
        "  layer 3  ",
        "Not simulated by zonda",
        " GB",
    ):
        assert words in shown
    data = json.loads(json.dumps(made.as_dict()))
    assert len(data["effects"]) == len(made.decided)
    assert data["prediction"] == {"bytes": made.memory}
    assert all(len(row) == 4 for row in made.summary.short)
    covered = {d.effect.name for d in made.decided}
    assert covered >= {
        "layer 0",
        "detector nodes and time steps",
        "turbulence lattice",
        "spectral resolution",
        "ozone",
        "refraction",
        "opacity with elevation",
        "mean emission with elevation",
        "sky rotation",
        "aberration",
        "beam convolution",
        "sampling order",
        "poles",
        "high-pass decimation",
        "common-mode residual",
        "sample integration",
        "time stamps",
        "coordinate precision",
        "precision",
        "beam chromaticity",
    }
    assert all(d.choice.formula or d.effect.formula for d in made.decided)
    for d in made.decided:
        for bound in (d.effect.size, *(c.bound for c in d.effect.choices)):
            assert all(math.isfinite(v) and v >= 0 for v in bound.values()), d.name


def test_units():
    assert [kelvin(v) for v in (2.0, 3.14159e-3, 2e-6, 4e-9, 0.0)] == [
        "2 K",
        "3.14 mK",
        "2 uK",
        "4 nK",
        "0 K",
    ]


def test_no_noise_no_budget():
    file = zonda.load("mustang2_cluster", overrides=[*SHORT, "WhiteNoise.net=0 K s(1/2)"])
    found = zonda.plan(file, threads=1)
    assert found.bands[""].limits["map_rms"] == 0
    assert found.bands[""].spent["map_rms"] == 0


# ---- prediction of the noise


def test_hits_and_speed_of_a_real_scan(file):
    scene = file.scene()
    data = zonda.Pipeline(
        file.operators[:1]
        + file.operators[3:4]
        + file.operators[5:6]
        + [zonda.BinMap(pixel="4 arcsec")]
    )
    product = data.run(scene, threads=1)
    pixel = math.radians(4 / 3600)
    found = cover(product.observations, pixel)
    hits = product.products["map"].hits
    # pixels of the deepest tenth, on patches of 4 x 4 about as wide as the cells of the estimate
    n = hits.shape[0] // 4 * 4, hits.shape[1] // 4 * 4
    patches = hits[: n[0], : n[1]].reshape(n[0] // 4, 4, n[1] // 4, 4).mean((1, 3))
    deep = np.quantile(patches[patches > 0], 0.9)
    assert found.hits == pytest.approx(deep, rel=0.15)
    o = product.observations[0]
    speed = np.hypot(np.diff(o.dec), np.diff(np.unwrap(o.ra)) * np.cos(o.dec[1:])) * o.sample_rate
    assert found.speed == pytest.approx(np.median(speed), rel=0.05)


def test_errors_average_down_no_further_than_their_correlation():
    context = Context(None, [], [])  # type: ignore[arg-type]
    data = Data(zonda.load("mustang2_cluster", overrides=SHORT).scene())
    zonda.PointingDaisy(scan_duration="10 s").observe(data)
    context.observations = data.observations
    context.coverage = Coverage(400.0, 1e-5, 1e-3)
    free = context.in_map(1.0, 0.0, common=False)
    assert 1 / 20 <= free <= 1
    alone, together = (context.in_map(1.0, 5.0, common=c) for c in (False, True))
    assert free <= alone <= together <= 1.0
    assert context.in_map(1.0, 1e9, common=True) == 1.0
    context.coverage = None
    assert context.in_map(1.0, 1.0, common=True) == 0.0


# ---- the command


def command(capsys, *arguments):
    status = cli.main([str(a) for a in arguments])
    said = capsys.readouterr()
    return status, said.out, said.err


SET = [a for s in SHORT for a in ("--set", s)]


def test_command(capsys):
    status, out, _ = command(capsys, "plan", "mustang2_cluster", *SET, "--keep", "poles")
    assert status == 0
    assert out.index("PinkNoise\n") < out.index("  poles") < out.index("--keep")
    assert max(map(len, out.splitlines())) <= 140
    status, out, _ = command(capsys, "plan", "mustang2_cluster", *SET, "--json", "--no-prune")
    assert all(e["decision"] in ("full", "not simulated") for e in json.loads(out)["effects"])


def test_command_refuses(capsys):
    status, _, err = command(capsys, "plan", "mustang2_cluster", *SET, "--keep", "pols")
    assert status == 2
    assert "did you mean 'poles'?" in err
    assert "Traceback" not in err
    status, _, err = command(
        capsys, "run", "mustang2_cluster", *SET, "--drop", "ozone", "--output", "/nonexistent/x"
    )
    assert status == 2


def test_products_carry_the_plan(tmp_path, capsys):
    from astropy.io import fits

    status, _, err = command(
        capsys, "run", "mustang2_cluster", *SET, "--drop", "layer 9", "--output", tmp_path
    )
    assert status == 0
    assert "about 0." in err
    with fits.open(tmp_path / "map.fits") as hdus:
        rows = {str(r["EFFECT"]): str(r["DECISION"]) for r in hdus["PLAN"].data}
    assert rows["AtmosphereLayers.layer 9"] == "dropped: left out"
    page = (tmp_path / "report.html").read_text()
    assert "AtmosphereLayers.layer 9" in page
    assert "dropped: left out" in page


@pytest.mark.parametrize(
    ("options", "what"), [([], "no plan is made"), (["--no-prune"], "everything in full")]
)
def test_products_say_that_there_was_no_plan(tmp_path, capsys, options, what):
    from astropy.io import fits

    status, _, err = command(
        capsys, "run", "mustang2_cluster", *SET, *options, "--output", tmp_path
    )
    assert status == 0
    assert "simulated in full" in err
    with fits.open(tmp_path / "map.fits") as hdus:
        row = hdus["PLAN"].data[0]
    assert (row["EFFECT"], row["DECISION"]) == ("plan", "not made")
    assert what in (tmp_path / "report.html").read_text()


def test_a_map_of_hits_alone(tmp_path, capsys):
    from astropy.io import fits

    (tmp_path / "hits.yaml").write_text("""
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
runs: {without_air: {without: [atmosphere]}}
operators:
  - PointingDaisy: {scan_duration: 5 s}
  - AtmosphereLayers: {pwv: 5 mm}
  - WhiteNoise
  - Efficiency
  - BinMap: {contents: hits}
  - SaveMap
""")
    file = zonda.load(str(tmp_path / "hits.yaml"))
    planned = zonda.plan(file, threads=1).apply(file)
    assert [s.key for s in planned.steps] == ["PointingDaisy", "BinMap", "SaveMap"]
    status, _, _ = command(capsys, "run", tmp_path / "hits.yaml", "--output", tmp_path / "out")
    assert status == 0
    with fits.open(tmp_path / "out" / "map.fits") as hdus:
        assert hdus[0].name == "HITS"
        hits = hdus[0].data
    whole = file.pipeline().run(file.scene(), output=tmp_path / "all", threads=1)
    np.testing.assert_array_equal(hits, whole.products["map"].hits)


def test_decisions_do_not_depend_on_the_machine():
    """Neither on its threads and memory nor on the time that is measured there."""
    file = zonda.load("atlast_reduced", overrides=SHORT)
    made = zonda.plan(file, threads=1)
    other = zonda.plan(file, threads=8, memory=1 << 29, measure=True)
    assert other.settings() == made.settings()
    assert made.settings()  # something is coarsened in this scene
    assert other.operators == made.operators
    assert other.memory != made.memory
    assert made.timing is None
    assert other.timing.total > 0


def test_the_time_of_a_run_from_slices_of_it(file):
    """Set-up apart from what grows with the samples, of every step that takes time."""
    found = zonda.plan(file, threads=1, prune_all=False, measure=True).timing
    assert found.growing["PinkNoise"] > 0
    assert found.setup["Plots"] > 0
    assert found.growing["Plots"] == 0
    assert found.total == pytest.approx(sum(found.of(o.label) for o in file.pipeline().operators))
    assert found.slice == "40 s of the first scan"


# ---- what is planned at all


def test_the_size_of_a_scene_is_known_before_it_is_pointed(file):
    made = zonda.plan(file, threads=1)
    assert samples_of(file.pipeline(), file.scene()) == made.context.samples


@pytest.mark.parametrize(("seconds", "planned"), [(290, False), (300, True)])
def test_scenes_are_planned_by_their_size(seconds, planned):
    """From 2e8 detectors x samples on: 296 s of 3000 detectors at 225 Hz."""
    size = [f"PointingDaisy.scan_duration={seconds} s", "PointingDaisy.scans=1"]
    found = for_run(zonda.load("atlast_reduced", overrides=size), threads=1)
    assert (found.memory is not None) == planned
    assert bool(found.settings) == planned
    assert (found.short[0][:2] == ("plan", "not made")) == (not planned)
    assert str(found).startswith("about" if planned else "simulated in full (2e+08 samples")


@pytest.mark.parametrize(
    ("options", "planned"),
    [({}, False), ({"prune_all": True}, True), ({"prune_all": False}, False),
     ({"keep": ["layer 3"]}, True), ({"drop": ["layer 3"], "prune_all": False}, True)],
)  # fmt: skip
def test_a_plan_that_is_asked_for_is_made(file, options, planned):
    found = for_run(file, threads=1, **options)
    assert (found.memory is not None) == planned
    assert found.omitted(file) == []


def test_a_run_that_is_not_planned(tmp_path):
    """The structure leaves out white noise for a map of hits, and the run says so."""
    from zonda.core.configuration.pipeline_file import parse

    text = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
runs: {quiet: {without: [white]}}
operators:
  - PointingDaisy: {scan_duration: 20 s}
  - AtmosphereLayers: {pwv: 5 mm}
  - WhiteNoise
  - Efficiency
  - BinMap: {pixel: 2 arcsec, contents: hits}
  - SaveMap
"""
    hits = parse(text, name="hits", folder=tmp_path)
    found = for_run(hits)
    assert found.omitted(hits) == ["AtmosphereLayers", "WhiteNoise", "Efficiency", "signal quiet"]
    assert found.short[0][:2] == ("plan", "not made")
    assert for_run(hits, prune_all=False).omitted(hits) == []


def test_a_figure_of_a_plane_has_the_unit_of_its_metric() -> None:
    assert figure("transfer Q", 2e-3) == figure("transfer", 2e-3) == "2.0e-03"
    assert figure("map_rms U", 2e-3) == figure("map_rms", 2e-3) == "2 mK"
