"""`zonda validate`: exit statuses, what it writes, what it does not run again."""

import json

import pytest
from astropy.table import Table

from tests.scenes import camera
from zonda.core.cli import main
from zonda.core.experiment import experiment as tasks
from zonda.core.experiment.variant import FileVariant
from zonda.plugins.validation.claims import SHIPPED, read

PIPELINE = (
    camera(7)
    + """
operators:
  - PointingDaisy: {radius: 1 arcmin, speed: 30 arcsec/s, scan_duration: 5 s}
  - WhiteNoise
  - Efficiency
  - BinMap: {pixel: 4 arcsec}
"""
)

CLAIMS = """
paper: A paper
claims:
  - id: noise
    section: '1'
    claim: The noise is what it is.
    paper: PAPER
    error: 1 uK
    pipeline: small
    metric: {central_rms: {radius: 1 arcmin}}
    seeds: 4
    because: The detectors are noisier.
    counter:
      - name: louder
        shows: Twice the noise gives twice the rms
        change: {WhiteNoise.net: 2 mK s(1/2)}
        versus: {WhiteNoise.net: 1 mK s(1/2)}
        statistic: ratio
        expect: {above: LOW, below: 2.01}
  - id: closed
    section: '2'
    claim: One is one.
    paper: 1
    of: mean
    calculate: {stated: {value: 1}}
  - {id: real, section: '3', claim: The real map is so., paper: 1 K, needs: the map}
"""


@pytest.fixture
def claims(tmp_path):
    (tmp_path / "small.yaml").write_text(PIPELINE)

    def write(paper="1 uK", low="1.99"):
        path = tmp_path / "claims.yaml"
        path.write_text(CLAIMS.replace("PAPER", paper).replace("LOW", low))
        return path

    return write


@pytest.fixture
def runs(monkeypatch):
    made = []
    run, draw = tasks.measured, FileVariant.run

    def counted(variant, *how):
        made.append((variant.overrides, "measured"))
        return run(variant, *how)

    def drawn(self, metrics=(), **how):
        if "output" in how:
            made.append((self.overrides, "drawn"))
        return draw(self, metrics, **how)

    monkeypatch.setattr(tasks, "measured", counted)
    monkeypatch.setattr(FileVariant, "run", drawn)
    return made


def validate(path, folder, *more):
    return main(["validate", "--claims", str(path), "--output", str(folder), *more])


def test_it_writes_the_table_and_runs_nothing_twice(claims, tmp_path, runs, capsys):
    folder = tmp_path / "out"
    assert validate(claims(), folder) == 0
    table = Table.read(folder / "claims.ecsv")
    assert list(table["id"]) == ["noise", "closed", "real"]
    assert list(table["verdict"]) == ["differs, explained", "agrees", "needs data we do not have"]
    row = table[0]
    assert row["realizations"] == 4
    assert row["standard_error"] == pytest.approx(row["scatter"] / 2)
    assert row["distance_mean"] > row["distance_one"] > 2
    values = Table.read(folder / "noise" / "values.ecsv")
    assert list(values["value"][:4]) != [values["value"][0]] * 4  # seeds differ
    assert values["value"][:4].mean() == pytest.approx(row["zonda"], rel=1e-8)
    assert (folder / "noise" / "values.png").stat().st_size > 1000
    assert set(values["unit"][:4]) == {"uK"}
    assert not any(values["unit"][4:])  # the counter-experiment is a ratio
    assert list(values["value"][4:]) == pytest.approx([2.0] * 4, rel=1e-3)
    html = (folder / "claims.html").read_text()
    assert "gives twice the rms (2" in html
    assert 'id="noise"' in html
    assert "differs, explained" in html
    # 4 realizations of the claim, 4 of each of the counter-experiment's two
    assert len(runs) == 12
    runs.clear()
    capsys.readouterr()
    assert validate(claims(), folder) == 0
    assert runs == []
    assert "run" not in capsys.readouterr().err.split()


def test_what_is_missing_is_run_and_nothing_else(claims, tmp_path, runs):
    folder = tmp_path / "out"
    validate(claims(), folder, "noise")
    first = Table.read(folder / "claims.ecsv")["zonda"][0]
    for path in (folder / "runs").glob("*.json"):
        stored = json.loads(path.read_text())
        if not stored["settings"]:
            del stored["values"]["2"]  # as after an interruption
            path.write_text(json.dumps(stored))
    runs.clear()
    validate(claims(), folder, "noise")
    assert [overrides for overrides, _ in runs] == [()]
    assert Table.read(folder / "claims.ecsv")["zonda"][0] == first
    for path in (folder / "runs").glob("*.json"):
        path.write_text("{")  # damaged: measured anew
    runs.clear()
    validate(claims(), folder, "noise")
    assert len(runs) == 12


def test_a_changed_pipeline_is_run_again(claims, tmp_path, runs):
    folder = tmp_path / "out"
    validate(claims(), folder, "noise")
    runs.clear()
    (tmp_path / "small.yaml").write_text(PIPELINE.replace("5 s", "6 s"))
    validate(claims(), folder, "noise")
    assert len(runs) == 12


def test_pictures_of_one_run_are_drawn_once(claims, tmp_path, runs):
    path = claims()
    text = path.read_text().replace("    seeds: 4\n", "    seeds: 4\n    pictures: true\n", 1)
    row = text.partition("  - id: noise")[2].partition("    because")[0]
    path.write_text(f"{text}\n  - id: noise_again{row}")
    folder = tmp_path / "out"
    assert validate(path, folder, "noise", "noise_again") == 1  # the second explains nothing
    assert (folder / "noise" / "map.png").read_bytes() == (
        folder / "noise_again" / "map.png"
    ).read_bytes()
    assert len(runs) == 13
    validate(path, folder, "noise", "noise_again")
    assert len(runs) == 13


