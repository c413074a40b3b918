"""``zonda noise``: the table of a file, and what a pipeline makes of it."""

import numpy as np
import pytest
from astropy.table import Table
from click.testing import CliRunner

import zonda
from zonda.core import cli
from zonda.core.errors import InputError
from zonda.operators.io.save_tod import load_tod, save_tod
from zonda.plugins.commands.noise import noise

pytestmark = pytest.mark.filterwarnings("ignore:Pointing")
SCENE = {"site": "green_bank", "time": "2024-11-25T07:00", "target": "05h +20d", "seed": 3}
CAMERA = {"like": "mustang2", "detectors": 12, "net": "1 mK s(1/2)"}


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    folder = tmp_path_factory.mktemp("night")
    scan = zonda.PointingDaisy(radius="1 arcmin", scan_duration="5 min", sample_rate="50 Hz")
    steps = [
        scan,
        zonda.WhiteNoise(scatter=0.3),
        zonda.PinkNoise(knee="1 Hz"),
        zonda.Efficiency(),
        zonda.SaveTOD(),
    ]
    data = zonda.Pipeline(steps).run(
        zonda.Scene(instrument=CAMERA, **SCENE), output=folder, threads=1
    )
    (path,) = folder.glob("tod_*.h5")
    return path, data.observations[0].focalplane


def test_the_table_and_the_scan_that_it_belongs_to(night, tmp_path):
    path, plane = night
    table = tmp_path / "table.ecsv"
    done = CliRunner().invoke(noise, [str(path), "--output", str(table)])
    assert done.exit_code == 0, done.output
    assert "12 of 12 detectors" in done.output
    found = Table.read(table, format="ascii.ecsv")
    assert list(found["name"]) == plane.names
    for name in ("net", "knee"):
        pulls = (found[name] - getattr(plane, name)) / found[f"{name}_error"]
        assert np.abs(pulls).max() < 5, name  # of twelve detectors
    step = zonda.LoadTOD(file=path, noise=table, signal="none")
    steps = [step, zonda.WhiteNoise(), zonda.Efficiency(), zonda.BinMap(pixel="5 arcsec")]
    data = zonda.Pipeline(steps).run(step.scene(), threads=1)
    np.testing.assert_allclose(
        data.observations[0].focalplane.net, found["net"], rtol=1e-8
    )  # nine digits in the table


def test_a_flagged_detector_is_in_no_table(night, tmp_path):
    """And none is wanted: it weighs nothing."""
    tod = load_tod(night[0])
    tod.detector_flags[4] = 1
    path, table = save_tod(tmp_path / "flagged.h5", tod), tmp_path / "table.ecsv"
    done = CliRunner().invoke(noise, [str(path), "--output", str(table)])
    assert done.exit_code == 0, done.output
    step = zonda.LoadTOD(file=path, noise=table)
    data = zonda.Pipeline([step, zonda.BinMap(pixel="5 arcsec")]).run(step.scene(), threads=1)
    found = Table.read(table, format="ascii.ecsv")["net"]
    net = data.observations[0].focalplane.net
    np.testing.assert_array_equal(np.delete(net, 4), found)
    assert net[4] == pytest.approx(night[1].net[4])  # the file's
    with pytest.raises(InputError, match="1 of 12 detectors are not in"):
        zonda.LoadTOD(file=path, noise=table, detector_mask=0).scene()


def test_the_mean_over_the_detectors(night, tmp_path):
    path, plane = night
    done = CliRunner().invoke(
        noise, [str(path), "--subtract-mean", "--output", str(tmp_path / "t.ecsv")]
    )
    assert done.exit_code == 0, done.output
    found = Table.read(tmp_path / "t.ecsv", format="ascii.ecsv")
    # the mean of detectors of other levels is not quite theirs: 30 % of scatter over 12 of them
    assert abs(np.mean(found["net"]) / np.mean(plane.net) - 1) < 0.03


def test_the_mean_is_that_of_a_band(night, tmp_path):
    """Emission that is ten times as strong in half of the detectors, those of another band, leaves
    nothing in either band.
    """
    path, plane = night
    tod = load_tod(path)
    other = np.arange(tod.n_detectors) % 2 == 1
    tod.columns["band_centre"] = np.where(other, 150e9, 90e9)
    common = 0.1 * np.cumsum(np.random.default_rng(1).normal(size=tod.n_samples))
    tod.streams["signal"] = tod.streams["signal"] + np.where(other, 10.0, 1.0)[:, None] * common
    file = save_tod(tmp_path / "two.h5", tod)
    done = CliRunner().invoke(
        noise, [str(file), "--subtract-mean", "--output", str(tmp_path / "t.ecsv")]
    )
    assert done.exit_code == 0, done.output
    found = Table.read(tmp_path / "t.ecsv", format="ascii.ecsv")
    for rows in (
        other,
        ~other,
    ):  # 30 % of scatter over 6 detectors; one mean for all would leave 0.4 K per sample
        assert abs(np.mean(found["net"][rows]) / np.mean(plane.net[rows]) - 1) < 0.1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,net,knee\nd00,1,1\n", "no column"),
        ("not a table", "has no rows"),
    ],
)
def test_other_tables_are_refused(night, tmp_path, text, message):
    (tmp_path / "bad.ecsv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        zonda.LoadTOD(file=night[0], noise=tmp_path / "bad.ecsv").scene()
    assert "bad.ecsv" in caught.value.place
    assert "zonda noise" in caught.value.cure


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [("d03", "d02", "twice"), ("d03", "d99", "not in"), (None, "nan", "is nan")],
)
def test_rows_that_cannot_be(night, tmp_path, old, new, message):
    path, table = night[0], tmp_path / "table.ecsv"
    assert CliRunner().invoke(noise, [str(path), "--output", str(table)]).exit_code == 0
    text = table.read_text()
    if old is None:
        row = next(line for line in text.splitlines() if line.startswith("d03,"))
        cells = row.split(",")
        text = text.replace(row, ",".join([*cells[:3], new, *cells[4:]]))
    else:
        text = text.replace(f"\n{old},", f"\n{new},")
    table.write_text(text)
    with pytest.raises(InputError, match=message):
        zonda.LoadTOD(file=path, noise=table).scene()


def test_errors_have_no_traceback(night, tmp_path, capsys):
    assert cli.main(["noise", str(tmp_path / "absent.h5")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert cli.main(["noise", str(night[0]), "--signal", "sky"]) == 2
    assert "choose --signal from: signal" in capsys.readouterr().err
    assert cli.main(["noise", str(night[0]), "--segment", "4 m"]) == 2
    assert "Traceback" not in capsys.readouterr().err
