"""What a user gets for bad input, from the command line: where, what, what would mend it, and
nothing half done.
"""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from zonda.core import cli

PIPELINE = """\
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h00m00s +20d00m00s
seed: 1
operators:
  - PointingDaisy: {scan_duration: 2 s}
  - SkyMap: {file: map.fits}
  - WhiteNoise
  - Efficiency
  - BinMap
  - SaveMap
"""


WORLD = ("CTYPE1", "CTYPE2", "CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2", "CDELT1", "CDELT2")


def write_map(path: Path, values: np.ndarray | None = None, **cards: object) -> None:
    from astropy.io import fits

    image = fits.PrimaryHDU(np.ones((11, 11)) if values is None else values)
    header = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CRPIX1": 6,
        "CRPIX2": 6,
        "CRVAL1": 75.0,
        "CRVAL2": 20.0,
    }
    header |= {
        "CDELT1": -1 / 60,
        "CDELT2": 1 / 60,
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "BUNIT": "K",
        "TEMPSCAL": "K_RJ",
    }
    image.header.update({k: v for k, v in (header | cards).items() if v is not None})
    image.writeto(path)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_map(tmp_path / "map.fits")
    (tmp_path / "my.yaml").write_text(PIPELINE)
    return tmp_path


def refused(capsys, command="run", *more):
    """The message of a command that must fail as a user's mistake."""
    status = cli.main(
        [command, "my.yaml", *(["--output", "out"] if command == "run" else []), *more]
    )
    message = capsys.readouterr().err
    assert status == 2, message
    assert "Traceback" not in message
    left = [
        p
        for p in Path().rglob("*")
        if p.is_file() and p.name not in ("my.yaml", "map.fits", "resolved.yaml")
    ]
    assert not left, left
    return message


def test_the_pipeline_itself_is_good(here, capsys):
    assert cli.main(["check", "my.yaml"]) == 0
    assert cli.main(["run", "my.yaml", "--output", "out"]) == 0
    assert (here / "out" / "map.fits").is_file()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("map.fits", "nowhere.fits"), ["nowhere.fits", "no such file"]),
        (
            ("- SkyMap", "- SkyMpa"),
            ["my.yaml:8:5", "unknown operator 'SkyMpa'", "did you mean 'SkyMap'?"],
        ),
        (
            ("mustang2", "mustang3"),
            ["my.yaml:2:13", "unknown instrument 'mustang3'", "did you mean 'mustang2'?"],
        ),
        (
            ("green_bank", "green_bnak"),
            ["my.yaml:1:7", "unknown site 'green_bnak'", "did you mean 'green_bank'?"],
        ),
        (("2 s}", "-2 s}"), ["my.yaml:7:36", "scan_duration: must be greater than 0", "got -2 s"]),
        (
            ("2 s}", "2 s, sample_rate: 0 Hz}"),
            ["my.yaml:7:54", "sample_rate: must be greater than 0 Hz, got 0 Hz"],
        ),
        (("2 s}", "2 arcsec}"), ["my.yaml:7:38", "'arcsec' is a unit of angle"]),
        (
            ("  - WhiteNoise\n  - Efficiency\n", "  - Efficiency\n  - WhiteNoise\n"),
            ["WhiteNoise", "only after Efficiency"],
        ),
        (
            ("  - BinMap\n  - SaveMap\n", "  - SaveMap\n  - BinMap\n"),
            ["SaveMap needs map", "move it below BinMap"],
        ),
    ],
)
@pytest.mark.parametrize("command", ["check", "run"])
def test_what_the_file_shows(here, capsys, command, change, words):
    assert change[0] in PIPELINE
    (here / "my.yaml").write_text(PIPELINE.replace(*change))
    message = refused(capsys, command)
    assert all(w in message for w in words), message
    assert "^" in message  # a caret under it


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"BUNIT": "parsec"}, ["map.fits", "parsec", "Jy/pixel", "K_CMB"]),
        ({"BUNIT": None}, ["map.fits", "BUNIT", "unit"]),
        ({"BUNIT": 3.0}, ["map.fits", "BUNIT = 3.0"]),
        ({"BUNIT": "Jy/beam"}, ["map.fits", "BMAJ", "input_beam"]),
        (
            {"BUNIT": "Jy/beam", "BMAJ": "20 arcsec"},
            ["map.fits", "BMAJ = '20 arcsec'", "input_beam"],
        ),
        ({"BUNIT": "Jy/beam", "BMAJ": 20.0}, ["map.fits", "20 deg", "BMAJ", "input_beam"]),
        (
            {"BUNIT": "Jy/beam", "BMAJ": 20 / 206265},
            ["map.fits", "0.3491 arcsec", "BMAJ", "input_beam"],
        ),
        ({"TEMPSCAL": None}, ["map.fits", "K_RJ", "K_CMB"]),
        ({"TEMPSCAL": 2.0}, ["map.fits", "TEMPSCAL = 2.0"]),
        (dict.fromkeys(WORLD), ["CDELT", "pixel_size"]),
        ({"CDELT1": None, "CDELT2": None}, ["map.fits", "CDELT1"]),
        ({"RADESYS": "MOON"}, ["map.fits", "RADESYS = 'MOON'", "ICRS"]),
        ({"RADESYS": 2000.0}, ["map.fits", "RADESYS = 2000.0"]),
        ({"RADESYS": "GAPPT"}, ["map.fits", "RADESYS = 'GAPPT'", "ICRS"]),
        ({"RADESYS": "FK5", "EQUINOX": "J2000"}, ["map.fits", "EQUINOX = 'J2000'"]),
    ],
)
@pytest.mark.parametrize("command", ["check", "run"])
def test_what_the_map_lacks(here, capsys, command, cards, words):
    (here / "map.fits").unlink()
    write_map(here / "map.fits", **cards)
    message = refused(capsys, command)
    assert all(w in message for w in words), message