def test_pictures_of_another_pipeline(claims, tmp_path, runs, capsys):
    path = claims()
    seen = (
        PIPELINE.replace("  - BinMap", "  - PowerSpectrum\n  - TimeStreams\n  - BinMap")
        + "  - SaveMap\n  - Plots\n"
    )
    (tmp_path / "seen.yaml").write_text(seen)
    row = "    seeds: 4\n    change: {WhiteNoise.net: 3 mK s(1/2)}\n"
    path.write_text(path.read_text().replace("    seeds: 4\n", row + "    pictures: seen\n", 1))
    folder = tmp_path / "out"
    validate(path, folder, "noise")
    change = ('WhiteNoise.net="3 mK s(1/2)"',)
    assert [runs.count((change, what)) for what in ("measured", "drawn")] == [4, 1]
    found = {file.name for file in (folder / "noise").glob("*.png")}
    assert {"values.png", "map.png", "power_spectra.png"} <= found
    assert not list(folder.rglob("*.fits"))  # of the other pipeline only pictures are kept
    assert "noise/power_spectra.png" in (folder / "claims.html").read_text()
    made = len(runs)
    validate(path, folder, "noise")
    assert len(runs) == made
    (tmp_path / "seen.yaml").write_text(PIPELINE)
    validate(path, folder, "noise")
    assert len(runs) == made + 1
    assert not (
        folder / "noise" / "power_spectra.png"
    ).exists()  # the new pipeline does not draw it
    path.write_text(path.read_text().replace("pictures: seen", "pictures: sen"))
    runs.clear()
    capsys.readouterr()
    assert validate(path, tmp_path / "other", "noise") == 2
    assert "claim noise" in capsys.readouterr().err
    assert runs == []  # the mistake is found before anything is run


def test_exit_statuses(claims, tmp_path, capsys):
    folder = tmp_path / "out"
    assert (
        validate(claims(low="2.005"), folder, "noise") == 1
    )  # a criterion that is not satisfied explains nothing
    assert "its criterion is not satisfied" in (folder / "claims.html").read_text()
    assert validate(claims(), folder, "nosie") == 2
    assert "did you mean 'noise'?" in capsys.readouterr().err
    assert validate(tmp_path / "none.yaml", folder) == 2
    assert validate(claims(), folder, "--quick", "noise") == 2
    assert validate(claims(), folder, "--quick", "closed") == 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("pipeline: small", "pipeline: smal", "claim noise"),
        ("central_rms", "central_rsm", "central_rms"),
        ("WhiteNoise.net: 2", "WhitNoise.net: 2", "WhiteNoise"),
        ("radius: 1 arcmin", "radius: 1 s", "claim noise"),
        ("central_rms: {radius: 1 arcmin}", "psd_slope: {}", "spectrum"),
    ],
)
def test_mistakes_that_only_a_run_shows(claims, tmp_path, capsys, old, new, message):
    path = claims()
    path.write_text(path.read_text().replace(old, new))
    assert validate(path, tmp_path / "out", "noise") == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_the_list_runs_nothing(claims, tmp_path, capsys, runs):
    assert validate(claims(), tmp_path / "out", "--list") == 0
    assert "One is one." in capsys.readouterr().out
    assert runs == []
    assert not (tmp_path / "out").exists()


def test_the_shipped_rows_name_pipelines_keys_and_metrics_that_there_are(tmp_path):
    from zonda.plugins.validation.rows import Runs

    runs = Runs(tmp_path, SHIPPED.parent)
    for claim in read(SHIPPED).claims:
        for _, experiment in claim.experiments():
            runs.want(experiment)  # reads every pipeline with its changes


def test_the_quick_rows_are_decided(tmp_path):
    assert main(["validate", "--quick", "--output", str(tmp_path)]) == 0


def test_a_counter_of_another_quantity_has_axes_of_its_own(claims, tmp_path):
    from zonda.plugins.validation.page import draw
    from zonda.plugins.validation.rows import Row, Runs

    path = claims()
    claim, runs = read(path).claims[0], Runs(tmp_path / "out", path.parent)
    for _, experiment in claim.experiments():
        runs.want(experiment)
    runs.experiment.run()
    own, other = draw(Row.of(claim, runs)).axes
    assert (own.get_xlabel(), other.get_xlabel()) == ("uK", "ratio")
    assert other.get_xlim()[0] > 1.9
    assert other.get_xlim()[1] < 2.1


def test_the_atmosphere_of_a_site_is_drawn(tmp_path):
    from zonda.core.configuration.pipeline_file import load
    from zonda.plugins.validation.rows import atmosphere_figure

    emission, transmission = atmosphere_figure(
        load(SHIPPED.parent / "mustang2.yaml", ()).scene()
    ).axes
    # several PWVs, in order: at 220 GHz more vapour lets less through
    curves = [line for line in transmission.lines if str(line.get_label()).startswith("PWV")]
    assert len(curves) >= 3
    found = sorted(
        (float(c.get_label().split()[1]), c.get_ydata()[abs(c.get_xdata() - 220).argmin()])
        for c in curves
    )
    assert [passed for _, passed in found] == sorted((passed for _, passed in found), reverse=True)
    assert emission.get_xlim() == (1.0, 1000.0)
