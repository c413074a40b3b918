"""Campaigns from Python: those of the file that says the same, to the last bit."""

from __future__ import annotations

import os
import subprocess
import sys

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from astropy.wcs import WCS

import zonda
from zonda.core.campaign.function import _plain
from zonda.core.errors import OutputError, PipelineError, ZondaError
from zonda.plugins.checks.scenes import TARGET, camera, scene

SERIAL = {"engine": "serial", "threads": 1}
BLOB = 1e-3 * np.exp(-((np.indices((48, 64)) - 24.0) ** 2).sum(axis=0) / 50)
STEP = "  - SkyMap: {file: FILE, unit: K_RJ}\n"
MAP_IN_FILE = ("  - WhiteNoise\n", STEP + "  - WhiteNoise\n")


def wcs() -> WCS:
    """Turned and of uneven scale: numbers that 14 digits do not hold."""
    made = WCS(naxis=2)
    made.wcs.ctype, made.wcs.crval, made.wcs.crpix = (
        ["RA---TAN", "DEC--TAN"],
        TARGET,
        [32.123456789012345, 24.4],
    )
    made.wcs.cdelt = [-4.1 / 3600, 4.1 / 3600]
    made.wcs.pc = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    made.wcs.set()
    return made


def sky() -> zonda.Operator:
    return zonda.SkyMap(map=BLOB, wcs=wcs(), unit="K_RJ")


def steps(*more: zonda.Operator) -> list[zonda.Operator]:
    daisy = zonda.PointingDaisy(radius="1 arcmin", speed="50 arcsec/s", scan_duration="3 s")
    return [
        daisy,
        *more,
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(pixel="4 arcsec"),
        zonda.SaveMap(),
    ]


@pytest.fixture(scope="module")
def with_array(module_bench):
    """Folders of a campaign of a file with a map, and of the same with an array."""
    bench = module_bench
    fits.PrimaryHDU(BLOB, fits.Header(dict(sky().wcs))).writeto(bench.folder / "sky.fits")
    put = MAP_IN_FILE[0], MAP_IN_FILE[1].replace("FILE", "sky.fits")
    theirs = bench.run(
        "{nights: 2, realizations: 2}",
        "--no-prune",
        "--engine",
        "serial",
        "--threads",
        1,
        changes=(put,),
    )
    file = zonda.load(bench.file("null", put))
    operators = [sky() if isinstance(o, zonda.SkyMap) else o for o in file.operators]
    ours = bench.new()
    made = zonda.campaign(
        zonda.Pipeline(operators), file.scene(), output=ours, nights=2, realizations=2, **SERIAL
    )
    assert made.folder == ours
    assert made.sets == (({}, ours),)
    return theirs, ours


def test_an_array_gives_the_bits_of_its_file(with_array, module_bench):
    theirs, ours = with_array
    for name in ("map.fits", "noise_map.fits"):
        assert module_bench.planes(ours, name) == module_bench.planes(theirs, name)
    with fits.open(ours / "inputs" / "SkyMap.fits") as found:
        np.testing.assert_array_equal(found[0].data, BLOB)
        assert found[0].header["CRPIX1"] == 32.123456789012345


def test_products_say_what_the_array_was(with_array, module_bench, tmp_path):
    """Shape, type, unit and hash, as a plain run of the array states them in the log and in its
    provenance.
    """
    _, ours = with_array
    pipeline = zonda.Pipeline(steps(sky()))
    plain = pipeline.run(scene(camera(7)), output=tmp_path, threads=1)
    told = {what: value for who, what, value in plain.log if who == "SkyMap"}["input"]
    assert (
        told == f"array of 64 x 48, float64, hash {pipeline.operators[1].map.digest}, in K_RJ,"
        " given in Python"
    )
    for folder in (ours, tmp_path):
        with fits.open(folder / "map.fits") as found:
            assert told in [row["VALUE"] for row in found["TALLY"].data]


