"""What the documentation shows, runs."""

import importlib
import importlib.util
import json
import re
import runpy
import textwrap
import tomllib
from pathlib import Path

import pytest
import yaml

from .axismanagers import saved

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


CODE = ("yaml", "yml", "python", "py", "pycon", "json", "toml")
"""Languages of blocks that say what a user writes; others are shells' commands and what they print.
"""

ELSEWHERE = {
    ("CONTRIBUTING.md", "Drift of the detectors' gains."): (
        "test_the_operator_that_contributing_shows_keeps_the_contract"
    ),
    ("CONTRIBUTING.md", "def test_it_keeps_the_contract"): "needs the operator above",
    ("coming_from_toast.md", "import toast"): "needs TOAST: tests/interop/test_toast.py",
    ("interop.md", ""): "needs TOAST or sotodlib: tests/interop, in the environments of .ci",
    ("map_makers_compared.md", "def less_the_map"): (
        "test_an_iterated_map_leaves_nothing_to_filters"
    ),
    ("plugins.md", "my_camera:"): "test_the_instrument_that_the_page_for_authors_shows",
    ("sky.md", "PySMSky"): "needs PySM: tests/operators/sky/test_pysm.py, in .ci/pysm",
}
"""Blocks that are not executed here, by page and words in them, with where they are."""


def fenced():
    """(page, number, language, text) of every block."""
    for page in PAGES:
        found = re.findall(r"^ *```([\w.-]*)[^\n]*\n(.*?)^ *```", page.read_text(), re.S | re.M)
        for number, (language, text) in enumerate(found):
            yield page, number, language, textwrap.dedent(text)


def elsewhere(page, text):
    """The exceptions that a block is, by page and words."""
    return {(name, words) for name, words in ELSEWHERE if name == page.name and words in text}


def blocks(*languages):
    """The blocks of a language that are executed here."""
    for page, number, language, text in fenced():
        if language in languages and not elsewhere(page, text):
            yield pytest.param(text, id=f"{page.name}-{number}")


def test_every_block_is_executed_or_said_to_be_elsewhere():
    """A block of a language without a test, or an exception without a block, is a mistake."""
    code = {
        f"{page.name}-{number}": elsewhere(page, text)
        for page, number, language, text in fenced()
        if language in CODE
    }
    assert ELSEWHERE.keys() == set().union(*code.values())
    executed = [*blocks("python", "py"), *blocks("yaml", "yml"), *blocks("toml")]
    assert {p.id for p in executed} == {place for place, found in code.items() if not found}
    others = {language for _, _, language, _ in fenced()} - set(CODE)
    assert others <= {"sh", "text", "csv", ""}, "another language: add it to CODE, or here"


def in_a_folder_with_a_map(folder, monkeypatch):
    (folder / "my_cluster.fits").write_bytes(
        (ROOT / "pipelines" / "data" / "merging_cluster.fits").read_bytes()
    )
    monkeypatch.chdir(folder)


def with_a_filament(text):
    """The map of the gallery that a text names, in the current folder."""
    if "filament.fits" in text:
        runpy.run_path(str(ROOT / "docs" / "gallery" / "filament.py"))


def with_recorded_data(folder, text):
    """The file of recorded data that a text names: an AxisManager, or made by a short run."""
    if "obs_1750000000_satp1.h5" in text:
        saved(folder / "obs_1750000000_satp1.h5")
    if "night.h5" not in text:
        return
    import zonda

    camera = {"like": "mustang2", "detectors": 20}
    scene = zonda.Scene(
        site="green_bank", instrument=camera, time="2024-11-25T07:00", target="05h +20d", seed=1
    )
    scan = zonda.PointingDaisy(radius="1 arcmin", scan_duration="30 s", sample_rate="25 Hz")
    steps = [scan, zonda.WhiteNoise(), zonda.PinkNoise(), zonda.Efficiency(), zonda.SaveTOD()]
    zonda.Pipeline(steps).run(scene, output=folder, threads=1)
    (folder / "tod_scan-000.h5").rename(folder / "night.h5")


