"""What the forecast refuses, with the step's name."""

import pytest

import zonda
from zonda.core.configuration.pipeline_file import parse
from zonda.core.errors import PipelineError, ZondaError
from zonda.plugins.forecast.survey import steps_of

HEAD = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 75 deg 20 deg
operators:
  - PointingDaisy: {scan_duration: 20 s}
"""
USUAL = [
    "AtmosphereLayers",
    "WhiteNoise",
    "PinkNoise",
    "Efficiency",
    "HighpassFilter",
    "CommonModeFilter",
    "BinMap",
]


def pipeline(*steps):
    return parse(HEAD + "".join(f"  - {step}\n" for step in steps))


def changed(step, text):
    return pipeline(*(text if s == step else s for s in USUAL))


def test_outputs_and_sky_do_not_matter():
    steps = steps_of(
        pipeline("WhiteNoise", "Efficiency", "TimeStreams", "BinMap", "SaveMap", "Report")
    )
    assert [type(o).__name__ for o in steps.operators] == [
        "PointingDaisy",
        "WhiteNoise",
        "Efficiency",
        "BinMap",
    ]
    shipped = steps_of(zonda.load("mustang2_cluster"))
    assert "SkyMap" not in [type(o).__name__ for o in shipped.operators]
    assert shipped.highpass.frequency == 0.08


@pytest.mark.parametrize(
    ("step", "text", "words"),
    [
        (
            "CommonModeFilter",
            "CommonModeFilter: {modes: 2}",
            "CommonModeFilter: the forecast does not cover modes: 2",
        ),
        (
            "HighpassFilter",
            "HighpassFilter: {trim: 2 s}",
            "HighpassFilter: the forecast does not cover trim",
        ),
        (
            "WhiteNoise",
            "WhiteNoise: {scatter: 0.3}",
            "WhiteNoise: the forecast does not cover scatter",
        ),
        (
            "Efficiency",
            "Efficiency: {calibration_error: 5 %}",
            "Efficiency: the forecast does not cover calibration_error",
        ),
        (
            "Efficiency",
            "Efficiency: {calibration: instantaneous}",
            "does not cover calibration: instantaneous",
        ),
        (
            "AtmosphereLayers",
            "AtmosphereLayers: {beam: top_hat}",
            "AtmosphereLayers: the forecast does not cover beam: top_hat",
        ),
        ("BinMap", "BinMap: {nside: 4096}", "BinMap: the forecast does not cover nside"),
        (
            "BinMap",
            "BinMap: {contents: hits}",
            "BinMap: the forecast does not cover contents: hits",
        ),
    ],
)
def test_parameters_that_are_not_covered(step, text, words):
    with pytest.raises(PipelineError, match=words):
        steps_of(changed(step, text))


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        (["WhiteNoise", "Efficiency"], "there is no map"),
        (["WhiteNoise", "Efficiency", "BinMap", "BinMap: {product: other}"], "there are 2 maps"),
        (
            ["WhiteNoise", "Efficiency", "HighpassFilter", "HighpassFilter", "BinMap"],
            "there are 2 of them",
        ),
        (
            ["WhiteNoise", "Efficiency", "CommonModeFilter", "HighpassFilter", "BinMap"],
            "only after the HighpassFilter",
        ),
        (["AtmosphereLayers", "WhiteNoise", "Efficiency", "BinMap"], "tens of kelvin"),
        (
            ["WhiteNoise", "PinkNoise: {shared: 0.5}", "Efficiency", "HighpassFilter", "BinMap"],
            "adds up coherently",
        ),
        (["Efficiency", "BinMap"], "nothing in this pipeline makes noise"),
    ],
)
def test_steps_that_are_not_covered_together(steps, words):
    with pytest.raises(PipelineError, match=words):
        steps_of(pipeline(*steps))


class Doubling(zonda.Operator):
    """A filter that the forecast does not know."""

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})


class Masked(zonda.CommonModeFilter):
    """A filter derived from one that it knows, which may do anything."""


@pytest.mark.parametrize("operator", [Doubling, Masked])
def test_filters_of_plugins(operator):
    from dataclasses import replace

    from zonda.core.configuration.loaded import Step

    file = pipeline(*USUAL)
    steps = (*file.steps[:-1], Step(operator.__name__, operator()), file.steps[-1])
    with pytest.raises(
        PipelineError, match=f"{operator.__name__}: the forecast does not cover this step"
    ):
        steps_of(replace(file, steps=steps))


def test_a_circle_off_the_map():
    with pytest.raises(ZondaError, match="is not on the map"):
        zonda.sensitivity(
            changed("AtmosphereLayers", "AtmosphereLayers: {pwv_rms: 0 %}"), radius="2 deg"
        )
