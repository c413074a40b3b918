"""`zonda sensitivity`: what it prints, writes and refuses."""

import json

import pytest

import zonda
from zonda.core import cli
from zonda.core.errors import InputError
from zonda.plugins.forecast.depth import duration, in_unit, read_depth, unit_of

MEAN = (
    "--set",
    "CommonModeFilter.method=mean",
)  # noise turns the singular mode of a short scan: no forecast of the atmosphere
SHORT = "--set", "PointingDaisy.scans=1", "--set", "PointingDaisy.scan_duration=30 s", *MEAN
M2 = "--instrument", "mustang2", "--site", "green_bank", "--month", "11"


def sensitivity(*arguments):
    return cli.main(["sensitivity", *map(str, arguments)])


def test_of_a_pipeline(capsys):
    assert sensitivity("mustang2_cluster", *SHORT, "--reach", "20 uK") == 0
    text = " ".join(capsys.readouterr().out.split())
    for words in (
        "mustang2 at green_bank, 1 scan, 30 s in all",
        "PWV 7.7 mm with 0.5 % rms",
        "filters: high-pass 0.08 Hz, common mode",
        "beam of 8.5 arcsec, averaged over a circle of radius 0.5 arcmin",
        "time uK_RJ white 1/f atmosphere uK_CMB uJy/beam MJy/sr point source uJy",
        "stated errors of the rms: white 5 %, 1/f 5 %, atmosphere",
        "at the band's centre",
        "20 uK after ",
        "noise alone: behind these filters a point source keeps ",
    ):
        assert words in text
    assert "# the pipeline" not in text


def test_of_an_instrument_with_files(tmp_path, capsys):
    out = tmp_path / "depth"
    assert (
        sensitivity(
            *M2,
            "--pwv",
            "7.7 mm",
            "--integration",
            "1 min",
            "--set",
            "PointingDaisy.scan_duration=60 s",
            *MEAN,
            "--set",
            "PinkNoise.shared=0.8",
            "--radius",
            "0.6 arcmin",
            "--output",
            out,
        )
        == 0
    )
    text = capsys.readouterr().out
    assert "# the pipeline:" in text
    assert "weather: {pwv: 7.7 mm}" in text
    assert "# --set PinkNoise.shared=0.8" in text
    assert (out / "sensitivity.png").read_bytes()[:4] == b"\x89PNG"
    from astropy.table import Table

    table = Table.read(out / "sensitivity.ecsv")
    assert str(table["time"].unit) == "s"
    parts = table["white"] ** 2 + table["one_over_f"] ** 2 + table["atmosphere"] ** 2
    assert (table["depth_K_RJ"] ** 2 / parts).tolist() == pytest.approx([1] * len(table))
    again = zonda.load(out / "pipeline.yaml")
    assert next(o for o in again.operators if type(o).__name__ == "PinkNoise").shared == 0.8


def test_json(capsys):
    assert (
        sensitivity(
            "mustang2_cluster", *SHORT, "--json", "--integration", "2 h", "--radius", "1 arcmin"
        )
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert found["radius_arcmin"] == pytest.approx(1)
    row = next(r for r in found["table"] if r["seconds"] == 7200)
    assert not row["followed"]
    assert row["depth"]["K_RJ"] ** 2 == pytest.approx(sum(v**2 for v in row["K_RJ"].values()))
    assert row["depth"]["Jy"] == pytest.approx(2 * row["depth"]["Jy/beam"])


FEW = *SHORT, "--set", "instrument={like: mustang2, detectors: 19}"


def test_the_audit_stands_beside_the_forecast_whatever_the_threads(tmp_path, capsys):
    """Each part with its difference in standard errors; the same bits with one thread and with
    two.
    """
    found = []
    for threads in (1, 2):
        assert (
            sensitivity("mustang2_cluster", *FEW, "--audit", "2", "--threads", threads, "--json")
            == 0
        )
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1]
    assert 0 < found[0]["keeps"]["Gaussian of FWHM 1′"] < found[0]["keeps"]["point source"] < 1
    rows = {row["part"]: row for row in found[0]["audit"]}
    assert list(rows) == ["white", "1/f", "atmosphere", "together"]
    for row in rows.values():
        assert row["seeds"] == 2
        assert row["z"] == pytest.approx((row["forecast"] - row["mean"]) / row["error"])
    parts = [rows[name]["forecast"] ** 2 for name in ("white", "1/f", "atmosphere")]
    assert rows["together"]["forecast"] ** 2 == pytest.approx(sum(parts))
    # two maps know white noise to some 10 %; the forecast is good to 5 %
    assert abs(rows["white"]["z"]) < 5
    assert found[0]["calculator"].keys() >= {"Jy_at_centre", "Jy_over_band"}


def test_the_audit_in_words(tmp_path, capsys):
    assert (
        sensitivity("mustang2_cluster", *FEW, "--audit", "2", "--output", tmp_path / "depth") == 0
    )
    text = " ".join(capsys.readouterr().out.split())
    assert "audit: 2 simulations of the whole pipeline forecast [" in text
    assert "simulated standard error difference z white " in text
    assert "at the band's centre, " in text
    assert "averaged over the band" in text


