"""From axes to entries: which there are, their seeds and nights, and what is wrong with them."""

from __future__ import annotations

import pytest

from zonda.core.campaign.settings import TURN, Campaign, entries, separate
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.pipeline_file import parse
from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError

START = Instant.parse("2024-11-25T07:00")


def expand(seed=7, **campaign):
    def time_of(settings):
        given = [s.partition("=")[2].strip('"') for s in settings if s.startswith("time=")]
        return Instant.parse(given[0]) if given else START

    return entries(Campaign.model_validate(campaign), seed, time_of)


def test_a_grid_is_every_combination_with_the_first_axis_slowest():
    found = expand(
        grid={"site": ["a", "b"], "PointingDaisy.radius": ["1 arcmin", "2 arcmin"]}, realizations=2
    )
    points = [tuple(e.values.values()) for e in found]
    radii = ("1 arcmin", "2 arcmin")
    assert points == [(s, r, k) for s in ("a", "b") for r in radii for k in (0, 1)]
    assert found[0].settings == ('site="a"', 'PointingDaisy.radius="1 arcmin"')
    assert {e.combination for e in found} == {()}


def test_a_list_is_one_after_the_other_and_crosses_the_grid():
    found = expand(
        observations=[{"time": "2024-11-25T07:00"}, {"time": "2024-11-26T07:00", "seed": 9}],
        grid={"site": ["a", "b"]},
    )
    assert [(e.values["observation"], e.values["site"]) for e in found] == [
        (0, "a"),
        (0, "b"),
        (1, "a"),
        (1, "b"),
    ]
    assert [e.time.seconds_since(START) for e in found] == [0, 0, 86400, 86400]
    assert [e.seed for e in found[::2]] == [7, 9]


def test_what_is_co_added_has_its_own_random_numbers_and_what_is_compared_the_same():
    found = expand(grid={"site": ["a", "b"]}, realizations=3, combine=["realization"])
    by_site = {site: [e.seed for e in found if e.values["site"] == site] for site in "ab"}
    assert by_site["a"] == by_site["b"]
    assert by_site["a"][0] == 7  # the first is the plain run
    together = expand(grid={"site": ["a", "b"]}, realizations=3)
    assert len({e.seed for e in together}) == 6


@pytest.mark.parametrize("combine", ["all", [], ["night"], ["realization"]])
def test_realizations_never_share_random_numbers(combine):
    """Whether they are co-added or not; what is not co-added else does."""
    found = expand(grid={"site": ["a", "b"]}, nights=2, realizations=3, combine=combine)
    for site in "ab":
        for night in (0, 1):
            seeds = {
                e.seed for e in found if (e.values["site"], e.values["night"]) == (site, night)
            }
            assert len(seeds) == 3
    shared = {e.seed for e in found if e.values["site"] == "a"} == {
        e.seed for e in found if e.values["site"] == "b"
    }
    assert shared == (combine != "all")


@pytest.mark.parametrize(
    ("axes", "shared"),
    [
        ({"nights": 3}, False),
        ({"realizations": 3}, False),
        ({"grid": {"time": ["2024-11-25T07:00", "2024-11-26T07:00", "2024-11-27T07:00"]}}, False),
        (
            {
                "observations": [
                    {"target": "05h +20d"},
                    {"target": "06h +20d"},
                    {"target": "07h +20d"},
                ]
            },
            False,
        ),
        (
            {
                "observations": [
                    {"seed": 7, "time": "2024-11-25T07:00"},
                    {"seed": 7, "time": "2024-11-26T07:00"},
                ]
            },
            True,
        ),
        ({"grid": {"PointingDaisy.radius": ["1 arcmin", "2 arcmin", "3 arcmin"]}}, True),
        (
            {
                "observations": [
                    {"PointingDaisy.radius": "1 arcmin"},
                    {"PointingDaisy.radius": "2 arcmin"},
                ]
            },
            True,
        ),
        ({"nights": 3, "paired": True}, True),
        ({"grid": {"time": ["2024-11-25T07:00", "2024-11-26T07:00"]}, "paired": True}, True),
        ({"realizations": 3, "paired": True}, False),
    ],
)
def test_what_is_not_combined_is_independent_where_it_is_another_observation(axes, shared):
    """Other nights, times and targets have noise of their own; parameters are compared with the
    same noise.
    """
    seeds = [e.seed for e in expand(combine=[], **axes)]
    assert seeds[0] == 7
    assert len(set(seeds)) == (1 if shared else len(seeds))


def test_every_night_of_a_comparison_is_independent_and_each_is_paired():
    found = expand(grid={"PointingDaisy.radius": ["1 arcmin", "2 arcmin"]}, nights=2, combine=[])
    assert [e.seed for e in found[:2]] == [e.seed for e in found[2:]]
    assert found[0].seed != found[1].seed


def test_seeds_do_not_collide_with_neighbours():
    seeds = [separate(s, k) for s in range(50) for k in range(200)]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= s < 2**63 for s in seeds)
    assert separate(8, 1) == separate(8, 1) != separate(9, 1)


def test_explicit_seeds_are_as_they_are():
    assert [e.seed for e in expand(grid={"seed": [3, 4]})] == [3, 4]