def with_files_of_the_page(folder, text):
    """The files that a page shows in full, as "`NAME`:" and a block of text."""
    for page in (page for page in map(Path.read_text, PAGES) if text in page):
        for name, content in re.findall(r"^`([\w.-]+)`:\n\n```text\n(.*?)```", page, re.S | re.M):
            (folder / name).write_text(content)


def with_survey_data(folder, text):
    """The files of streams that the page of a survey maps again, of a short run of its pipeline."""
    names = re.findall(r"tod_scan-00\d-field-\d-\d-f150\.h5", text)
    if not names:
        return
    import zonda

    page = (ROOT / "docs" / "survey.md").read_text()
    (folder / "survey.yaml").write_text(re.search(r"```yaml\n(.*?)```", page, re.S)[1])
    changes = ["instrument.detectors=4", "PointingSchedule.sample_rate=10 Hz"]
    file = zonda.load(folder / "survey.yaml", overrides=changes)
    steps = [
        o
        for o in file.operators
        if type(o).__name__ in ("PointingSchedule", "WhiteNoise", "Efficiency", "SaveTOD")
    ]
    zonda.Pipeline(steps).run(file.scene(), output=folder, threads=1)


def defined_before(text):
    """Names of the page's first block of Python, where this one goes on from there."""
    if "import zonda" in text:
        return {}
    page = next(page for page in map(Path.read_text, PAGES) if text in page)
    names = {}
    first = re.search(r"```python\n(.*?)```", page, re.S)[1].replace('"5 min"', '"20 s"')
    exec(compile(first, "documentation", "exec"), names)
    return names


@pytest.mark.parametrize("text", list(blocks("python", "py")))
def test_python(text, tmp_path, monkeypatch):
    in_a_folder_with_a_map(tmp_path, monkeypatch)
    with_recorded_data(tmp_path, text)
    names = defined_before(text)
    exec(
        compile(text.replace('"5 min"', '"20 s"'), "documentation", "exec"), names
    )  # shorter scans, same code
    assert names


def test_an_iterated_map_leaves_nothing_to_filters(tmp_path, monkeypatch):
    """Filters leave little of the data minus the map: equation (1) of the page converges."""
    import numpy as np

    import zonda

    in_a_folder_with_a_map(tmp_path, monkeypatch)
    page = (ROOT / "docs" / "map_makers_compared.md").read_text()
    text, names = re.search(r"```python\n(.*?)```", page, re.S)[1], {}
    exec(compile(text.replace('"5 min"', '"20 s"'), "documentation", "exec"), names)
    names["of_map"] = {
        k: P @ np.nan_to_num(names["found"]).ravel() for k, P in names["pointing"].items()
    }
    left = zonda.map(names["streams"], [names["less_the_map"], *names["steps"]])["map"]
    assert np.nanstd(left.signal) < 0.05 * np.nanstd(names["first"].signal)


@pytest.mark.parametrize("text", list(blocks("toml")))
def test_toml(text):
    """Entry points of groups that there are."""
    from zonda.core import registry

    known = {
        group
        for r in vars(registry).values()
        if isinstance(r, registry.Registry)
        for group in r.groups
    }
    assert tomllib.loads(text)["project"]["entry-points"].keys() <= known


def gallery():
    for path in sorted((ROOT / "docs" / "gallery").glob("*.yaml")):
        yield pytest.param(path.read_text(), id=path.stem)


LONG = {"psd_slope": "80 s", "PointingRaster": "3 min"}
"""What a pipeline may hold that needs longer scans than those of `small`: a spectrum at 16 mHz, a
field that is covered once.
"""