@pytest.mark.parametrize("command", ["check", "run"])
def test_what_a_cube_and_a_polarized_map_lack(here, capsys, command):
    (here / "map.fits").unlink()
    write_map(here / "map.fits", np.ones((3, 11, 11)))
    assert "plane: 1 in a pipeline file" in refused(capsys, command)
    (here / "map.fits").unlink()
    write_map(
        here / "map.fits", np.ones((3, 11, 11)), CTYPE3="STOKES", CRPIX3=1.0, CRVAL3=1.0, CDELT3=1.0
    )
    (here / "my.yaml").write_text(
        PIPELINE.replace("mustang2", "{like: mustang2, detectors: 8, polarization: pairs}")
    )
    assert "polarization_convention" in refused(capsys, command)


@pytest.mark.parametrize("command", ["check", "run"])
def test_a_unit_without_its_temperature_scale(here, capsys, command):
    (here / "map.fits").unlink()
    write_map(here / "map.fits", TEMPSCAL=None)
    (here / "my.yaml").write_text(PIPELINE.replace("map.fits}", "map.fits, unit: mK}"))
    message = refused(capsys, command)
    assert all(w in message for w in ("my.yaml:8", "'mK'", "TEMPSCAL")), message


@pytest.mark.parametrize("system", ["J2000", "j2000", "fk5", "FK5 (J2000)"])
def test_frames_by_other_names(here, capsys, system):
    """What CASA and others call FK5 is that, to the last bit; `check` says so."""
    from astropy.io import fits

    made = []
    for name, written in (("fk5", "FK5"), ("other", system)):
        (here / "map.fits").unlink()
        values = np.random.default_rng(0).normal(size=(11, 11))
        write_map(here / "map.fits", values, RADESYS=written)
        assert (
            cli.main(["run", "my.yaml", "--output", name, "--set", "instrument.sample_rate=20 Hz"])
            == 0
        )
        made.append(fits.getdata(here / name / "map.fits"))
    assert np.isfinite(made[0]).any()
    assert np.array_equal(made[0], made[1], equal_nan=True)
    capsys.readouterr()
    assert cli.main(["check", "my.yaml"]) == 0
    assert f"coordinates: FK5: RADESYS = '{system}'" in capsys.readouterr().out