def test_the_folder_may_move(tmp_path, module_bench):
    pipeline, where = zonda.Pipeline(steps(sky())), scene(camera(7))
    zonda.campaign(pipeline, where, output=tmp_path / "a", realizations=2, **SERIAL)
    whole = module_bench.planes(tmp_path / "a")
    moved = tmp_path / "elsewhere" / "b"
    moved.parent.mkdir()
    (tmp_path / "a").rename(moved)
    for path in (moved / "resolved.yaml", moved / "campaign.json"):
        assert str(tmp_path / "a" / "inputs") not in path.read_text()
    (moved / "map.fits").unlink()
    assert module_bench.command("resume", moved) == 0  # nothing has changed or is gone
    again = tmp_path / "again"
    arguments = ("--output", again, "--no-prune", "--engine", "serial", "--threads", 1)
    assert module_bench.command("run", moved / "resolved.yaml", *arguments) == 0
    assert module_bench.planes(again) == whole


def test_it_is_an_ordinary_campaign_then(with_array, module_bench, capsys):
    _, ours = with_array
    assert module_bench.command("status", ours) == 0
    assert "done     8" in capsys.readouterr().out
    assert module_bench.command("resume", ours) == 0
    out = module_bench.new()
    arguments = ("--output", out, "--no-prune", "--engine", "serial", "--threads", 1)
    assert module_bench.command("run", ours / "resolved.yaml", *arguments) == 0
    assert module_bench.planes(out) == module_bench.planes(ours)


def test_an_array_that_changed_is_noticed_by_its_hash(with_array, module_bench, capsys):
    _, ours = with_array
    path = ours / "inputs" / "SkyMap.fits"
    content, stat = path.read_bytes(), path.stat()
    os.utime(path, ns=(0, 0))  # copied: the same numbers
    assert module_bench.command("resume", ours) == 0
    capsys.readouterr()
    path.write_bytes(content[:-5000] + bytes([content[-5000] ^ 1]) + content[-4999:])
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    try:
        assert path.stat().st_size == stat.st_size
        assert module_bench.command("resume", ours) == 2
        assert "SkyMap.fits has changed or is gone" in capsys.readouterr().err
    finally:
        path.write_bytes(content)


def test_one_observation_is_the_plain_run(tmp_path, bench):
    pipeline, where = (
        zonda.Pipeline(steps(sky()), runs={"noiseless": {"only": ["sky"]}}),
        scene(camera(7)),
    )
    zonda.campaign(pipeline, where, output=tmp_path / "a", **SERIAL)
    pipeline.run(where, output=tmp_path / "b", threads=1)
    for name in ("map.fits", "noiseless_map.fits"):
        assert bench.planes(tmp_path / "a", name) == bench.planes(tmp_path / "b", name)


def test_signals_of_outputs_are_asked_for_by_these_again(tmp_path):
    more = [zonda.HighpassFilter(frequency="1 Hz"), zonda.TransferFunction()]
    pipeline = zonda.Pipeline([*steps(sky())[:-2], more[0], *steps()[-2:], more[1]])
    assert pipeline.runs
    zonda.campaign(pipeline, scene(camera(7)), output=tmp_path, **SERIAL)
    assert not zonda.load(tmp_path / "resolved.yaml").runs


def test_sets_of_products_by_their_values(tmp_path):
    grid = {"PointingDaisy.radius": [1, 1.5] * u.arcmin}
    made = zonda.campaign(
        zonda.Pipeline(steps()),
        scene(camera(7)),
        output=tmp_path,
        grid=grid,
        realizations=2,
        combine=["realization"],
        **SERIAL,
    )
    assert [values for values, _ in made.sets] == [
        {"PointingDaisy.radius": t} for t in ("1 arcmin", "1.5 arcmin")
    ]
    assert all((folder / "map.fits").is_file() for _, folder in made.sets)
    assert {row[0] for row in made.log} == {
        f"PointingDaisy.radius={t}" for t in ("1 arcmin", "1.5 arcmin")
    }


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (0.1 * u.deg, "0.1 deg"),
        ([1, 2.5] * u.arcmin, ["1 arcmin", "2.5 arcmin"]),
        (Time("2024-11-25T07:00:00"), "2024-11-25T07:00:00.000"),
        (np.arange(2), [0, 1]),
        (np.float64(1) / 3, 1 / 3),
        ([None, True, ("a",)], [None, True, ["a"]]),
        (
            zonda.Band(name="x", low="90 GHz", high="100 GHz"),
            {"name": "x", "low": "90 GHz", "high": "100 GHz"},
        ),
    ],
)
def test_values_of_axes(value, written):
    assert _plain(value, "x") == written