def small(text):
    """A pipeline with few detectors and short scans: all else as it is written."""
    tree = yaml.safe_load(text)
    if isinstance(camera := tree.get("instrument"), str) and "LoadTOD" not in text:
        tree["instrument"] = {"like": camera, "detectors": 20}
    elif isinstance(camera, dict) and "detectors" in camera:
        camera["detectors"] = min(camera["detectors"], 20)
    duration = next((long for what, long in LONG.items() if what in text), "20 s")
    for step in tree["operators"]:
        for name, parameters in step.items() if isinstance(step, dict) else ():
            if name.startswith("Pointing") and "schedule" not in parameters:
                parameters["scan_duration"] = duration
            elif name == "PointingSchedule":
                parameters["sample_rate"] = "20 Hz"
            elif "formats" in parameters:
                parameters["formats"] = ["svg"]
    campaign, sweep = tree.get("campaign"), tree.get("sweep")
    for many in (many for many in (campaign, sweep) if many):
        many |= {"engine": "serial"} | {
            key: min(many[key], 2) for key in ("nights", "realizations", "seeds") if key in many
        }
    return yaml.safe_dump(tree, sort_keys=False)


CAMERA = """\
instrument: {name: camera, telescope: {name: dish, diameter: 12 m}, band: {name: b150, low: 140 GHz, high: 160 GHz},
  detectors: 38, field_of_view: 10 arcmin, main_beam_efficiency: 0.6, illumination_efficiency: 0.9, net: 500 uK s(1/2),
  knee: 0.2 Hz, sample_rate: 25 Hz, polarization: pairs}
"""
PLACE = (
    "site: {name: here, latitude: 40.3 deg, longitude: 10.1 deg, altitude: 600 m, climatology:"
    " green_bank}\n"
)
SCENE = "time: 2024-03-01T02:00\ntarget: az 100 deg el 60 deg\nseed: 3\n"
SCAN = "- PointingDaisy: {radius: 10 arcmin, speed: 1 arcmin/s, scan_duration: 20 s}\n"
MAPPED = "- AtmosphereLayers\n- WhiteNoise\n- Efficiency\n- BinMap: {pixel: 30 arcsec}\n- SaveMap\n"


def in_a_scene(text):
    """The pipelines that a fragment is part of: of each line of a choice, one."""
    if text.startswith("accuracy:"):
        return [PLACE + CAMERA + SCENE + text + "operators:\n" + SCAN + MAPPED]
    if text.startswith("weather:"):
        return [
            PLACE + CAMERA + SCENE + line + "\noperators:\n" + SCAN + MAPPED
            for line in text.splitlines()
        ]
    if text.startswith("site:"):
        return [text + CAMERA + SCENE + "weather: {pwv: 2 mm}\noperators:\n" + SCAN + MAPPED]
    if "LoadTOD" in text:
        return [
            "operators:\n"
            + text
            + "- HighpassFilter: {frequency: 0.1 Hz}\n- BinMap: {pixel: 5 arcsec}\n- SaveMap\n"
        ]
    plate, *others = text.splitlines(keepends=True)
    steps = plate + others[0] + "- WhiteNoise\n- Efficiency\n" + "".join(others[1:]) + "- SaveMap\n"
    return [PLACE + CAMERA + SCENE + "operators:\n" + SCAN + steps]


def with_what_fragments_read(folder, text):
    """Files that fragments name: a polarized map, the weather, the noise that `zonda noise`
    finds.
    """
    from zonda.core import cli

    if "iqu.fits" in text:
        text = text.replace("iqu.fits", "filament.fits")
        with_a_filament(text)
        (folder / "filament.fits").rename(folder / "iqu.fits")
    if "era5.nc" in text:
        files = runpy.run_path(
            str(ROOT / "tests" / "operators" / "atmosphere" / "weather" / "era5_files.py")
        )
        files["new_layout"](folder / "era5.nc")
        rows = [
            "height [km], pressure [hPa], temperature [degC], relative humidity [%], wind east"
            " [m/s], wind north [m/s]"
        ]
        rows += [
            "0.5, 955, 10, 50, 3, 1",
            "1.5, 845, 4, 40, 5, 1",
            "3.0, 700, -5, 30, 9, 2",
            "5.0, 540, -18, 20, 14, 3",
        ]
        (folder / "profile.csv").write_text("\n".join([*rows, "9.0, 308, -44, 10, 25, 0"]) + "\n")
    if "night.noise.ecsv" in text:
        assert (
            cli.main(["noise", "night.h5", "--segment", "4 s", "--output", "night.noise.ecsv"]) == 0
        )


