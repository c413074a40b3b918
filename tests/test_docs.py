"""What the documentation shows, runs."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(language):
    for page in PAGES:
        for number, text in enumerate(re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.S)):
            yield pytest.param(text, id=f"{page.name}-{number}")


def in_a_folder_with_a_map(folder, monkeypatch):
    (folder / "my_cluster.fits").write_bytes((ROOT / "pipelines" / "data" / "merging_cluster.fits").read_bytes())
    monkeypatch.chdir(folder)


@pytest.mark.parametrize("text", list(blocks("python")))
def test_python(text, tmp_path, monkeypatch):
    in_a_folder_with_a_map(tmp_path, monkeypatch)
    names = {}
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