@pytest.mark.parametrize("scale", [1 / 60 * 206265, 1 / 60 / 206265])
def test_pixels_far_too_large_or_too_small_are_doubted(here, capsys, warned, scale):
    """A side in arcsec, or in radians, where degrees are due."""
    (here / "map.fits").unlink()
    write_map(here / "map.fits", CDELT1=-scale, CDELT2=scale)
    cli.main(["check", "my.yaml"])
    assert "CDELT1" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["check", "run"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_in_the_map(here, capsys, bad, command):
    (here / "map.fits").unlink()
    values = np.ones((11, 11))
    values[3, 4] = values[7, 7] = bad
    write_map(here / "map.fits", values)
    message = refused(capsys, command)
    assert all(w in message for w in ("map.fits", "2 ", "missing: zero")), message


def test_a_target_that_is_never_up(here, capsys):
    (here / "my.yaml").write_text(PIPELINE.replace("+20d00m00s", "-80d00m00s"))
    message = refused(capsys)
    assert all(
        w in message for w in ("never rises", "green_bank", "choose another target or site")
    ), message


def test_a_target_that_is_never_up_is_told_beside_other_mistakes(here, capsys):
    text = PIPELINE.replace("+20d00m00s", "-70d00m00s").replace(
        "- BinMap", "- BinMap: {pixel: 5 arcsecs}"
    )
    (here / "my.yaml").write_text(text)
    message = refused(capsys, "check")
    assert "2 mistakes in my.yaml" in message
    assert "never rises" in message
    assert "my.yaml:7:5" in message  # of the pointing step
    assert "unknown unit 'arcsecs'" in message


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"instrument: mustang2": "instrument: mustang3"}, "unknown instrument"),
        (
            {"05h00m00s +20d00m00s": "map", "map.fits": "none.fits"},
            "no such file",
        ),  # there is no target to point at
        (
            {
                "scan_duration: 2 s": "scan_duration: 2 m",
                "- SaveMap": "- TimeStreams: {observation: 0}\n  - SaveMap",
            },
            "expected a time",
        ),
    ],
)
def test_where_the_telescope_cannot_be_pointed_nothing_else_is_said(here, capsys, change, told):
    text = PIPELINE
    for old, new in change.items():
        text = text.replace(old, new)
    (here / "my.yaml").write_text(text)
    message = refused(capsys, "check")
    assert told in message
    assert "1 mistake in my.yaml" in message


def test_mistakes_in_the_files_of_several_steps_stand_at_their_parameters(
    here, capsys, tmp_path_factory
):
    files = tmp_path_factory.mktemp("tables")
    (files / "night.txt").write_text("no schedule")
    (files / "sources.csv").write_text("ra [deg], dec [deg], flux [Jy]\n75, 20, 1\n75, 95, 1\n")
    text = PIPELINE.replace(
        "PointingDaisy: {scan_duration: 2 s}", f"PointingSchedule: {{schedule: {files}/night.txt}}"
    )
    (here / "my.yaml").write_text(
        text.replace(
            "SkyMap: {file: map.fits}", f"PointSources: {{catalogue: {files}/sources.csv}}"
        )
    )
    for command in ("check", "run"):
        message = refused(capsys, command)
        assert "my.yaml:7:34" in message
        assert "is no schedule" in message
        assert "my.yaml:8:31" in message
        assert "line 3: dec is 95 deg" in message
        assert "2 mistakes in my.yaml" in message


def test_a_target_that_is_up_later(here, capsys):
    (here / "my.yaml").write_text(PIPELINE.replace("2024-11-25T07:00", "2024-11-25T20:00"))
    message = refused(capsys)
    assert all(w in message for w in ("it is up (UTC) from 2024-11-2", "start then")), message


def test_a_plugin_that_cannot_be_imported(here):
    """It is named with its distribution and its fault, by the run that needs it; a run that does
    not is not stopped.
    """
    info = here / "site" / "broken_camera-0.4.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-camera\nVersion: 0.4\n")
    (info / "entry_points.txt").write_text(
        "[zonda.instruments]\nbroken_camera = broken_camera:camera\n"
    )
    (here / "site" / "broken_camera.py").write_text("import a_module_that_is_not_there\n")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(here / "site"), os.environ.get("PYTHONPATH", "")]),
    }

    def run(*arguments):
        command = [sys.executable, "-m", "zonda", *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True, cwd=here)

    assert run("check", "my.yaml").returncode == 0
    (here / "my.yaml").write_text(PIPELINE.replace("mustang2", "broken_camera"))
    done = run("check", "my.yaml")
    assert done.returncode == 2
    assert all(
        w in done.stderr
        for w in ("broken-camera 0.4", "a_module_that_is_not_there", "my.yaml:2:13")
    ), done.stderr
    assert "Traceback" not in done.stderr
    listed = run("plugins", "--check")
    assert listed.returncode != 0
    assert "broken-camera 0.4" in listed.stdout + listed.stderr
    assert "mustang2" in listed.stdout


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder that nobody can write")
def test_an_output_folder_that_cannot_be_written(here, capsys):
    assert cli.main(["run", "my.yaml", "--output", "/proc/self/zonda"]) == 2
    message = capsys.readouterr().err
    assert "/proc/self/zonda: cannot be made" in message
    assert "choose another" in message
    assert "Traceback" not in message