def without_pixels(figure, file, **settings):
    """In place of `Figure.savefig`, a third of a run's CPU: no pixels are made of a picture."""
    if isinstance(file, str | Path):
        Path(file).touch()


@pytest.mark.parametrize("text", [*blocks("yaml", "yml"), *gallery()])
def test_yaml(text, request, tmp_path, monkeypatch, capsys):
    """A pipeline as `zonda check` sees it in full, and run with few detectors and short scans; a
    fragment in a small scene. Pictures are drawn in full for the README and the gallery.
    """
    from zonda.core import cli

    if ".md-" in request.node.name and "README" not in request.node.name:
        monkeypatch.setattr("matplotlib.figure.Figure.savefig", without_pixels)
    in_a_folder_with_a_map(tmp_path, monkeypatch)
    with_recorded_data(tmp_path, text)
    with_files_of_the_page(tmp_path, text)
    with_survey_data(tmp_path, text)
    whole = "operators:" in text
    if whole:
        with_a_filament(text)
    else:
        with_what_fragments_read(tmp_path, text)
    for number, page in enumerate([text] if whole else in_a_scene(text)):
        (tmp_path / "page.yaml").write_text(page)
        status = cli.main(["check", "page.yaml"])
        out, err = capsys.readouterr()
        assert status == 0, err
        assert "no mistakes" in out
        (tmp_path / "small.yaml").write_text(small(page) if whole else page)
        status = cli.main(["run", "small.yaml", "--output", f"out{number}", "--threads", "1"])
        assert status == 0, capsys.readouterr().err
        capsys.readouterr()


def test_the_readme_shows_one_pipeline_twice(tmp_path, monkeypatch):
    from zonda.core.configuration.pipeline_file import load

    in_a_folder_with_a_map(tmp_path, monkeypatch)
    page = (ROOT / "README.md").read_text()
    (tmp_path / "my.yaml").write_text(
        next(t for t in re.findall(r"```yaml\n(.*?)```", page, re.S) if "operators:" in t)
    )
    file = load(tmp_path / "my.yaml")
    python = next(t for t in re.findall(r"```python\n(.*?)```", page, re.S))
    names = {}
    exec(
        compile(
            python[: python.index(".run(")].replace("data = ", "pipeline = "),
            "documentation",
            "exec",
        ),
        names,
    )
    assert names["scene"] == file.scene()
    assert [repr(o) for o in names["pipeline"].operators] == [repr(o) for o in file.operators]


