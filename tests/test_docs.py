"""What the documentation shows, runs."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(language):
    for page in PAGES:
        for number, text in enumerate(re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.S)):
            yield pytest.param(text, id=f"{page.name}-{number}")


def in_a_folder_with_a_map(folder, monkeypatch):
    (folder / "my_cluster.fits").write_bytes((ROOT / "pipelines" / "data" / "merging_cluster.fits").read_bytes())
    monkeypatch.chdir(folder)


def defined_before(text):
    """Names of the page's first block of Python, where this one goes on from there."""
    if "import zonda" in text:
        return {}
    page = next(page for page in map(Path.read_text, PAGES) if text in page)
    names = {}
    exec(compile(re.search(r"```python\n(.*?)```", page, re.S)[1], "documentation", "exec"), names)
    return names


@pytest.mark.parametrize("text", list(blocks("python")))
def test_python(text, tmp_path, monkeypatch):
    in_a_folder_with_a_map(tmp_path, monkeypatch)
    names = defined_before(text)
    exec(compile(text.replace('"5 min"', '"20 s"'), "documentation", "exec"), names)  # shorter scans, same code
    assert names


@pytest.mark.parametrize("text", [b for b in blocks("yaml") if "operators:" in b.values[0]])
def test_yaml(text, tmp_path, monkeypatch, capsys):
    """As `zonda check` sees it: its targets are up, its scans within the telescope's limits."""
    from zonda.core import cli

    in_a_folder_with_a_map(tmp_path, monkeypatch)
    (tmp_path / "page.yaml").write_text(text)
    status = cli.main(["check", "page.yaml"])
    out, err = capsys.readouterr()
    assert status == 0, err
    assert "no mistakes" in out


def test_the_readme_shows_one_pipeline_twice(tmp_path, monkeypatch):
    from zonda.core.configuration.pipeline_file import load

    in_a_folder_with_a_map(tmp_path, monkeypatch)
    page = (ROOT / "README.md").read_text()
    (tmp_path / "my.yaml").write_text(next(t for t in re.findall(r"```yaml\n(.*?)```", page, re.S) if "operators:" in t))
    file = load(tmp_path / "my.yaml")
    python = next(t for t in re.findall(r"```python\n(.*?)```", page, re.S))
    names = {}
    exec(compile(python[: python.index(".run(")].replace("data = ", "pipeline = "), "documentation", "exec"), names)
    assert names["scene"] == file.scene()
    assert [repr(o) for o in names["pipeline"].operators] == [repr(o) for o in file.operators]


def test_links():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_reference_is_made_from_the_operators():
    import importlib.util

    spec = importlib.util.spec_from_file_location("make_reference", ROOT / "docs" / "make_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.PAGE.read_text() == module.page(), "run python docs/make_reference.py"


def test_the_operators_of_the_page_for_authors_are_right(tmp_path, monkeypatch):
    """The gain drift multiplies all of the signal, tens of kelvin of mean included, and loses no microkelvin."""
    import numpy as np

    import zonda
    import zonda.testing

    first, *others = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "plugins.md").read_text(), re.S)
    assert set(re.findall(r"^(?:import|from) .*", first, re.M)) == {"import numpy as np", "import zonda"}
    (tmp_path / "page_for_authors.py").write_text(first + "".join(others))  # a file: docstrings of fields are read from it
    monkeypatch.syspath_prepend(str(tmp_path))
    page = importlib.import_module("page_for_authors")
    drift, demean = page.GainDrift(period="20 s"), page.Demean()
    zonda.testing.check_operator(drift)
    zonda.testing.check_operator(demean)
    zonda.testing.check_operator(page.Rms())
    zonda.testing.check_operator(page.GroundPickup())
    zonda.testing.check_operator(page.Peak())

    def signal(*steps):
        scene = zonda.Scene(site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=5)
        chain = [
            zonda.PointingStare(scan_duration="5 s"),
            zonda.AtmosphereLayers(pwv="5 mm"),
            zonda.WhiteNoise(),
            zonda.Efficiency(),
            *steps,
        ]
        data = zonda.Pipeline(chain).run(scene, keep=["signal"])
        return data.observations[0].detdata["signal"], data.observations[0]

    plain, observation = signal()
    drifting, _ = signal(drift)
    assert plain.mean() > 10
    phase = 2 * np.pi * observation.seconds / 20
    gain = 1 + drift.prepare(observation) @ np.stack([np.cos(phase), np.sin(phase)])
    assert np.abs(gain - 1).max() > 0.02
    # what stands beside the mean, below 2 K (4 sigma of 1 % of 50 K), is rounded to 2^-24 of it, before and after
    assert np.abs(drifting - gain * plain).max() < 2 * 2 * 2.0**-24
    left, _ = signal(demean)
    true = plain - plain.mean(axis=1, keepdims=True)
    assert np.abs(left - true).max() < 2.0**-24 * np.abs(true).max()

    scene = zonda.Scene(site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=5)
    steps = [
        zonda.PointingStare(scan_duration="5 s"),
        zonda.WhiteNoise(),
        page.GroundPickup(slope="1 K"),
        zonda.Efficiency(),
        page.Peak(),
        page.SavePeak(),
    ]
    data = zonda.Pipeline(steps, runs={"clean": {"without": ["ground"]}}).run(scene, output=tmp_path)
    assert (tmp_path / "peaks.txt").read_text().split()[::2] == ["peak", "clean/peak"]
    assert abs(data.products["peak"] - data.products["clean/peak"]) > 1


def test_the_operator_that_contributing_shows_keeps_the_contract(tmp_path, monkeypatch):
    import textwrap

    import zonda.testing

    text = re.search(r"   ```py\n(.*?)   ```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)[1]
    (tmp_path / "page_for_contributors.py").write_text(textwrap.dedent(text))
    monkeypatch.syspath_prepend(str(tmp_path))
    page = importlib.import_module("page_for_contributors")
    zonda.testing.check_operator(page.GainDrift(period="20 s"))
