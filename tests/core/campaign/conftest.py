"""A tiny campaign, and how to run it from the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zonda.core import cli

from ...scenes import camera

YAML = f"""\
{camera(19)}campaign: CAMPAIGN
operators:
  - PointingDaisy: {{radius: 1 arcmin, speed: 50 arcsec/s, scan_duration: 6 s, scans: 2, gap: 1 s}}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - PowerSpectrum: {{segment: 2 s}}
  - HighpassFilter
  - BinMap: {{pixel: 4 arcsec}}
  - SaveMap
"""


CAMPAIGN = "{nights: 3, realizations: 2}"


def command(*arguments: Any) -> int:
    return cli.main([str(a) for a in arguments])


def planes(folder: Path, name: str = "map.fits") -> dict[str, bytes]:
    """The bits of every image of a map."""
    from astropy.io import fits

    with fits.open(folder / name) as file:
        return {hdu.name: np.asarray(hdu.data).tobytes() for hdu in file if hdu.is_image}


class Bench:
    """``run("{nights: 3}", "serial")`` writes ``p.yaml``, runs it and returns the output folder."""

    CAMPAIGN = CAMPAIGN
    command, planes = staticmethod(command), staticmethod(planes)

    def __init__(self, folder: Path) -> None:
        self.folder, self.number = folder, 0

    def file(self, campaign: str, *changes: tuple[str, str], name: str = "p.yaml") -> Path:
        text = YAML.replace("CAMPAIGN", campaign)
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = self.folder / name
        path.write_text(text)
        return path

    def new(self) -> Path:
        self.number += 1
        return self.folder / f"out{self.number}"

    def run(
        self,
        campaign: str,
        *arguments: Any,
        status: int = 0,
        changes: tuple[tuple[str, str], ...] = (),
    ) -> Path:
        out = self.new()
        assert command("run", self.file(campaign, *changes), "--output", out, *arguments) == status
        return out

    def run_file(self, file: Path, *arguments: Any) -> Path:
        """Run a file in series, in full."""
        out = self.new()
        assert (
            command(
                "run",
                file,
                "--output",
                out,
                "--engine",
                "serial",
                "--threads",
                1,
                "--no-prune",
                *arguments,
            )
            == 0
        )
        return out


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.fixture(scope="module")
def module_bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of ``{nights: 3, realizations: 2}``, run in series: 12 tasks."""
    return Bench(tmp_path_factory.mktemp("campaign")).run(
        CAMPAIGN, "--engine", "serial", "--threads", 1
    )
