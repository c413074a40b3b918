"""Every importable folder is listed in pyproject.toml (an editable install would hide an
omission).
"""

import json
import pathlib
import re
import tomllib

ROOT = pathlib.Path(__file__).parents[1]


def test_all_packages_are_listed():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    found = {"zonda"}
    for top in ("core", "operators", "plugins", "interop", "pipelines"):
        for init in (ROOT / top).rglob("__init__.py"):
            found.add(".".join(["zonda", *init.parent.relative_to(ROOT).parts]))
    assert found == set(listed)


def test_every_entry_point_resolves():
    from importlib import import_module

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for group, entries in project["entry-points"].items():
        for name, reference in entries.items():
            module, _, attribute = reference.partition(":")
            target = import_module(module)
            assert not attribute or hasattr(target, attribute), f"{group}: {name}"


def test_version_is_the_same_everywhere():
    import zonda

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert zonda.__version__ == project["version"]
    assert f"version: {zonda.__version__}" in (ROOT / "CITATION.cff").read_text()
    assert json.loads((ROOT / ".zenodo.json").read_text())["version"] == zonda.__version__
    assert f"## [{zonda.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_what_the_badges_and_the_archive_say_is_what_pyproject_says():
    import yaml

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    versions = re.findall(r"Python :: (3\.\d+)", " ".join(project["classifiers"]))
    assert (
        f"Python: {' | '.join(versions)}" in (ROOT / "docs" / "images" / "python.svg").read_text()
    )
    assert (
        f"licence: {project['license']}" in (ROOT / "docs" / "images" / "licence.svg").read_text()
    )
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    archive = json.loads((ROOT / ".zenodo.json").read_text())
    assert archive["license"] == citation["license"] == project["license"]
    assert archive["title"] == citation["title"]
    assert archive["keywords"] == citation["keywords"] == project["keywords"]


def test_operators_are_found_by_tab_and_misspellings_are_named():
    import pytest

    import zonda

    assert {"PointingDaisy", "BinMap", "Pipeline"} <= set(dir(zonda))
    with pytest.raises(AttributeError, match="did you mean 'Pipeline'"):
        _ = zonda.Pipline