@pytest.mark.parametrize("step", ["SaveTOD", "SaveTOD: {format: fits}"])
def test_a_disk_that_is_full(here, capsys, monkeypatch, step):
    """Simulated at the system call with which every file gets its name."""
    import errno

    (here / "my.yaml").write_text(PIPELINE.replace("  - BinMap\n", f"  - {step}\n  - BinMap\n"))

    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    message = refused(capsys)
    assert "no space left on the disk" in message


@pytest.fixture
def warned(monkeypatch):
    """Warnings go where a user sees them; pytest keeps them for itself."""

    def show(*what):
        sys.stderr.write(warnings.formatwarning(*what[:4]))

    monkeypatch.setattr(warnings, "showwarning", show)


def test_a_run_begins_with_what_check_finds(here, capsys, monkeypatch):
    """400 h of scan are refused in the words of `zonda check`, and no more instants are pointed
    than it looks at.
    """
    from zonda.operators.pointing import base

    pointed, seconds = [], base.Pointing._seconds

    def counted(self, n, rate, key):
        pointed.append(n)
        return seconds(self, n, rate, key)

    monkeypatch.setattr(base.Pointing, "_seconds", counted)
    (here / "my.yaml").write_text(PIPELINE.replace("2 s}", "400 h}"))
    for command in ("check", "run", "plan"):
        pointed.clear()
        message = refused(capsys, command)
        assert "goes down to elevation" in message
        assert "the scans take 400.0 h" in message
        assert pointed
        assert max(pointed) <= base.INSTANTS_LOOKED_AT + base.POINTS


def test_a_long_scan_is_looked_at_first_from_python_too(here, monkeypatch):
    from zonda.core.configuration.pipeline_file import parse
    from zonda.core.errors import PointingError
    from zonda.operators.pointing import base

    monkeypatch.setattr(base, "LONG", 100)
    looked = []
    check = base.Pointing.check
    monkeypatch.setattr(
        base.Pointing,
        "check",
        lambda self, data: looked.append(len(data.observations)) or check(self, data),
    )
    file = parse(PIPELINE.replace("2 s}", "30 h, sample_rate: 1 Hz}"), name="p", folder=here)
    with pytest.raises(PointingError, match="goes down to elevation"):
        file.pipeline().run(file.scene(), output=here / "out")
    assert looked == [0]


