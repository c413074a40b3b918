"""`MeasureFigures` in whole runs: the signals that its metrics need, its table, and the report."""

import numpy as np
import pytest
from astropy.table import Table

import zonda
from tests.scenes import camera, write_sky
from zonda.core.accuracy.metrics import OfFunction, get
from zonda.core.assembly.checks import run_checks
from zonda.core.errors import InputError, ZondaError
from zonda.core.plan.structure import prune
from zonda.core.registry import metrics
from zonda.plugins.checks import scenes

STEPS = """\
operators:
  - PointingDaisy: {scan_duration: 12 s, radius: 40 arcsec}
  - SkyMap: {file: sky.fits}
  - WhiteNoise
  - Efficiency
  - HighpassFilter: {frequency: 0.3 Hz}
  - BinMap: {pixel: 3 arcsec}
"""


def loaded(folder, more, top=""):
    if not (folder / "sky.fits").exists():
        write_sky(folder / "sky.fits", 65, 4 / 3600, 0.05)
    (folder / "p.yaml").write_text(camera(7) + top + STEPS + more)
    return zonda.load(folder / "p.yaml")


def test_figures_of_a_run(tmp_path):
    measures = """\
  - MeasureFigures:
      metrics: [central_rms, {central_rms: {signal: free, radius: 20 arcsec}}, peak_ratio,
                {transfer_at: {scale: 20 arcsec}}, peak_snr]
  - TransferFunction: {bins: 1, largest: 25.680508 arcsec, smallest: 15.576016 arcsec}
  - Report
"""
    file = loaded(tmp_path, measures, "runs: {free: {without: [sky]}}\n")
    data = file.pipeline().run(file.scene(), output=tmp_path / "out", threads=1)
    figures = data.products["figures"]
    assert figures["central_rms"].value == data.products["map"].smoothed_rms(
        data.products["map"].fwhm, np.radians(1 / 60)
    )
    free = data.products["free/map"].smoothed_rms(data.products["map"].fwhm, np.radians(20 / 3600))
    assert figures["central_rms(signal=free, radius=20 arcsec)"].value == pytest.approx(free)
    rings = data.products["transfer_function"].rings
    there = figures[
        "transfer_at(scale=20 arcsec)"
    ]  # the same ring: 20 arcsec times and by exp(1/4)
    assert (there.value, there.error) == pytest.approx(
        (rings.transfer[0], rings.error[0]), rel=1e-6
    )
    assert 0.1 < figures["peak_ratio"].value < 1.2
    table = Table.read(tmp_path / "out" / "figures.ecsv", format="ascii.ecsv")
    assert list(table["name"]) == [f.name for f in figures]
    assert table["value"] == pytest.approx([f.value for f in figures], rel=1e-8)
    assert list(table["unit"])[:2] == ["K_RJ", "K_RJ"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<h2>Figures</h2>" in page
    assert "peak_ratio" in page
    assert zonda.measure(data, "central_rms") == figures["central_rms"]


def test_it_is_an_output_that_keeps_what_it_reads(tmp_path):
    """`zonda run` omits no signal and no step that a metric reads, and all others."""
    runs = "runs: {free: {without: [sky]}, sky: {only: [sky]}}\n"
    plain = prune(
        loaded(tmp_path, "  - MeasureFigures: {metrics: [central_rms]}\n", runs).pipeline()
    )
    assert plain.runs == ()
    assert "BinMap" in plain.operators
    one = prune(
        loaded(
            tmp_path, "  - MeasureFigures: {metrics: [{central_rms: {signal: free}}]}\n", runs
        ).pipeline()
    )
    assert one.runs == ("free",)
    ratio = prune(
        loaded(tmp_path, "  - MeasureFigures: {metrics: [peak_ratio]}\n", runs).pipeline()
    )
    assert (
        "WhiteNoise" not in ratio.operators
    )  # the sky alone takes the place of the complete signal


def test_the_sky_alone_gives_the_same_ratio(tmp_path):
    """Where the complete signal is narrowed to the sky, that is the signal which a metric reads."""
    file = loaded(tmp_path, "  - MeasureFigures: {metrics: [peak_ratio]}\n")
    whole = file.pipeline().run(file.scene(), threads=1).products["figures"]
    narrow = (
        zonda.Pipeline(file.operators, only=["sky"])
        .run(file.scene(), threads=1)
        .products["figures"]
    )
    assert narrow["peak_ratio"].value == pytest.approx(
        whole["peak_ratio"].value, rel=1e-5
    )  # float32


def test_what_cannot_be_measured_is_said_before_the_run(tmp_path):
    with pytest.raises(ZondaError, match="MeasureFigures needs spectrum, which no step provides"):
        loaded(tmp_path, "  - MeasureFigures: {metrics: [psd_slope]}\n").pipeline()
    with pytest.raises(ZondaError, match=r"metrics.0: TransferAt, scale: expected an angle"):
        loaded(tmp_path, "  - MeasureFigures: {metrics: [{transfer_at: {scale: 60 Hz}}]}\n")
    with pytest.raises(ZondaError, match="metrics: needs at least 1 of them, got 0"):
        loaded(tmp_path, "  - MeasureFigures: {metrics: []}\n")
    with pytest.raises(ZondaError, match="listed twice"):
        loaded(tmp_path, "  - MeasureFigures: {metrics: [coverage, coverage]}\n")
    named = "  - MeasureFigures: {metrics: [{central_rms: {signal: fre}}]}\n"
    with pytest.raises(
        ZondaError,
        match=r"(?s)MeasureFigures reads the signal 'fre', which is not among runs.*mean 'free'",
    ):
        loaded(tmp_path, named, "runs: {free: {without: [sky]}}\n")
    with pytest.raises(ZondaError, match="add it to runs"):
        loaded(tmp_path, named)


@pytest.mark.parametrize("name", ["map_rms", "peak", "transfer", "psd", "structure"])
def test_an_error_between_two_runs_is_no_figure(tmp_path, name):
    """It is refused when the file is read, with a place and with what to measure instead."""
    with pytest.raises(ZondaError) as caught:
        loaded(tmp_path, f"  - MeasureFigures:\n      metrics: [central_rms, {name}]\n")
    text = str(caught.value)
    assert f"{name} is an error of one run against another, not a figure of one" in text
    assert f"name {name} in zonda accuracy --metric" in text
    assert "metrics: [central_rms, " in text  # the line of the file, marked
    with pytest.raises(InputError, match="not a figure of one"):
        zonda.measure(zonda.Data(scenes.scene()), name)


def test_every_metric_is_a_figure_or_is_refused():
    for name in metrics:
        found = get(name)
        assert isinstance(found, zonda.FigureMetric | OfFunction) == (found.instead is None), name


@pytest.mark.parametrize(
    ("given", "metric", "message"),
    [
        (
            "projection: CAR, pixel: 3 arcsec",
            "{transfer_at: {scale: 20 arcsec}}",
            "transfer_at needs a TAN map",
        ),
        ("nside: 8192", "{transfer_at: {scale: 20 arcsec}}", "transfer_at needs a TAN map"),
        ("contents: hits, pixel: 3 arcsec", "central_rms", "counts samples and has no signal"),
        ("contents: hits, pixel: 3 arcsec", "peak_snr", "counts samples and has no signal"),
        ("contents: hits, pixel: 3 arcsec", "coverage", ""),
        ("projection: CAR, pixel: 3 arcsec", "{peak_ratio: {against: input}}", ""),
    ],
)
def test_maps_of_which_there_is_no_figure_are_refused_before_the_run(
    tmp_path, given, metric, message
):
    file = loaded(tmp_path, f"  - MeasureFigures: {{metrics: [{metric}]}}\n")
    (tmp_path / "p.yaml").write_text(
        (tmp_path / "p.yaml").read_text().replace("pixel: 3 arcsec", given)
    )
    file = zonda.load(tmp_path / "p.yaml")
    if not message:
        run_checks(file.pipeline(), file.scene(), saved=False)
        return
    with pytest.raises(ZondaError, match=message):
        run_checks(file.pipeline(), file.scene(), saved=False)


def test_figures_of_one_signal_alone_keep_what_it_is_without(tmp_path):
    """The plan leaves out what no output depends on; the sky, which the signal is without, is named
    by it and stays.
    """
    runs = "runs: {free: {without: [sky], modes: full}}\n"
    file = loaded(
        tmp_path, "  - MeasureFigures: {metrics: [{central_rms: {signal: free}}]}\n", runs
    )
    planned = zonda.plan(file, threads=1, keep=["HighpassFilter"]).apply(file)
    data = planned.pipeline().run(planned.scene(), output=tmp_path / "planned", threads=1)
    whole = file.pipeline().run(file.scene(), output=tmp_path / "whole", threads=1)
    (name,) = [figure.name for figure in whole["figures"]]
    assert data["figures"][name].value == whole["figures"][name].value