def script(name):
    """A script of docs/, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_links():
    made = {(ROOT / "docs" / page).resolve() for page in script("site_pages").made_pages()}
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            found = page.parent / target
            assert found.exists() or found.resolve() in made, f"{page.name}: {target}"


def test_every_page_is_in_the_navigation_of_the_site_once():
    def pages(entry):
        if isinstance(entry, str):
            return [entry]
        return [
            page
            for part in (entry.values() if isinstance(entry, dict) else entry)
            for page in pages(part)
        ]

    named = pages(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    written = [
        str(page.relative_to(ROOT / "docs")) for page in PAGES if page.is_relative_to(ROOT / "docs")
    ]
    assert len(named) == len(set(named))
    assert set(named) == {*written, *script("site_pages").made_pages()}


def test_every_public_name_is_in_the_python_reference():
    import zonda
    from zonda.core.registry import operators

    pages = "\n".join(script("site_pages").api_pages().values())
    builtin = {c.name for c in operators.candidates() if c.distribution == "zonda"}
    for name in {*zonda.__all__, *builtin} - {"__version__"}:
        assert re.search(rf"^::: .*\.{name}$|`zonda\.{name}`", pages, re.M), name


@pytest.mark.parametrize(
    "path", sorted((ROOT / "docs" / "tutorials").glob("*.ipynb")), ids=lambda p: p.stem
)
def test_notebooks_are_kept_without_results(path):
    """`.ci/site` executes them."""
    cells = json.loads(path.read_text())["cells"]
    assert cells[0]["cell_type"] == "markdown"
    assert "".join(cells[0]["source"]).startswith("# ")
    for cell in cells:
        if cell["cell_type"] == "code":
            assert not cell["outputs"]
            assert cell["execution_count"] is None
            if not "".join(cell["source"]).startswith("%%"):  # files and commands
                compile("".join(cell["source"]), path.name, "exec")


def test_no_page_shows_lines_of_the_progress_bar():
    """They depend on the machine, and say nothing about the result."""
    from types import SimpleNamespace

    keep = script("site_pages").without_progress
    bar = "scan-000: SkyMap, WhiteNoise, E [#...................] 7 %\n"
    alone = SimpleNamespace(output_type="stream", text=bar + bar.replace("7 %", "89 %, 1 s left"))
    mixed = SimpleNamespace(output_type="stream", text=f"{bar}4 tasks in 17.4 s\n")
    table = SimpleNamespace(output_type="execute_result", data={})
    assert [keep(output) for output in (alone, mixed, table)] == [False, True, True]
    assert mixed.text == "4 tasks in 17.4 s\n"


def test_what_is_in_the_gallery_says_what_it_shows():
    pages = script("site_pages")
    for path in sorted((ROOT / "docs" / "gallery").glob("*.yaml")):
        about = pages.header(path)
        assert about["title"]
        assert about["text"].endswith("."), path.name
        assert about["picture"].endswith(".png")


def test_the_site_links_to_files_that_it_has(tmp_path):
    """What stands elsewhere in the repository is named; a notebook is its page;
    benchmarks/README.md is a page of the site.
    """
    from types import SimpleNamespace

    change = script("site_pages").on_page_markdown
    shown = SimpleNamespace(file=SimpleNamespace(src_uri="performance.md"))
    code = "\n```sh\n[x](../LICENSE)\n```\n"
    text = (
        "[b](../benchmarks/README.md#x) [t](tutorials/plugin.ipynb) [`l`](../LICENSE)"
        " [m](maps.md#y) [plan.md](plan.md)"
    )
    title = (ROOT / "docs" / "plan.md").read_text().splitlines()[0].removeprefix("# ")
    wanted = (
        "[b](development/benchmarks.md#x) [t](tutorials/plugin.md) `LICENSE` [m](maps.md#y)"
        f" [{title}](plan.md)"
    )
    assert change(text + code, shown, None, None) == wanted + code


def test_the_reference_is_made_from_the_operators():
    module = script("make_reference")
    assert module.PAGE.read_text() == module.page(), "run python docs/make_reference.py"


def test_the_operators_of_the_page_for_authors_are_right(tmp_path, monkeypatch):
    """The gain drift multiplies all of the signal, tens of kelvin of mean included, and loses no
    microkelvin.
    """
    import numpy as np

    import zonda
    import zonda.testing
    from zonda.core.registry import noise_models

    first, *others = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "plugins.md").read_text(), re.S
    )
    assert set(re.findall(r"^(?:import|from) .*", first, re.M)) == {
        "import numpy as np",
        "import zonda",
    }
    (tmp_path / "page_for_authors.py").write_text(
        first + "".join(others)
    )  # a file: docstrings of fields are read from it
    monkeypatch.syspath_prepend(str(tmp_path))
    page = importlib.import_module("page_for_authors")
    drift, demean = page.SwingingGain(period="20 s"), page.Demean()
    zonda.testing.check_operator(drift)
    zonda.testing.check_operator(demean)
    zonda.testing.check_operator(page.Rms())
    zonda.testing.check_operator(page.AzimuthSlope())
    zonda.testing.check_operator(page.Peak())
    noise_models.register(page.Rings, name="my_rings")
    noise = zonda.WhiteNoise(model={"name": "my_rings", "growth": "50 %"})
    assert noise.model.growth == page.noise.model.growth == 0.5
    zonda.testing.check_operator(noise)

    def signal(*steps):
        scene = zonda.Scene(
            site="green_bank",
            instrument="mustang2",
            time="2024-11-25T07:00",
            target="05h +20d",
            seed=5,
        )
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
    # what stands beside the mean, below 2 K (4 sigma of 1 % of 50 K), is rounded to 2^-24 of it,
    # before and after
    assert np.abs(drifting - gain * plain).max() < 2 * 2 * 2.0**-24
    left, _ = signal(demean)
    true = plain - plain.mean(axis=1, keepdims=True)
    assert np.abs(left - true).max() < 2.0**-24 * np.abs(true).max()

    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=5
    )
    steps = [
        zonda.PointingStare(scan_duration="5 s"),
        zonda.WhiteNoise(),
        page.AzimuthSlope(slope="1 K"),
        zonda.Efficiency(),
        page.Peak(),
        page.SavePeak(),
    ]
    data = zonda.Pipeline(steps, runs={"clean": {"without": ["slope"]}}).run(scene, output=tmp_path)
    assert (tmp_path / "peaks.txt").read_text().split()[::2] == ["peak", "clean/peak"]
    assert abs(data.products["peak"] - data.products["clean/peak"]) > 1


def test_the_instrument_that_the_page_for_authors_shows(tmp_path, monkeypatch):
    """As a file beside a pipeline, and found by its name in an installed package."""
    from zonda.core import registry
    from zonda.core.cli import main

    page = (ROOT / "docs" / "plugins.md").read_text()
    text = re.search(r"```yaml\n(my_camera:.*?)```", page, re.S)[1]
    (tmp_path / "my_camera.yaml").write_text(text)
    steps = (SCAN + MAPPED).replace("radius: 10", "radius: 3")
    (tmp_path / "p.yaml").write_text(
        PLACE + "instrument: my_camera.yaml\n" + SCENE + "operators:\n" + steps
    )
    monkeypatch.chdir(tmp_path)
    assert main(["run", "p.yaml", "--output", "out", "--threads", "1"]) == 0

    setup = re.search(r'```toml\n(\[project\]\nname = "my-cameras".*?)```', page, re.S)[1]
    listed = re.search(r"```text\n(pyproject.toml\n.*?)```", page, re.S)[1].split()
    parts = tomllib.loads(setup)
    installed = tmp_path / "site-packages"
    package = installed / "my_cameras"
    for name in listed[1:]:
        (installed / name).parent.mkdir(parents=True, exist_ok=True)
        (installed / name).write_text(text if name.endswith(".yaml") else "")
    data = parts["tool"]["setuptools"]["package-data"]["my_cameras"]
    assert {path for pattern in data for path in package.glob(pattern)} == {
        *package.rglob("*.yaml")
    }
    info = installed / "my_cameras-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-cameras\nVersion: 1.0\n")
    points = parts["project"]["entry-points"]["zonda.instruments"]
    lines = [f"{key} = {value}\n" for key, value in points.items()]
    (info / "entry_points.txt").write_text("[zonda.instruments]\n" + "".join(lines))
    monkeypatch.syspath_prepend(str(installed))
    registry.refresh()
    try:
        made = registry.instruments.create("my_camera")
    finally:
        monkeypatch.undo()
        registry.refresh()
    assert (made.name, made.detectors, made.telescope.site) == ("my_camera", 38, "chajnantor")
    assert made.provenance == "detectors: first light, 2025; stand-in: NET: assumed"


def test_the_operator_that_contributing_shows_keeps_the_contract(tmp_path, monkeypatch):
    import textwrap

    import zonda.testing

    text = re.search(r"   ```py\n(.*?)   ```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)[1]
    (tmp_path / "page_for_contributors.py").write_text(textwrap.dedent(text))
    monkeypatch.syspath_prepend(str(tmp_path))
    page = importlib.import_module("page_for_contributors")
    zonda.testing.check_operator(page.SwingingGain(period="20 s"))