def test_an_audit_beside_a_part_that_is_not_forecast(tmp_path, capsys):
    """A scan of 30 s behind a singular mode: the atmosphere is left out, with the reason, and the
    rest is audited and drawn.
    """
    singular = *FEW, "--set", "CommonModeFilter.method=svd"
    assert (
        sensitivity("mustang2_cluster", *singular, "--audit", "2", "--output", tmp_path / "depth")
        == 0
    )
    text = " ".join(capsys.readouterr().out.split())
    assert "is not forecast, and comes on top (S/N are without it): noise turns" in text
    assert "audit: 2 simulations of the whole pipeline forecast [" in text
    assert (tmp_path / "depth" / "sensitivity.png").exists()


def test_a_folder_that_takes_no_files_is_told_before_anything_is_forecast(capsys):
    assert sensitivity("mustang2_cluster", "--audit", "200", "--output", "/proc/zonda") == 2
    assert "/proc/zonda: cannot be made: /proc takes no new folders" in capsys.readouterr().err


def test_in_python():
    file = zonda.load(
        "mustang2_cluster", ["PointingDaisy.scans=1", "PointingDaisy.scan_duration=30 s"]
    )
    found = zonda.sensitivity(file)
    assert found.rms(3600, "K_CMB") > found.rms(3600) > found.rms(3600, part="white")
    assert "uK_RJ" in found._repr_html_()
    assert found.plot().axes[0].get_xlabel() == "integration time [h]"
    with pytest.raises(InputError, match="no depth in 'Kelvin'"):
        found.rms(unit="Kelvin")
    with pytest.raises(TypeError, match="unexpected keyword argument 'insturment'"):
        zonda.sensitivity(insturment="mustang2")
    with pytest.raises(InputError, match="when it is loaded"):
        zonda.sensitivity(file, settings=["seed=1"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "neither a pipeline nor --instrument"),
        (("--instrument", "mustang2"), "--site"),
        (
            ("mustang2_cluster", "--pwv", "3 mm"),
            "--pwv is part of a pipeline, and cannot be given beside one",
        ),
        (("mustang2", "--pwv", "3 mm"), "mustang2 is an instrument: write --instrument mustang2"),
        (("no_such_pipeline",), "no_such_pipeline"),
        ((*M2, "--target", "nowhere"), "--target"),
        ((*M2, "--quantile", "2"), "--quantile"),
        ((*M2, "--elevation", "20"), "20 has no unit; write an angle such as '60 deg'"),
        ((*M2, "--integration", "2"), "2 has no unit; write a time such as '3 h'"),
        ((*M2, "--time", "2 h"), "--time: a time is a moment in zonda"),
        ((*M2, "--time", "2 h"), "--integration '2 h'"),
        (
            ("mustang2_cluster", "--set", "CommonModeFilter.modes=3"),
            "the forecast does not cover modes: 3",
        ),
        (("mustang2_cluster", *SHORT, "--reach", "10 apples"), "'apples' is no unit of a depth"),
        (("mustang2_cluster", *SHORT, "--reach", "100"), "100 has no unit"),
        (("mustang2_cluster", *SHORT, "--reach", "5 sigma"), "--reach: a signal-to-noise ratio is"),
        (("mustang2_cluster", *SHORT, "--source", "point", "--peak", "1 mJy"), "no unit of a peak"),
        (("mustang2_cluster", *SHORT, "--reach", "deep"), "cannot read 'deep' as a depth"),
        (("mustang2_cluster", *SHORT, "--reach", "0 uK"), "no observation reaches"),
        (("mustang2_cluster", *SHORT, "--radius", "1 deg"), "is not on the map"),
        (("mustang2_cluster", *SHORT, "--audit", "1"), "--audit"),
    ],
)
def test_refusals(arguments, words, capsys):
    assert sensitivity(*arguments) == 2
    told = capsys.readouterr().err
    assert words in told
    assert "Traceback" not in told


def test_depths_with_units():
    factors = {"K_RJ": 1.0, "K_CMB": 2.0, "Jy/beam": 4.0, "MJy/sr": 5.0, "Jy": 8.0}
    given = {
        "10 uK": 1e-5,
        "10uK_RJ": 1e-5,
        "10 µK_CMB": 5e-6,
        "8 mJy/beam": 2e-3,
        "5 kJy/sr": 1e-3,
        "8 uJy": 1e-6,
        "1 K": 1.0,
    }
    for text, kelvin in given.items():
        assert read_depth(text, factors) == pytest.approx(kelvin)
    assert in_unit(158e-6, "K_RJ") == "158 uK_RJ"
    assert in_unit(2e-3, "MJy/sr") == "2 kJy/sr"
    assert [unit_of(t) for t in (30, 516, 7200)] == ["s", "min", "h"]
    assert [duration(t, "min") for t in (30, 516, 7200)] == ["0.5 min", "8.6 min", "120 min"]