def test_a_warning_of_the_checks_is_not_repeated(here, capsys, warned):
    """A scan too fast for the beam: `run` warns once, before it runs, in the words of `check`."""
    (here / "my.yaml").write_text(PIPELINE.replace("2 s}", "4 s, scans: 2, sample_rate: 8 Hz}"))
    assert cli.main(["check", "my.yaml"]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "samples per FWHM" in line]
    assert len(said) == 1
    assert cli.main(["run", "my.yaml", "--output", "out"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "samples per FWHM" in line] == said
    assert lines.index(said[0]) == 0


@pytest.mark.parametrize("command", ["check", "run", "plan"])
def test_a_pipeline_that_writes_nothing_says_so(here, capsys, warned, command):
    assert cli.main([command, "my.yaml"]) == 0
    assert "no step writes" not in capsys.readouterr().err
    (here / "my.yaml").write_text(PIPELINE.replace("  - SaveMap\n", ""))
    assert cli.main([command, "my.yaml"]) == 0
    said = capsys.readouterr().err
    assert (
        "warning: my: no step writes a product, so what is computed is lost; add a step that saves"
        " or shows it" in said
    )
    if command == "run":
        assert said.index("no step writes") < said.index("simulated in full")


@pytest.mark.parametrize("command", ["check", "run", "plan"])
def test_a_target_off_the_map_warns_with_its_centre(here, capsys, warned, command):
    assert cli.main([command, "my.yaml"]) == 0
    assert "is not on the input map" not in capsys.readouterr().err
    assert cli.main([command, "my.yaml", "--set", "target=06h +20d"]) == 0
    said = capsys.readouterr().err
    assert (
        "the target 90.00000 deg 20.00000 deg is not on the input map, whose centre, 75.00000 deg"
        " 20.00000 deg, is" in said
    )
    assert (
        cli.main([command, "my.yaml", "--set", "target=06h +20d", "--set", "SkyMap.centre=target"])
        == 0
    )
    assert "is not on the input map" not in capsys.readouterr().err
    assert (
        cli.main(
            [command, "my.yaml", "--set", "target=06h +20d", "--set", "SkyMap.centre=06h +20d"]
        )
        == 0
    )
    assert "is not on the input map" not in capsys.readouterr().err


def test_target_map_is_the_centre_of_the_input_map(here, capsys):
    (here / "my.yaml").write_text(PIPELINE.replace("05h00m00s +20d00m00s", "map"))
    assert cli.main(["check", "my.yaml"]) == 0
    assert "centre of the input map: 75.00000 deg 20.00000 deg" in capsys.readouterr().out
    assert cli.main(["run", "my.yaml", "--output", "by_map"]) == 0
    (here / "my.yaml").write_text(PIPELINE)
    assert cli.main(["run", "my.yaml", "--output", "by_hand"]) == 0
    text = (here / "by_map/resolved.yaml").read_text()
    assert text.replace("name: by_map", "") == (here / "by_hand/resolved.yaml").read_text().replace(
        "name: by_hand", ""
    )
    assert (here / "by_map/map.fits").read_bytes()[5760:] == (
        here / "by_hand/map.fits"
    ).read_bytes()[5760:]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("  - SkyMap: {file: map.fits}\n", ""), ["my.yaml:4:9", "no step has one", "add SkyMap"]),
        (
            ("map.fits}", "map.fits, centre: target}"),
            ["my.yaml:4:9", "each refer to the other", "give the target as coordinates"],
        ),
        (("map.fits}", "nowhere.fits}"), ["nowhere.fits", "no such file"]),
        (
            ("{scan_duration: 2 s}", "{scan_duration: 2 s, target: map}"),
            ["my.yaml:7", "top level of a pipeline file"],
        ),
    ],
)
def test_target_map_without_a_centre(here, capsys, change, words):
    (here / "my.yaml").write_text(PIPELINE.replace("05h00m00s +20d00m00s", "map").replace(*change))
    message = refused(capsys, "check")
    assert all(w in message for w in words), message


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    ("cards", "value", "words"),
    [
        ({}, 1e297, ["map.fits", "its largest value is 1e+297", "check the map"]),
        (
            {},
            -1e20,
            ["map.fits", "its largest value is 1e+20 K_RJ, more than 1e+15", "check its unit"],
        ),
        ({"CDELT1": 1e-300}, 1.0, ["map.fits", "1e-300 deg is no size of a pixel", "check CDELT1"]),
        ({"CDELT2": 1e300}, 1.0, ["map.fits", "1e+300 deg is no size of a pixel", "check CDELT1"]),
        (
            {"CRPIX2": 1e30},
            1.0,
            [
                "map.fits",
                "the reference point is pixel 6, 1e+30",
                "CRPIX1 and CRPIX2 may be up to 1e+09",
            ],
        ),
        (
            {"RADESYS": "FK5", "EQUINOX": 1e300},
            1.0,
            ["map.fits", "EQUINOX = 1e+300 is no year", "set EQUINOX"],
        ),
        (
            {"BUNIT": "Jy/beam", "BMAJ": 1e-300},
            1.0,
            ["map.fits", "1e-300 deg is no size of a pixel or beam", "BMAJ and BMIN"],
        ),
    ],
)
def test_numbers_in_a_map_that_no_sky_has(here, capsys, cards, value, words):
    (here / "map.fits").unlink()
    write_map(here / "map.fits", np.full((11, 11), value), **cards)
    message = refused(capsys)
    assert all(w in message for w in words), message


FILTERS = "  - BinMap\n"
SIGNALS = "  - Efficiency\n"


