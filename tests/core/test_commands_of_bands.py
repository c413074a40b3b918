"""Plans, audits, forecasts and accuracies of cameras with several bands: every number is that of
its band.

The two bands share nothing that a default could hide: NET, beam, knee, efficiencies and passband
differ.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import zonda
from zonda.core import cli
from zonda.core.accuracy.metrics import Metric, OfBands, get, metric_of
from zonda.core.errors import ZondaError

PIPELINE = """
name: two
site: llano_de_chajnantor
instrument:
  name: camera
  telescope: {name: dish, diameter: 6 m}
  bands:
    - {name: low, low: 77 GHz, high: 106 GHz, net: 300 uK s(1/2), knee: 0.1 Hz}
    - {name: high, low: 130 GHz, high: 170 GHz, net: 700 uK s(1/2), knee: 1 Hz, fwhm: 1.4 arcmin, main_beam_efficiency: 0.5}
  pixels: PIXELS
  detectors: 38
  field_of_view: 30 arcmin
  main_beam_efficiency: 0.8
  illumination_efficiency: 0.9
  sample_rate: 50 Hz
time: 2022-08-01T23:00
target: 260d -10d
operators:
  - PointingDaisy: {radius: 20 arcmin, speed: 10 arcmin/s, scan_duration: 30 s, scans: 2}
  - AtmosphereLayers: {pwv: 1 mm}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - HighpassFilter: {frequency: 0.2 Hz}
  - CommonModeFilter
  - BinMap: {pixel: 1 arcmin, width: 1.5 deg}
  - SaveMap
