"""What is left out because no output depends on it."""

from __future__ import annotations

import pytest

from zonda import plan
from zonda.core.configuration.pipeline_file import parse
from zonda.core.mapmaker import MapMaker
from zonda.core.operator import Operator
from zonda.core.output import Output, StreamOutput
from zonda.core.pipeline import Pipeline
from zonda.core.plan.structure import Structure, chain_of, prune
from zonda.core.signal import Component, Signal


def kind(name, requires=(), provides=(), optional=(), base=Operator, **attributes):
    sets = {
        "requires": frozenset(requires),
        "provides": frozenset(provides),
        "optional": frozenset(optional),
    }
    step = (
        "finalize" if issubclass(base, Output) else "observe" if "boresight" in provides else "exec"
    )
    acts = {} if "configure" in attributes else {step: lambda self, *given: None}
    acts |= (
        {"measure": lambda self, stream, model=None: None}
        if attributes.get("couples") == "all"
        else {}
    )
    return type(
        name, (base,), {"__doc__": name, "__module__": __name__, **sets, **acts, **attributes}
    )()


POINT = kind("Point", provides={"boresight"})
SKY = kind("Sky", {"boresight"}, {"sky"})
AIR = kind("Air", {"boresight"}, {"atmosphere", "transmission"})
NOISE = kind("Noise", {"boresight"}, {"white"})
SUM = kind(
    "Sum", (), {"signal"}, {"sky", "atmosphere", "transmission", "white", "pink"}, linear=True
)
FILTER = kind("Filter", {"signal"}, {"signal"}, couples="all", linear=True)
MAP = kind("Map", {"signal", "boresight"}, {"map"}, base=MapMaker, linear=True)
HITS = kind("Hits", {"boresight"}, {"map"}, base=MapMaker, linear=True)
SPECTRUM = kind("Spectrum", {"signal"}, {"spectrum"})
TOD = kind("Tod", {"signal"}, base=StreamOutput)
SAVE = kind("Save", {"map"}, {"map_file"}, base=Output)
FREEZES = kind("Freezes", {"signal"}, {"signal"}, couples="all", linear=True)
TRANSFER = kind(
    "Transfer", {"map"}, {"table"}, base=Output, signals=lambda self: (Signal(only=["sky"]),)
)
FULL = kind(
    "Full",
    {"map"},
    {"table"},
    base=Output,
    signals=lambda self: (Signal(only=["sky"], modes="full"),),
)
RUNS = {"noiseless": {"only": ["sky"]}, "source_free": {"without": ["sky"]}}


def acting(*operators, runs=None, keep=()):
    structure = prune(Pipeline(operators, runs=runs), keep)
    return set(structure.operators), set(structure.runs), structure


def test_everything_is_needed_where_a_map_is_written():
    found, runs, structure = acting(POINT, SKY, AIR, NOISE, SUM, FILTER, MAP, SAVE, runs=RUNS)
    assert found == {"Point", "Sky", "Air", "Noise", "Sum", "Filter", "Map", "Save"}
    assert runs == set(RUNS)
    assert not structure.rows


def test_a_component_that_a_step_declares_as_one_is_part_of_the_sum():
    """The step that forms the signal adds up every `Component`, whether it names it or not."""
    ground = kind("Ground", {"boresight"}, {Component("ground", "at the detector")})
    found, runs, structure = acting(
        POINT, NOISE, ground, SUM, MAP, SAVE, runs={"clean": {"without": ["ground"]}}
    )
    assert found == {"Point", "Noise", "Ground", "Sum", "Map", "Save"}
    assert runs == {"clean"}
    assert not structure.rows


def test_a_hit_map_draws_nothing():
    found, runs, structure = acting(POINT, SKY, AIR, NOISE, SUM, FILTER, HITS, SAVE, runs=RUNS)
    assert found == {"Point", "Hits", "Save"}
    assert not runs, "their maps would have the same hits"
    assert all(row.reason for row in structure.rows)


def test_a_run_without_a_map_bins_nothing():
    found, runs, _ = acting(POINT, SKY, AIR, NOISE, SUM, TOD, FILTER, MAP, runs=RUNS)
    assert found == {"Point", "Sky", "Air", "Noise", "Sum", "Tod"}
    assert not runs, "files of time streams are of the complete signal only"