@pytest.mark.parametrize(
    ("before", "step", "words"),
    [
        (FILTERS, "HighpassFilter: {frequency: 600 Hz}", "removes everything"),
        (FILTERS, "HighpassFilter: {frequency: 600 Hz, response: bessel}", "removes everything"),
        (
            FILTERS,
            "HighpassFilter: {frequency: 1 Hz, trim: 1 s}",
            "leaves nothing of a scan of 2 s",
        ),
        (
            FILTERS,
            "HighpassFilter: {frequency: 1 Hz, mask: {radius: 10 deg}}",
            "covers the whole scan",
        ),
        (FILTERS, "Detrend: {mask: {radius: 10 deg}}", "covers the whole scan"),
        (FILTERS, "PolynomialFilter: {interval: throw}", "the scan has no interval 'throw'"),
        (FILTERS, "PolynomialFilter: {mask: {radius: 10 deg}}", "covers the whole scan"),
        (FILTERS, "Despline: {knots: 0.5 ms}", "more than 2000"),
        (
            FILTERS,
            "HighpassFilter: {frequency: 1 Hz, mask: {file: map.fits}}",
            "covers the whole scan",
        ),
        (FILTERS, "HighpassFilter: {frequency: 1 Hz, mask: {file: nan.fits}}", "NaN"),
        (FILTERS, "CommonModeFilter: {mask: {file: nan.fits}}", "NaN"),
        (FILTERS, "ModeSpectrum: {delays: 60}", "more than 4096 rows"),
        (SIGNALS, "PinkNoise: {minimum_frequency: 600 Hz}", "Nyquist frequency"),
        (SIGNALS, "PinkNoise: {minimum_frequency: 1e-9 Hz, slope: 3, poles: 2}", "poles fit"),
        (SIGNALS, "AtmosphereLayers: {pwv: 200 mm}", "precipitable water vapour"),
        ("  - SaveMap\n", "CompareMaps: {file: nan.fits}", "no pixel has a value"),
        ("  - SaveMap\n", "CompareMaps: {file: my.yaml}", "my.yaml"),
        ("  - SaveMap\n", "CompareMaps: {map: nope}", "there is no map 'nope'"),
        (
            "  - SaveMap\n",
            "CompareMaps: {reference: noiseless/nope}",
            "there is no map 'noiseless/nope'",
        ),
        ("  - SaveMap\n", "MapSpectrum: {maps: [nope]}", "there is no map 'nope'"),
        ("  - SaveMap\n", "TransferFunction: {map: nope}", "there is no map 'nope'"),
        ("  - SaveMap\n", "AtmosphereScreens", "there is no atmosphere to show"),
        (FILTERS, "CompareStreams: {reference: atmosphere}", "there is no stream 'atmosphere'"),
    ],
)
def test_what_a_scan_does_not_allow_is_refused_by_check_as_by_run(
    here, capsys, before, step, words
):
    """At the step's place in the file, before anything is simulated."""
    write_map(here / "nan.fits", np.full((11, 11), np.nan))
    (here / "my.yaml").write_text(PIPELINE.replace(before, f"  - {step}\n{before}"))
    assert before in PIPELINE
    for command in ("check", "run"):
        assert (
            cli.main([command, "my.yaml", *(["--output", "out"] if command == "run" else [])]) == 2
        )
        message = capsys.readouterr().err
        assert "Traceback" not in message
        assert words in message, message
        assert "my.yaml:" in message
    assert not (here / "out").exists() or not list((here / "out").glob("*.fits"))


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            ("- BinMap", "- BinMap: {pixel: 1e30 arcsec}"),
            ["my.yaml:11:22", "1e30 arcsec is more than 1e+06 rad"],
        ),
        (
            ("- BinMap", "- BinMap: {pixel: 1e-300 arcsec}"),
            ["my.yaml:11:22", "1e-300 arcsec is less than 1e-30 rad"],
        ),
        (("- BinMap", "- BinMap: {smooth: 1e9 arcsec}"), ["my.yaml:11:23", "at most 0.1 rad"]),
        (("map.fits}", "map.fits, scale: 1e300}"), ["my.yaml:8:36", "must be at most 1e+30"]),
        (("map.fits}", "map.fits, outside: 1e300 K}"), ["my.yaml:8:38", "more than 1e+15 K"]),
        (
            ("map.fits}", "map.fits, pixel_size: 1e-300 arcsec}"),
            ["my.yaml:8:41", "less than 1e-30 rad"],
        ),
        (("2 s}", "2 s, sample_rate: 1e-300 Hz}"), ["my.yaml:7:54", "less than 1e-30 Hz"]),
    ],
)
def test_parameters_that_nothing_has(here, capsys, change, words):
    (here / "my.yaml").write_text(PIPELINE.replace(*change))
    message = refused(capsys, "check")
    assert "Traceback" not in message
    assert words[0].rpartition(":")[0] in message, (
        message
    )  # on that line; where in it is up to the kind of mistake
    assert all(w in message for w in words[1:]), message
