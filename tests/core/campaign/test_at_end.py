"""What acts at the end, on the combined products of a campaign, finds what it finds in one run."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest
from astropy.io import fits

from zonda.core.campaign.campaign_file import Job
from zonda.core.campaign.tasks import combined
from zonda.core.configuration.pipeline_file import load

from ...scenes import write_sky

SERIAL = ("--engine", "serial", "--threads", 1, "--no-prune")

SKY = """\
operators:
  - PointingDaisy: {radius: 1 arcmin, speed: 50 arcsec/s, scan_duration: 6 s, scans: 3, gap: 1 s}
  - SkyMap: {file: sky.fits}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - SaveTOD
  - TimeStreams
  - PowerSpectrum: {segment: 2 s}
  - CommonModeFilter
  - HighpassFilter
  - BinMap: {pixel: 4 arcsec}
  - TransferFunction: {name: own, bins: 4}
  - TransferFunction: {name: full, bins: 4, modes: full}
  - SaveMap
runs:
  noiseless: {only: [sky]}
  source_free: {without: [sky]}
"""


@pytest.fixture
def files(bench):
    """The same scene as an ordinary run and as a campaign of its scans, its output folders beside
    it.
    """
    write_sky(bench.folder / "sky.fits", 41, 0.001, 1.0)

    def write(campaign: str, name: str, *more: tuple[str, str]) -> Path:
        path = bench.file(campaign, name=name)
        text = path.read_text().partition("operators:")[0] + SKY
        for old, new in more:
            text = text.replace(old, new)
        path.write_text(text)
        return path

    return write


def table(path: Path) -> list[str]:
    """The rows of an ECSV table, without its header."""
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


def test_products_of_operators_at_the_end_are_those_of_one_run(bench, files):
    plain, split = bench.new(), bench.new()
    one, other = files("null", "one.yaml"), files("{keep_tasks: true}", "other.yaml")
    assert bench.command("run", one, "--output", plain, "--no-prune") == 0
    assert bench.command("run", other, "--output", split, *SERIAL) == 0
    assert len(Job.read(split).tasks) == 3
    for name in ("own.ecsv", "full.ecsv"):
        assert table(plain / name) == table(split / name)
        assert len(table(split / name)) == 5
    assert table(split / "own.ecsv") != table(split / "full.ecsv")
    names = sorted(p.name for p in plain.glob("*.fits"))
    assert names == ["map.fits", "noise_map.fits", "noiseless_map.fits", "source_free_map.fits"]
    assert names == sorted(p.name for p in split.glob("*.fits"))
    for name in names:
        assert bench.planes(plain, name) == bench.planes(split, name)
    noise, joined_noise = (
        fits.getheader(folder / "map.fits", "NOISE") for folder in (plain, split)
    )
    assert noise["NOISEFAC"] > 1  # pink noise
    assert joined_noise["NOISEFAC"] == pytest.approx(noise["NOISEFAC"])
    assert joined_noise["NOISEOF"] == noise["NOISEOF"] == "the map of all but the sky"
    scans = sorted(plain.glob("tod_*.h5"))
    assert len(scans) == 3
    for path in scans:
        with (
            h5py.File(path) as a,
            h5py.File(split / "entries" / "000000" / path.name.replace("tod_", "tod_000000-")) as b,
        ):
            assert a["detdata/signal"][:].tobytes() == b["detdata/signal"][:].tobytes()

    file = load(str(one), ())
    data = file.pipeline().run(file.scene(), output=bench.new(), threads=1)
    joined = combined(Job.read(split), split, 0)
    assert data.products.keys() == joined.products.keys()
    a, b = data.products["spectrum"], joined.products["spectrum"]
    assert {k: v.tobytes() for k, v in a.psd.items()} == {k: v.tobytes() for k, v in b.psd.items()}
    assert (a.averages, a.white_level, a.observations) == (
        b.averages,
        b.white_level,
        b.observations,
    )
    c, d = data.products["time_streams"], joined.products["time_streams"]
    assert {k: v.tobytes() for k, v in c.streams.items()} == {
        k: v.tobytes() for k, v in d.streams.items()
    }


def test_the_transfer_function_of_several_nights_is_that_of_their_maps(bench, files):
    """Each combination has one of its own, from its co-added maps, not a mean of the nights'
    ones.
    """
    both = bench.run_file(
        files(
            "{nights: 2, grid: {HighpassFilter.frequency: [0.3 Hz, 0.6 Hz]}, combine: [night]}",
            "n.yaml",
        )
    )
    folders = [
        p for p in sorted(both.iterdir()) if p.is_dir() and p.name.startswith("HighpassFilter")
    ]
    assert len(folders) == 2
    tables = [table(folder / "own.ecsv") for folder in folders]
    assert tables[0] != tables[1]
    one = bench.run_file(
        files(
            "{nights: 2}", "one.yaml", ("- HighpassFilter", "- HighpassFilter: {frequency: 0.6 Hz}")
        )
    )
    assert table(one / "own.ecsv") == tables[1]
