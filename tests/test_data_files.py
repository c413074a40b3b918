"""Every data file says where it comes from and under which terms it may be used, and what made it
is here.
"""

import csv
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("core", "operators", "plugins", "interop", "pipelines", "zonda", "tests/data")
CODE = {".py", ".md", ".yaml", ".css", ".html", ".typed", ".tmpl"}


def data_files():
    return sorted(
        p
        for f in FOLDERS
        for p in (ROOT / f).rglob("*")
        if p.is_file()
        and p.suffix not in CODE
        and "__pycache__" not in p.parts
        and not any(q.is_symlink() for q in p.parents)
    )


def test_there_are_some():
    assert {p.name for p in data_files()} >= {
        "absorption.npz",
        "climatology.npz",
        "merging_cluster.fits",
    }


@pytest.mark.parametrize("path", data_files(), ids=lambda p: str(p.relative_to(ROOT)))
def test_each_is_documented_and_can_be_made_again(path):
    if path.suffix == ".fits":
        from astropy.io import fits

        header = fits.getheader(path)
        assert (ROOT / header["ORIGIN"]).is_file()
        assert f"python {header['ORIGIN']}" in str(header["COMMENT"])
        return
    if (
        path.parent.name == "fronts"
    ):  # measured by the command itself; `docs/make_accuracy.py` says how
        assert f"{path.name.split('.')[0]}" in (ROOT / "docs/accuracy.md").read_text()
        assert "zonda accuracy" in (ROOT / "docs/make_accuracy.py").read_text()
        return
    text = (path.parent / "README.md").read_text()
    assert f"`{path.name}`" in text
    if path.suffix == ".csv":  # written by hand: every row says where its numbers come from
        with path.open(newline="") as rows:
            assert all(row["provenance"] for row in csv.DictReader(rows))
        return
    assert re.search(r"am\*\* 14\.0|weathergen", text)
    if "tests" in path.parts:
        return
    section = text.split(f"`{path.name}`")[1].split("\n## ")[0]
    (script,) = re.findall(r"`(benchmarks/[\w/]+\.py)`", section)
    assert (ROOT / script).is_file()


@pytest.mark.parametrize("page", ["operators/atmosphere/data/README.md", "tests/data/README.md"])
def test_terms_of_am_and_of_era5(page):
    text = " ".join((ROOT / page).read_text().split())
    assert "S. Paine, Smithsonian Astrophysical Observatory" in text
    assert "attribution" in text
    assert "odified Copernicus Climate Change Service information" in text
    assert re.search(r"either the European Commission nor ECMWF is responsible for any use", text)
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert "modified Copernicus Climate Change Service information" in readme
    assert "S. Paine" in readme


def test_everything_tracked_in_the_packages_is_packed():
    """What `.ci/compare_wheel.py` finds in a wheel, from the lists alone (building one takes a
    minute).
    """
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    packed = set()
    for package in setup["packages"]:
        folder = (
            ROOT.joinpath(*package.removeprefix("zonda.").split("."))
            if "." in package
            else ROOT / "zonda"
        )
        packed |= set(folder.glob("*.py"))
        for pattern in setup["package-data"].get(package, []):
            found = set(folder.glob(pattern))
            assert found, f"{package}: {pattern} matches nothing"
            packed |= found
    try:
        tracked = subprocess.check_output(
            ["git", "ls-files", *FOLDERS[:-1]], cwd=ROOT, text=True, stderr=subprocess.DEVNULL
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    wanted = {
        ROOT / name
        for name in tracked.split()
        if not (ROOT / name).is_symlink() and (ROOT / name).exists()
    }
    assert wanted <= packed, sorted(wanted - packed)
