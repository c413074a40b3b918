"""`zonda weather`: what it prints, draws and refuses."""

import pytest

from zonda.core import cli


def weather(*arguments):
    return cli.main(["weather", *map(str, arguments)])


def test_site_by_name(tmp_path, capsys):
    figure = tmp_path / "air.png"
    given = [
        "chajnantor",
        "--time",
        "2022-08-01T23:00",
        "--pwv",
        "1.2mm",
        "--instrument",
        "atlast",
        "--instrument",
        "ccat",
        "--output",
        figure,
    ]
    assert weather(*given) == 0
    text = capsys.readouterr().out
    for words in (
        "llano_de_chajnantor",
        "5064 m; 2022-08-01T23:00:00Z",
        "PWV: 1.2 mm, as given",
        "PWV [mm]: median by hour (UTC)",
        "\nJul ",
        "atlast_92ghz (66 to 118 GHz)",
        "ccat_280ghz",
        "PWV 1.20 mm:",
        str(figure),
    ):
        assert words in text
    assert figure.read_bytes()[:4] == b"\x89PNG"


def test_any_place_with_its_water(tmp_path, capsys):
    assert (
        weather("-46.5 deg, 8 deg, 3500 m", "--pwv", "3 mm", "--output", tmp_path / "air.svg") == 0
    )
    text = capsys.readouterr().out
    assert "US Standard Atmosphere" in text
    assert "by hour" not in text
    assert "<svg" in (tmp_path / "air.svg").read_text()


def test_the_figure_has_a_name_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert weather("green_bank", "--time", "2024-11-25") == 0
    assert (tmp_path / "out" / "weather" / "green_bank.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["green_bnk"], "did you mean 'green_bank'?"),
        (["chiang_mai"], "site 'chiang_mai': has no climatology"),
        (["46 deg, 8 deg, 3500 m"], "site 'place': has no climatology"),
        (["46 deg, 8 deg"], "a place is 'latitude, longitude, altitude'"),
        (
            ["146 deg, 8 deg, 0 m", "--pwv", "3 mm"],
            "latitude: 146 deg is outside the limits, -90 to 90 deg",
        ),
        (
            ["46 deg, 8 deg, -600 m", "--pwv", "3 mm"],
            "altitude: -600 m is outside the limits, -500 to 9000 m",
        ),
        (["green_bank", "--pwv", "nan"], "cannot read 'nan' as a length"),
        (["green_bank", "--pwv", "100 %"], "a quantile of 100 % is outside the limits"),
        (["green_bank", "--pwv", "500mm"], "500 mm is outside the limits, 0 to 60 mm"),
        (["green_bank", "--pwv", "-1mm"], "-1 mm is outside the limits, 0 to 60 mm"),
        (
            ["green_bank", "--time", "1850-01-01"],
            "outside what the climatology stands for, 1940 to 2100",
        ),
        (["green_bank", "--time", "noon"], "cannot read 'noon' as a time"),
        (["green_bank", "--elevation", "0 deg"], "0 deg is outside the limits, "),
        (["green_bank", "--instrument", "mustang"], "did you mean 'mustang2'?"),
        (["green_bank", "--file", "none.nc"], "no such file"),
        (["green_bank", "--output", "air.txt"], "does not end in .png, .pdf or .svg"),
        ([], "Usage"),
    ],
)
def test_mistakes(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert weather(*arguments) == 2
    captured = capsys.readouterr()
    assert words in captured.out + captured.err
    assert "Traceback" not in captured.err


def test_fetch_without_the_package(capsys, monkeypatch, tmp_path):
    import sys

    monkeypatch.setitem(sys.modules, "cdsapi", None)
    assert weather("fetch", "green_bank", "--output", tmp_path / "era5.nc") == 2
    assert "pip install 'zonda[weather]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_dry_air(tmp_path, capsys):
    assert (
        weather(
            "chajnantor", "--pwv", "0mm", "--instrument", "atlast", "--output", tmp_path / "dry.png"
        )
        == 0
    )
    assert "PWV 0.00 mm" in capsys.readouterr().out