def test_a_script_needs_no_guard(tmp_path):
    """Worker processes do not run the user's script again."""
    (tmp_path / "script.py").write_text(
        "import zonda\nfrom zonda.plugins.checks.scenes import camera, scene\nprint('once')\ndaisy"
        " = zonda.PointingDaisy(radius='1 arcmin', speed='50 arcsec/s', scan_duration='2 s')\nsteps"
        " = [daisy, zonda.WhiteNoise(), zonda.Efficiency(), zonda.BinMap(pixel='4 arcsec'),"
        " zonda.SaveMap()]\nmade = zonda.campaign(zonda.Pipeline(steps), scene(camera(7)),"
        " output='out', realizations=2, workers=2)\nprint(made.folder)\n"
    )
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "once\nout\n"
    assert "2 tasks in" in done.stderr
    assert (tmp_path / "out" / "map.fits").is_file()


class OfThisSession(zonda.BinMap):
    """A map."""


@pytest.mark.parametrize(
    ("make", "axes", "said"),
    [
        (
            lambda: [*steps()[:-2], zonda.operator(lambda b: None, name="f"), *steps()[-2:]],
            {},
            "f is a function or a class of",
        ),
        (
            lambda: [*steps()[:-2], OfThisSession(pixel="4 arcsec"), zonda.SaveMap()],
            {},
            "zonda new plugin NAME",
        ),
        (lambda: steps()[:-1], {}, "no step writes anything"),
        (steps, {"grid": {"BinMap.pixel": [object()]}}, "grid.BinMap.pixel: <object"),
        (steps, {"grid": {"BinMap.pixl": ["4 arcsec"]}}, "did you mean 'pixel'"),
        (steps, {"grd": {}}, "did you mean 'grid'"),
        (steps, {"threads": 1.5}, "threads is a number of threads"),
    ],
)
def test_mistakes(tmp_path, make, axes, said):
    with pytest.raises(ZondaError, match=said):
        zonda.campaign(
            zonda.Pipeline(make()), scene(camera(7)), output=tmp_path, **{**SERIAL, **axes}
        )
    assert not list(tmp_path.iterdir())


def test_arrays_are_removed_where_nothing_begins(tmp_path):
    with pytest.raises(ZondaError, match="unknown key 'pixl'"):
        zonda.campaign(
            zonda.Pipeline(steps(sky())),
            scene(camera(7)),
            output=tmp_path,
            grid={"BinMap.pixl": ["4 arcsec"]},
            **SERIAL,
        )
    assert not list(tmp_path.iterdir())


def test_an_unfinished_campaign_keeps_its_arrays(tmp_path, monkeypatch):
    pipeline = zonda.Pipeline(steps(sky()))
    with monkeypatch.context() as patch:
        patch.setattr(
            "zonda.core.campaign.tasks.perform",
            lambda order: (_ for _ in ()).throw(KeyboardInterrupt),
        )
        with pytest.raises(KeyboardInterrupt):
            zonda.campaign(pipeline, scene(camera(7)), output=tmp_path, **SERIAL)
    content = (tmp_path / "inputs" / "SkyMap.fits").read_bytes()
    other = zonda.Pipeline(steps(zonda.SkyMap(map=2 * BLOB, wcs=wcs(), unit="K_RJ")))
    with pytest.raises(OutputError, match="holds an unfinished campaign"):
        zonda.campaign(other, scene(camera(7)), output=tmp_path, **SERIAL)
    assert (tmp_path / "inputs" / "SkyMap.fits").read_bytes() == content


def test_what_is_no_pipeline(tmp_path):
    with pytest.raises(PipelineError, match="a campaign is made of a Pipeline"):
        zonda.campaign(steps(), scene(camera(7)), output=tmp_path)  # type: ignore[arg-type]