def test_each_further_signal_is_formed_filtered_and_mapped():
    pipeline = Pipeline(
        [POINT, SKY, AIR, NOISE, SUM, FILTER, MAP, SAVE], runs={"noiseless": {"only": ["sky"]}}
    )
    found = chain_of(pipeline, prune(pipeline))
    assert [signal.name for signal in found.signals] == ["", "noiseless"]


def test_a_remainder_is_not_formed():
    runs = {name: {**signal, "modes": "full"} for name, signal in RUNS.items()}
    pipeline = Pipeline([POINT, SKY, AIR, NOISE, SUM, FILTER, MAP, SAVE], runs=runs)
    for structure in (prune(pipeline), Structure.of_all(pipeline)):
        assert list(structure.derived) == ["source_free"]
        assert [signal.name for signal in chain_of(pipeline, structure).signals] == [
            "",
            "noiseless",
        ]


def test_what_determines_singular_modes_stays():
    """The modes come from everything in the stream: nothing above the filter is left out for a map
    below it.
    """
    found, _, _ = acting(POINT, SKY, AIR, NOISE, SUM, FILTER, MAP, SAVE)
    assert {"Air", "Noise"} <= found


def test_a_spectrum_that_nobody_draws():
    found, _, structure = acting(POINT, SKY, SUM, SPECTRUM, MAP, SAVE)
    assert "Spectrum" not in found
    assert [r.reason for r in structure.rows] == ["no step writes or draws its spectrum"]


def test_an_output_that_shows_a_component():
    """It reads the model that the component was made with."""
    shows = kind("Shows", {"boresight"}, {"screens"}, {"atmosphere"}, base=Output)
    assert acting(POINT, AIR, NOISE, shows)[0] == {"Point", "Air", "Shows"}


def test_products_are_the_output_where_nothing_is_written():
    found, _, _ = acting(POINT, SKY, SUM, SPECTRUM, MAP)
    assert {"Spectrum", "Map", "Sum", "Sky"} <= found


def test_a_component_that_the_sum_does_not_read():
    other = kind("Other", {"boresight"}, {"pink"})
    plain = kind("Plain", {"sky"}, {"signal"})
    found, _, structure = acting(POINT, SKY, other, plain, MAP, SAVE)
    assert "Other" not in found
    assert structure.rows[0].reason == "no step that is needed reads pink"


def test_what_nobody_knows_stays():
    unknown = kind("Unknown", {"boresight"})
    silent = kind("Silent", {"signal"})
    found, _, _ = acting(POINT, SKY, SUM, unknown, silent, MAP, SAVE)
    assert {"Unknown", "Silent", "Sum", "Sky"} <= found


@pytest.mark.parametrize("keep", ["Noise", "Air"])
def test_keep(keep):
    found, _, _ = acting(POINT, AIR, NOISE, SUM, HITS, SAVE, keep=[keep])
    assert keep in found


@pytest.mark.parametrize("runs", [None, RUNS])
def test_a_transfer_function_alone_is_a_run_of_the_sky(runs):
    """Nothing random is drawn where only the sky's map is read, and the sky is not simulated
    twice.
    """
    found, left, structure = acting(
        POINT, SKY, AIR, NOISE, SUM, FILTER, SPECTRUM, MAP, TRANSFER, runs=runs
    )
    assert found == {"Point", "Sky", "Sum", "Filter", "Map", "Transfer"}
    assert not left
    assert structure.instead == ("noiseless" if runs else "_sky")
    assert {r.operator for r in structure.rows if not r.run} == {"Air", "Noise", "Spectrum"}


def test_a_second_reader_keeps_the_main_run():
    found, runs, structure = acting(POINT, SKY, AIR, NOISE, SUM, FILTER, MAP, TRANSFER, SAVE)
    assert {"Air", "Noise"} <= found
    assert runs == {"_sky"}
    assert not structure.instead


def test_modes_of_the_complete_data_keep_what_determines_them():
    found, runs, structure = acting(POINT, SKY, AIR, NOISE, SUM, FREEZES, MAP, FULL)
    assert {"Air", "Noise", "Freezes"} <= found
    assert runs == {"_sky_full"}
    assert not structure.instead


