"""`sweep:`: a campaign that co-adds nothing, and a table of figures."""

import math

import numpy as np
import pytest
from astropy.table import Table

from zonda.core.campaign.run import Point, draw
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.pipeline_file import parse
from zonda.core.experiment.experiment import Values
from zonda.core.figures import measure

from ...scenes import camera
from .conftest import command

YAML = f"""\
{camera(7)}sweep:
  over:
    WhiteNoise.net: [1 mK s(1/2), 2 mK s(1/2), 4000 uK s(1/2)]
  seeds: 3
  engine: serial
operators:
  - PointingDaisy: {{radius: 1 arcmin, speed: 50 arcsec/s, scan_duration: 5 s}}
  - WhiteNoise
  - Efficiency
  - BinMap: {{pixel: 4 arcsec}}
  - MeasureFigures: {{metrics: [central_rms, coverage]}}
"""


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "p.yaml"
    file.write_text(YAML)
    return file


def test_a_table_of_figures_with_scatter_over_seeds(path, tmp_path):
    folder = tmp_path / "out"
    assert command("run", path, "--output", folder) == 0
    table = Table.read(folder / "sweep.ecsv")
    rms = table[[name == "central_rms" for name in table["figure"]]]
    assert list(rms["WhiteNoise.net"]) == ["1 mK s(1/2)", "2 mK s(1/2)", "4000 uK s(1/2)"]
    assert list(rms["realizations"]) == [3, 3, 3]
    # the points share their random numbers: the noise is proportional to the NET
    assert rms["mean"] / rms["mean"][0] == pytest.approx([1, 2, 4], rel=1e-5)
    assert rms["scatter"] / rms["scatter"][0] == pytest.approx([1, 2, 4], rel=1e-4)
    assert rms["scatter"][0] > 0  # the seeds do not
    assert rms["standard_error"] == pytest.approx(rms["scatter"] / math.sqrt(3))
    one = Table.read(next(folder.glob("*1-mK*realization=1")) / "figures.ecsv")
    others = [Table.read(f / "figures.ecsv")["value"][0] for f in folder.glob("*net=1-mK*")]
    assert one["value"][0] in others
    assert np.mean(others) == pytest.approx(rms["mean"][0], rel=1e-7)
    assert np.std(others, ddof=1) == pytest.approx(rms["scatter"][0], rel=1e-5)
    assert (folder / "sweep.png").stat().st_size > 1000
    assert "coverage" in (folder / "sweep.html").read_text()


def test_it_is_resumed_and_its_own_yaml_makes_it_again(path, tmp_path, monkeypatch):
    from zonda.core.campaign import run

    folder = tmp_path / "out"

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run, "write_table", interrupted)
        assert command("run", path, "--output", folder) == 130
    assert not (folder / "sweep.ecsv").exists()
    assert command("resume", folder) == 0
    assert command("run", folder / "resolved.yaml", "--output", tmp_path / "again") == 0
    found = [Table.read(f / "sweep.ecsv")["mean"] for f in (folder, tmp_path / "again")]
    assert list(found[0]) == list(found[1])
    (folder / "sweep.ecsv").unlink()
    next(folder.glob("*/tasks.npz")).write_text("[[")
    assert command("resume", folder) == 0
    assert list(Table.read(folder / "sweep.ecsv")["mean"]) == list(found[0])


@pytest.mark.parametrize(
    ("old", "new", "message", "place"),
    [
        ("WhiteNoise.net: [1", "WhitNoise.net: [1", "nothing is called 'WhitNoise'", 19),
        ("2 mK s(1/2), 4", "2 s, 4", "expected a noise level", 19),
        ("seeds: 3", "sedes: 3", "unknown", 20),
        (
            "  over:\n    WhiteNoise.net: [1",
            "  WhiteNoise.net: [1",
            r"write over: \{WhiteNoise.net: \[...\]\}",
            18,
        ),
        ("seeds: 3", "seeds: 0", "seeds", 20),
        ("sweep:\n", "campaign: {realizations: 2}\nsweep:\n", "either a sweep or a campaign", 18),
        (
            "  - MeasureFigures: {metrics: [central_rms, coverage]}\n",
            "",
            "no step measures figures",
            17,
        ),
    ],
)
def test_mistakes_are_shown_in_the_sweep(old, new, message, place):
    assert old in YAML
    with pytest.raises(ConfigurationError, match=message) as caught:
        parse(YAML.replace(old, new))
    assert [d.span.line + 1 for d in caught.value.diagnostics] == [place]


def test_a_sweep_over_nothing():
    text = YAML.replace(
        "  over:\n    WhiteNoise.net: [1 mK s(1/2), 2 mK s(1/2), 4000 uK s(1/2)]\n  seeds: 3\n", ""
    )
    with pytest.raises(ConfigurationError, match="give over, points or seeds"):
        parse(text)


def test_points_are_drawn_in_the_unit_of_the_first():
    def points(values):
        return [
            Point({"a": v, "b": "1"}, "m", "K", Values((float(k),), math.nan))
            for k, v in enumerate(values)
        ]

    [ax] = draw(points(["1 mm", "0.5 cm", "1 m"])).axes
    assert list(ax.lines[0].get_xdata()) == pytest.approx([1, 5, 1000])
    assert ax.get_xlabel() == "a [mm]"
    assert ax.get_xscale() == "log"
    [ax] = draw(points(["tapered", "gaussian"])).axes
    assert [t.get_text() for t in ax.get_xticklabels()] == ["tapered", "gaussian"]
    [ax] = draw(points(["1", "2", "3"])).axes
    assert list(ax.lines[0].get_xdata()) == [1, 2, 3]


def test_the_mean_emission_of_scans_is_that_of_a_plain_run(path, tmp_path):
    """The levels of the atmosphere are those of scans, which a task hands on beside its maps."""
    text = YAML.replace(
        "[central_rms, coverage]", "[mean_t_scan, {mean_t_scan: {of: atmosphere}}]"
    ).replace("seeds: 3", "seeds: 1")
    text = text.replace("scan_duration: 5 s", "scan_duration: 5 s, scans: 2").replace(
        "  - WhiteNoise", "  - AtmosphereLayers\n  - WhiteNoise"
    )
    text = text.replace("[1 mK s(1/2), 2 mK s(1/2), 4000 uK s(1/2)]", "[1 mK s(1/2)]")
    path.write_text(text)
    folder = tmp_path / "out"
    assert command("run", path, "--output", folder) == 0
    table = Table.read(folder / "sweep.ecsv")
    file = parse(text[: text.index("sweep:")] + text[text.index("operators:") :])
    data = file.pipeline().run(file.scene(), output=tmp_path / "plain", threads=1)
    plain = [measure(data, "mean_t_scan", of=of).value for of in ("scan", "atmosphere")]
    assert list(table["mean"]) == pytest.approx(plain, rel=1e-9)
    assert plain[0] > plain[1] > 0  # divided by a transmission below 1


def test_the_mean_emission_needs_an_atmosphere():
    with pytest.raises(
        ConfigurationError, match="MeasureFigures needs atmosphere, which no step provides"
    ):
        parse(YAML.replace("[central_rms, coverage]", "[mean_t_scan, central_rms]"))