def test_nights_are_whole_turns_of_the_earth():
    found = expand(nights=3)
    assert [e.time.seconds_since(START) for e in found] == pytest.approx(
        [0, TURN, 2 * TURN], abs=1e-8
    )
    between = expand(nights={"start": "2024-11-23", "stop": "2024-12-01", "every": 2})
    assert [e.values["night"] for e in between] == [-2, 0, 2, 4]
    with pytest.raises(InputError, match="no observation begins between"):
        expand(nights={"start": "2024-11-25T08:00", "stop": "2024-11-25T09:00"})


def test_a_target_is_at_the_same_place_on_the_next_night():
    """But for a day of precession and aberration, below 1 arcsec."""
    import numpy as np

    import zonda

    def azimuth(time):
        scene = zonda.Scene(site="green_bank", instrument="mustang2", time=time, target="05h +20d")
        data = zonda.core.data.Data(scene=scene)
        zonda.PointingStare(scan_duration="1 s").observe(data)
        return data.observations[0].azimuth[0]

    first = azimuth(START)
    assert abs(azimuth(expand(nights=2)[1].time) - first) < np.radians(2 / 3600)
    assert abs(azimuth(START.shifted(86400)) - first) > np.radians(0.5)


@pytest.mark.parametrize(
    ("campaign", "words", "place"),
    [
        ("{grid: {sed: [1]}}", ["nothing is called 'sed'", "did you mean 'seed'?"], "17:19"),
        (
            "{grid: {site: [green_bank, green_bnak]}}",
            ["unknown site 'green_bnak'", "did you mean 'green_bank'?"],
            "17:38",
        ),
        ("{grid: {BinMap.pixel: [4 arcsec, 2 s]}}", ["BinMap, pixel: expected an angle"], "17:46"),
        (
            "{grid: {BinMap.pixle: [4 arcsec]}}",
            ["unknown key 'pixle' for BinMap", "did you mean 'pixel'?"],
            "17:19",
        ),
        ("{observations: [{time: now}]}", ["cannot read 'now' as a time"], "17:34"),
        (
            "{BinMap.pixel: [4 arcsec]}",
            ["unknown key 'BinMap.pixel'", "write grid: {BinMap.pixel: [...]}"],
            "17:12",
        ),
        (
            "{realization: 2}",
            ["unknown key 'realization'", "did you mean 'realizations'?"],
            "17:12",
        ),
        ("{engine: dsk}", ["did you mean 'dask'?"], "17:20"),
        (
            "{nights: 2, combine: [site]}",
            ["which is no axis of this campaign; its axes: night"],
            "17:11",
        ),
        ("{grid: {name: [a, b]}}", ["'name' cannot change from one entry to the next"], "17:19"),
        ("{scheduler: 'tcp://a:1'}", ["scheduler is for engine: dask"], "17:11"),
        ("{nights: {start: 2024-11-25}}", ["give a number of nights, or start and stop"], "17:20"),
    ],
)
def test_mistakes_are_shown_at_their_place(bench, campaign, words, place):
    path = bench.file(campaign)
    with pytest.raises(ConfigurationError) as caught:
        parse(path.read_text(), name="p.yaml")
    text = caught.value.render()
    assert f"p.yaml:{place}" in text, text
    assert all(word in text for word in words), text


@pytest.mark.parametrize(
    ("gone", "campaign", "words", "place"),
    [
        (
            "site: green_bank\n",
            "{grid: {site: [mauna_kea, atacama]}}",
            "write 'site: \"mauna_kea\"' at the top level",
            "16:19",
        ),
        (
            "time: 2024-11-25T07:00\n",
            "{observations: [{time: 2024-11-26}, {time: 2024-11-27}]}",
            "write 'time: \"2024-11-26\"' at",
            "16:28",
        ),
    ],
)
def test_an_axis_of_what_the_pipeline_lacks(bench, gone, campaign, words, place):
    """The file is checked as one observation: the error names the axis, not line 1."""
    with pytest.raises(ConfigurationError) as caught:
        parse(bench.file(campaign, (gone, "")).read_text(), name="p.yaml")
    text = caught.value.render()
    assert "changes what the pipeline does not have" in text
    assert f"p.yaml:{place}" in text, text
    assert words in text, text
    assert "1 mistake" in text


def test_check_and_plan_know_a_campaign(bench, capsys):
    path = bench.file("{grid: {seed: [1, 2]}, nights: 4, combine: [night]}")
    assert bench.command("check", path) == 0
    assert capsys.readouterr().out.endswith(
        "campaign of 8 entries, combined into 2 sets of products\n"
    )
    assert bench.command("plan", path) == 0
    shown = capsys.readouterr().out
    assert "the plan of the first one:" in shown
    limits = next(line for line in shown.splitlines() if line.startswith("budget "))
    noise = next(line for line in shown.splitlines() if line.startswith("noise: "))
    # a tenth of the noise of a pixel, divided by the square root of the four nights that are
    # co-added
    pixel, budget = float(noise.split()[1]), float(limits.split()[1])
    assert noise.split()[2] == "mK"
    assert limits.split()[2] == "uK"
    assert abs(budget / (1e3 * pixel * 0.1 / 2) - 1) < 0.01


def test_resolved_campaign_reads_back(bench):
    text = bench.file(
        "{grid: {seed: [1, 2]}, nights: {start: 2024-11-24, stop: 2024-11-29}, combine: [night]}"
    ).read_text()
    file = parse(text)
    again = parse(file.resolved_yaml())
    assert again.header.campaign == file.header.campaign