def test_without_singular_modes_there_is_nothing_to_keep():
    found, runs, _ = acting(POINT, SKY, NOISE, SUM, MAP, FULL)
    assert found == {"Point", "Sky", "Sum", "Map", "Full"}
    assert not runs
    found, runs, _ = acting(
        POINT, SKY, AIR, NOISE, SUM, MAP, FULL
    )  # but the transmission of the air
    assert found == {"Point", "Sky", "Air", "Sum", "Map", "Full"}
    assert runs == {"_sky_full"}


def test_what_is_kept_by_name_keeps_the_main_run():
    found, _, structure = acting(POINT, SKY, AIR, NOISE, SUM, FILTER, MAP, TRANSFER, keep=["Noise"])
    assert "Noise" in found
    assert "Air" not in found
    assert not structure.instead


def test_a_file_with_the_map_that_takes_the_main_runs_place():
    """A run that a step needs beside it, with fewer filters, goes on as a companion."""
    both = Signal(only=["sky"]), Signal(only=["sky"], filters="none")
    two = kind("Two", {"map"}, {"table"}, base=Output, signals=lambda self: both)
    found, runs, _ = acting(POINT, SKY, AIR, SUM, FILTER, MAP, two)
    assert "Air" not in found
    assert runs == {"_sky_unfiltered"}


FILE = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
operators:
  - PointingDaisy: {scan_duration: 10 s, sample_rate: 20 Hz}
  - SkyMap: {file: FILE}
  - WhiteNoise
  - Efficiency
  - HighpassFilter
"""


@pytest.mark.parametrize(
    ("end", "without"),
    [
        ("  - BinMap\n  - SaveTOD\n", {"BinMap"}),
        (
            "  - BinMap: {contents: hits}\n  - SaveMap\n",
            {"SkyMap", "WhiteNoise", "Efficiency", "HighpassFilter"},
        ),
        ("  - BinMap\n  - TransferFunction\n", {"WhiteNoise"}),
        ("  - BinMap\n  - SaveMap\n", set()),
    ],
)
def test_what_runs_of_a_file(end, without, tmp_path):
    """No map asked for: nothing is binned. A map of hits: no noise. The steps that are left take
    time, the others none.
    """
    from pathlib import Path

    sky = Path(__file__).parents[3] / "pipelines" / "data" / "merging_cluster.fits"
    file = parse(FILE.replace("FILE", str(sky)) + end)
    planned = plan(file).apply(file)
    assert {s.key for s in file.steps} - {s.key for s in planned.steps} == without
    data = planned.pipeline().run(planned.scene(), output=tmp_path, threads=1)
    assert {label for label, _, _ in data.provenance["timings"]} == {
        s.key for s in file.steps
    } - without


PLATE = kind("Plate", {"boresight"}, configure=lambda self, observation: None)
OWN_FILE = kind("OwnFile", {"signal"}, exec=lambda self, block, state: None)


@pytest.mark.parametrize("step", [PLATE, OWN_FILE])
def test_a_step_that_provides_nothing_is_no_output_but_where_it_says_so(step):
    """It changes observations, or may do anything: the products are the output, as where nothing is
    saved at all.
    """
    found, runs, _ = acting(POINT, SKY, AIR, NOISE, SUM, step, FILTER, MAP, runs=RUNS)
    assert found == {"Point", step.label, "Sky", "Air", "Noise", "Sum", "Filter", "Map"}
    assert runs == set(RUNS)


def test_a_step_that_writes_streams_says_so():
    """Nobody saves the map: it is left out, and with it the signals that are mapped alone."""
    found, runs, _ = acting(POINT, PLATE, SKY, NOISE, SUM, TOD, MAP, runs=RUNS)
    assert found == {"Point", "Plate", "Sky", "Noise", "Sum", "Tod"}
    assert runs == set()


def test_what_changes_observations_stays_where_the_sky_alone_takes_the_place_of_everything():
    """A plate turns the polarization of the sky alone, too; it is not a reason to simulate the
    noise.
    """
    found, _, structure = acting(POINT, PLATE, SKY, NOISE, SUM, MAP, TRANSFER)
    assert structure.instead
    assert found == {"Point", "Plate", "Sky", "Sum", "Map", "Transfer"}