"""
NAMES = ["low", "high"]


@pytest.fixture
def path(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    file = tmp_path / "two.yaml"
    file.write_text(PIPELINE.replace("PIXELS", getattr(request, "param", "shared")))
    return file


def test_a_band_is_planned_as_in_a_camera_that_has_no_other(path: Path) -> None:
    both = zonda.plan(zonda.load(path), threads=1)
    for name in NAMES:
        alone = zonda.plan(zonda.load(path, [f"instrument.band={name}"]), threads=1)
        one = both.bands[name]
        assert one.noise == alone.noise
        assert [(d.name, d.choice) for d in one.decided] == [
            (d.name, d.choice) for d in alone.decided
        ]
    samples = [both.bands[name].noise[0] for name in NAMES]
    assert samples[1] / samples[0] == pytest.approx(
        700 / 300, rel=0.05
    )  # the load of the atmosphere raises both a little
    beams = [
        d.name for name in NAMES for d in both.bands[name].decided if "samples per FWHM" in d.name
    ]
    assert beams == [
        "PointingDaisy.samples per FWHM of 137 arcsec",
        "PointingDaisy.samples per FWHM of 84 arcsec",
    ]


@pytest.mark.parametrize("path", ["separate"], indirect=True)
def test_arrays_side_by_side_are_planned_where_they_are(path: Path) -> None:
    """Effects that grow with the distance from the boresight are those of the whole camera, not of
    an array about it.
    """
    both = zonda.plan(zonda.load(path), threads=1)
    alone = zonda.plan(zonda.load(path, ["instrument.band=low"]), threads=1)
    plane = zonda.load(path).scene().instrument.focalplane()
    for k, name in enumerate(NAMES):
        own = plane.of_band(k)
        made = both.bands[name].context.first.focalplane
        np.testing.assert_array_equal([made.xi, made.eta], [own.xi, own.eta])
        assert made.radius > 1.8 * made.reach
        assert made.reach == pytest.approx(alone.context.first.focalplane.radius, rel=1e-9)


def test_audit_of_each_band(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        cli.main(["plan", str(path), "--audit", "--threads", "1", "--drop", "poles", "--json"]) == 0
    )
    found = json.loads(capsys.readouterr().out)["bands"]
    assert [*found] == NAMES
    actual = {
        name: {(r["effect"], r["metric"]): r["actual"] for r in found[name]["rows"]}
        for name in NAMES
    }
    for metric, ratio in (("white noise", 700 / 300), ("PinkNoise.poles", 700 / 300)):
        low, high = (
            next(v for (effect, _), v in actual[name].items() if effect == metric) for name in NAMES
        )
        assert (
            high > 0.9 * ratio * low > 0
        )  # a knee ten times higher makes the poles' error larger still


def test_the_verdict_of_an_audit_is_that_of_the_worst_band() -> None:
    from zonda.core.plan.audit import Audit, AuditOfBands, Checked

    good = Audit((Checked("a", "b", "tod", 1.0, 0.5, 0.0),), "a slice")
    bad = Audit((Checked("a", "b", "tod", 1.0, 2.0, 0.1),), "a slice")
    assert not AuditOfBands({"x": good, "y": good}).violated
    both = AuditOfBands({"x": good, "y": bad})
    assert both.violated
    assert str(both).endswith("all bands: 2 bounds, 1 violated")


def test_sensitivity_of_each_band(path: Path, tmp_path: Path) -> None:
    """Shared pixels: that of a camera with this band alone."""
    found = zonda.sensitivity(str(path))
    for name in NAMES:
        alone = zonda.sensitivity(str(path), settings=[f"instrument.band={name}"])
        for part in ("white", "1/f", "atmosphere"):
            assert found[name].rms(part=part) == pytest.approx(
                alone.rms(part=part), rel=0, abs=0, nan_ok=True
            )
            assert (
                part == "atmosphere" or found[name].rms(part=part) > 0
            )  # behind a singular mode there is no forecast of it
        assert found[name].factors == alone.factors
        assert found[name].radius == alone.radius
    assert found.reach("1 mK") == max(found[name].reach("1 mK") for name in NAMES)
    paths = found.write(tmp_path / "depths")
    assert [p.name for p in paths] == [
        "sensitivity_low.ecsv",
        "sensitivity_low.png",
        "sensitivity_high.ecsv",
        "sensitivity_high.png",
        "pipeline.yaml",
    ]
    assert Table.read(tmp_path / "depths" / "sensitivity_high.ecsv").meta["BAND"] == "high"
    with pytest.raises(ZondaError, match="there is no band 'f150'"):
        found["f150"]


@pytest.mark.parametrize("path", ["separate"], indirect=True)
def test_depths_of_arrays_side_by_side_are_as_simulated(path: Path) -> None:
    """Within 4 standard errors; the array is 7.5 arcmin beside the boresight, which is where the
    circle is.

    Behind the detectors' mean: noise would turn a singular mode, and of what that leaves there is
    no forecast.
    """
    path.write_text(
        path.read_text().replace("CommonModeFilter", "CommonModeFilter: {method: mean}")
    )
    found = zonda.sensitivity(str(path), radius="8 arcmin").audited(6, threads=1)
    for name in NAMES:
        rows = found[name].audit.rows
        assert {r.part for r in rows} == {"white", "1/f", "atmosphere", "together"}
        assert all(abs(r.z) < 4 for r in rows), str(found[name].audit)


def test_sensitivity_on_the_command_line(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["sensitivity", str(path), "--reach", "1 mK"]) == 0
    text = capsys.readouterr().out
    assert "two: camera, band low at" in text
    assert "band high: 1 mK after" in text
    assert "1 mK in all bands after" in text
    assert cli.main(["sensitivity", str(path), "--json", "--reach", "1 mK"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert [*table["bands"]] == NAMES
    assert table["reach"]["seconds"] == zonda.sensitivity(str(path)).reach("1 mK")


def test_error_of_a_run_is_the_worst_bands(
    path: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert (
        cli.main(
            ["run", str(path), "--output", str(tmp_path / "out"), "--verify", "--threads", "1"]
        )
        == 0
    )
    line = next(
        row for row in capsys.readouterr().err.splitlines() if row.startswith("error of map_rms")
    )
    total, each = line.split(": ")[1].split(" (the largest of ")
    errors = {
        part.split()[0]: float(part.split()[1]) for part in each.removesuffix(")").split(", ")
    }
    assert [*errors] == NAMES
    assert float(total.split()[0]) == max(errors.values()) > 0


class Peak(Metric):
    """Largest value of the map."""

    def measure(self, data: zonda.Data) -> float:
        return float(np.nanmax(data["map"].signal))


def test_metrics_of_bands(path: Path, tmp_path: Path) -> None:
    file = zonda.load(path, ["PointingDaisy.scan_duration=10 s"])
    data = file.pipeline().run(file.scene(), output=tmp_path, threads=1)
    for name, own in data.bands.items():
        assert own["map"] is data[f"map_{name}"]
        assert {o.name for o in own.observations} == {f"scan-000-{name}", f"scan-001-{name}"}
    assert [*data.bands] == NAMES
    metric = OfBands(Peak())
    found = metric.measure(data)
    assert found == {name: float(np.nanmax(data[f"map_{name}"].signal)) for name in NAMES}
    other = {"low": 1.5 * found["low"], "high": 0.9 * found["high"]}
    assert metric.errors(other, found) == {"low": pytest.approx(0.5), "high": pytest.approx(0.1)}
    assert metric.error(other, found) == pytest.approx(0.5)
    assert metric.mean_error([other, other], [found, found])[0] == pytest.approx(0.5)
    assert isinstance(metric_of(file, "map_rms"), OfBands)
    assert not isinstance(metric_of(zonda.load(path, ["instrument.band=low"]), "map_rms"), OfBands)
    rms = OfBands(get("map_rms"))
    assert rms.floor(rms.measure(data)) == 1.0


def test_a_metric_of_each_band_keeps_the_step_whose_product_it_reads(path: Path) -> None:
    path.write_text(path.read_text() + "  - MapSpectrum\n")
    file = zonda.load(path)
    metric = metric_of(file, "map_power(of=map, smallest=1 arcmin, largest=30 arcmin)")
    assert isinstance(metric, OfBands)
    steps = zonda.Variant(file.pipeline(), file.scene()).steps([metric])
    assert "MapSpectrum" in {o.label for o in steps}
    assert "SaveMap" not in {o.label for o in steps}


def test_accuracy_on_the_command_line(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "accuracy",
        str(path),
        "--knob",
        "precision",
        "--repeats",
        "2",
        "--seeds",
        "1",
        "--output",
        str(tmp_path / "accuracy"),
        "--duration",
        "10 s",
        "--json",
    ]
    assert cli.main(command) == 0
    found = json.loads(capsys.readouterr().out)
    present = found["present"]
    assert [*present["bands"]] == NAMES
    assert present["error"] == max(present["bands"].values()) > 0
    assert found["says"].endswith("the largest of all bands")
    assert (
        "error of each band, of which the largest counts"
        in (tmp_path / "accuracy" / "accuracy.txt").read_text()
    )
