"""Pages of the site that are made while `mkdocs build` runs: executed tutorials, the gallery, the
Python reference, and pages that stand elsewhere in the repository. `mkdocs.yml` names it as a hook.

What is executed is kept in ``build/site_cache`` until the page or the code of zonda changes. With
``SITE_PREVIEW=1`` older results are shown as they are, so that a page can be written with ``mkdocs
serve``.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CACHE = ROOT / "build" / "site_cache"
ELSEWHERE = {
    "development/contributing.md": "CONTRIBUTING.md",
    "development/changelog.md": "CHANGELOG.md",
    "development/benchmarks.md": "benchmarks/README.md",
    "development/atmosphere_data.md": "operators/atmosphere/data/README.md",
}
"""Page of the site -> file of the repository that it shows."""
API = {
    "scene": ("Scene and pipeline", "Scene Site Instrument Telescope Band Pipeline load plan"),
    "data": (
        "Data and maps",
        "Data Observation Focalplane Product zonda.core.maps.map_product.MapProduct",
    ),
    "authors": (
        "For authors of operators",
        (
            "Operator Block Stream Component Signal product_name MapMaker Output Planning Knob"
            " NoiseModel WeatherSource Column register hookimpl normals uniforms quantity"
        ),
    ),
}
"""Page of the Python reference -> its title and the names on it; a name that no page has is on the
first one.
"""


# -- the pages ------------------------------------------------------------------------------------


def made_pages() -> list[str]:
    """Paths of all pages that are made here, as `mkdocs.yml` names them."""
    notebooks = [
        f"tutorials/{path.stem}.md" for path in sorted((DOCS / "tutorials").glob("*.ipynb"))
    ]
    return [*notebooks, "gallery/index.md", *ELSEWHERE, *api_pages()]


def on_files(files: Any, config: Any) -> Any:
    """Add the pages, with their pictures, to those that MkDocs has found."""
    from mkdocs.structure.files import File

    def add(path: str, content: str | bytes) -> None:
        known = files.get_file_from_path(path)
        if known is not None:
            files.remove(known)
        files.append(File.generated(config, path, content=content))

    for path, source in ELSEWHERE.items():
        add(path, (ROOT / source).read_text("utf-8"))
    for path, text in api_pages().items():
        add(path, text)
    for notebook in sorted((DOCS / "tutorials").glob("*.ipynb")):
        for name, content in tutorial(notebook).items():
            add(f"tutorials/{name}", content)
    text = GALLERY
    for pipeline in sorted(
        (DOCS / "gallery").glob("*.yaml"), key=lambda path: int(path.stem.partition("_")[0])
    ):
        add(f"gallery/{pipeline.stem}.png", cached(pipeline, gallery_picture)["picture.png"])
        text += gallery_entry(pipeline)
    code = (DOCS / "gallery" / "filament.py").read_text("utf-8")
    text += f"\n## filament.fits\n\n```python\n{code}```\n"
    add("gallery/index.md", text)
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links as the site has them: to a made page instead of the file it is made from; none to files
    that it does not have.
    """
    path = page.file.src_uri
    source = ROOT / ELSEWHERE.get(path, f"docs/{path}")
    pages = {(ROOT / file).resolve(): page for page, file in ELSEWHERE.items()}

    def link(match: re.Match[str]) -> str:
        text, target, anchor = match[1], match[2], match[3] or ""
        found = (source.parent / target).resolve()
        if text == target and found.suffix == ".md" and found.exists():
            text = title(found)
        if target.endswith(".ipynb") and not text.startswith("Download"):
            found = found.with_suffix(".md")
        elif found in pages:
            found = DOCS / pages[found]
        elif not found.is_relative_to(DOCS):
            return (
                f"`{found.relative_to(ROOT)}`"
                if text == target or "`" in text
                else f"{text} (`{found.relative_to(ROOT)}`)"
            )
        elif path not in ELSEWHERE:
            return f"[{text}]({target}{anchor})"
        return f"[{text}]({os.path.relpath(found, (DOCS / path).parent)}{anchor})"

    parts = re.split(r"(^```.*?^```|`[^`\n]+`(?!\]))", markdown, flags=re.S | re.M)
    return "".join(
        p if i % 2 else re.sub(r"\[([^\]]*)\]\(([^)#:\s]+)(#[^)]*)?\)", link, p)
        for i, p in enumerate(parts)
    )


def title(path: Path) -> str:
    """First heading of a page."""
    found = re.search(r"^# (.*)$", path.read_text("utf-8"), re.M)
    return found[1].replace("`", "") if found else path.name


# -- what is executed -----------------------------------------------------------------------------


@cache
def code_of_zonda() -> str:
    """A digest of everything that a figure depends on besides its page."""
    digest = hashlib.sha256()
    for folder in ("core", "operators", "plugins", "interop", "pipelines", "zonda"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in {".py", ".yaml", ".npz", ".fits"}:
                digest.update(path.read_bytes())
    return digest.hexdigest()


def cached(source: Path, make: Any) -> dict[str, bytes]:
    """What ``make(source)`` returns, {file name: content}, kept from one build to the next."""
    key = hashlib.sha256(source.read_bytes() + code_of_zonda().encode()).hexdigest()[:20]
    folder = CACHE / f"{source.stem}-{key}"
    older = sorted(CACHE.glob(f"{source.stem}-*"), key=lambda p: p.stat().st_mtime)
    if os.environ.get("SITE_PREVIEW") and older:
        folder = older[-1]
    if not folder.exists():
        print(f"running {source.relative_to(ROOT)}", file=sys.stderr)
        made = make(source)
        scratch = CACHE / f".{folder.name}"
        scratch.mkdir(parents=True, exist_ok=True)
        for name, content in made.items():
            (scratch / name).parent.mkdir(parents=True, exist_ok=True)
            (scratch / name).write_bytes(content)
        scratch.rename(folder)
    return {
        str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def executed(path: Path) -> dict[str, bytes]:
    """A notebook with its results, run in an empty folder. A cell that fails fails the build."""
    from tempfile import TemporaryDirectory

    import nbformat
    from nbclient import NotebookClient
    from traitlets.config import Config

    notebook = nbformat.read(path, as_version=4)
    os.environ["PATH"] = os.pathsep.join(
        [str(Path(sys.executable).parent), os.environ["PATH"]]
    )  # for cells that run `zonda`
    with TemporaryDirectory() as folder, TemporaryDirectory() as sockets:
        local = Config({"KernelManager": {"transport": "ipc", "ip": f"{sockets}/kernel"}})
        place = {"metadata": {"path": folder}}
        NotebookClient(
            notebook, timeout=600, coalesce_streams=True, config=local, resources=place
        ).execute()
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if without_progress(output)]
    return {"notebook.ipynb": nbformat.writes(notebook).encode()}


def without_progress(output: Any) -> bool:
    """Remove lines of the progress bar, which depend on the machine, from a cell's output; False if
    nothing else is in it.
    """
    if output.output_type != "stream":
        return True
    output.text = re.sub(r"^.*\[[#.]+\] +\d+ %.*\n?", "", output.text, flags=re.M)
    return bool(output.text.strip())


def tutorial(path: Path) -> dict[str, bytes]:
    """The page of a notebook, and its pictures."""
    import nbformat
    from nbconvert import MarkdownExporter

    notebook = nbformat.reads(cached(path, executed)["notebook.ipynb"].decode(), as_version=4)
    names = {"unique_key": path.stem, "output_files_dir": f"{path.stem}_files"}
    text, resources = MarkdownExporter().from_notebook_node(notebook, names)
    head, _, rest = text.lstrip().partition("\n")
    page = f"{head}\n\n[Download this page as a notebook]({path.name})\n\n{printed(rest)}"
    return {f"{path.stem}.md": page.encode(), **resources["outputs"]}


def printed(text: str) -> str:
    """Output, which nbconvert indents, as a block of text of its own class."""

    def block(match: re.Match[str]) -> str:
        lines = [line[4:] for line in match[0].strip("\n").split("\n")]
        if not any(line.strip() for line in lines):
            return "\n\n"
        return (
            '\n\n<div class="output" markdown>\n\n```text\n'
            + "\n".join(lines)
            + "\n```\n\n</div>\n\n"
        )

    parts = re.split(r"(^```.*?^```)", text, flags=re.S | re.M)
    return "".join(
        p if i % 2 else re.sub(r"\n\n(?:    [^\n]*\n|\n(?=    ))+", block, p)
        for i, p in enumerate(parts)
    )


def gallery_picture(path: Path) -> dict[str, bytes]:
    """Run a pipeline of the gallery; the picture that its first comment names."""
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        shutil.copy(
            ROOT / "pipelines" / "data" / "merging_cluster.fits", Path(folder) / "my_cluster.fits"
        )
        if "filament.fits" in path.read_text("utf-8"):
            subprocess.run(
                [sys.executable, DOCS / "gallery" / "filament.py"], cwd=folder, check=True
            )
        zonda = Path(sys.executable).with_name("zonda")
        done = subprocess.run(
            [zonda, "run", path, "--output", "out"], cwd=folder, capture_output=True, text=True
        )
        if done.returncode:
            raise SystemExit(f"{path.relative_to(ROOT)}: {done.stderr}")
        return {
            "picture.png": beside(
                [Path(folder) / "out" / name for name in header(path)["picture"].split(", ")]
            )
        }


def beside(pictures: list[Path]) -> bytes:
    """One picture, or several in rows of two."""
    from io import BytesIO

    from PIL import Image

    if len(pictures) == 1:
        return pictures[0].read_bytes()
    parts = [Image.open(path).convert("RGB") for path in pictures]
    width, height = (max(getattr(p, side) for p in parts) for side in ("width", "height"))
    whole = Image.new("RGB", (2 * width, -(-len(parts) // 2) * height), "white")
    for k, part in enumerate(parts):
        whole.paste(part, (k % 2 * width, k // 2 * height))
    made = BytesIO()
    whole.quantize(256).save(made, "png", optimize=True)
    return made.getvalue()


# -- the gallery ----------------------------------------------------------------------------------

GALLERY = """# Gallery

Each figure is made by the pipeline beside it while this site is built. Save one as `my.yaml`, change it, `zonda run my.yaml`: the
figure is in `out/my`. `my_cluster.fits` is the input map that comes with zonda (`pipelines/data/merging_cluster.fits`), or yours;
`filament.fits` is made by [a few lines of Python](#filamentfits).
"""


def header(path: Path) -> dict[str, str]:
    """The comments at the head of a pipeline of the gallery: title, picture, text."""
    lines = re.match(r"(?:#.*\n)+", path.read_text("utf-8"))
    assert lines is not None, path
    found = dict(re.findall(r"^# (title|picture): (.*)$", lines[0], re.M))
    text = [
        line[2:] for line in lines[0].splitlines() if not re.match(r"# (title|picture): ", line)
    ]
    return {**found, "text": " ".join(text)}


def gallery_entry(path: Path) -> str:
    """Title, text, figure and pipeline."""
    about = header(path)
    code = re.sub(r"^(?:#.*\n)+", "", path.read_text("utf-8"))
    figure = f"![{about['title']}]({path.stem}.png)"
    return (
        f'\n## {about["title"]}\n\n{about["text"]}\n\n<div class="beside"'
        f" markdown>\n\n{figure}\n\n```yaml\n{code}```\n\n</div>\n"
    )


# -- the Python reference -------------------------------------------------------------------------


def api_pages() -> dict[str, str]:
    """Pages that mkdocstrings fills from docstrings: zonda's public names, and every operator by
    folder.
    """
    import zonda
    from zonda.core import errors
    from zonda.core.configuration import units
    from zonda.core.registry import operators

    folders, folder_of = of_reference("FOLDERS"), of_reference("folder_of")
    public = [name for name in zonda.__all__ if not name.startswith("_")]
    quantities = [name for name in public if hasattr(units, name)]
    raised = [
        name
        for name, cls in vars(errors).items()
        if isinstance(cls, type) and issubclass(cls, errors.ZondaError)
    ]
    placed = {*quantities, *raised} | {name for _, names in API.values() for name in names.split()}
    first = next(iter(API))
    pages, lists = {}, []
    for key, (title, names) in API.items():
        shown = [*names.split(), *([n for n in public if n not in placed] if key == first else [])]
        full = [n if "." in n else f"zonda.{n}" for n in shown]
        pages[f"api/{key}.md"] = page(title, full)
        lists.append((title, key, [n.rsplit(".", 1)[-1] for n in shown]))
    pages["api/units.md"] = units_page(quantities)
    pages["api/errors.md"] = page("Errors", [f"zonda.core.errors.{n}" for n in raised])
    for key, heading in (("linear", "Linear operators"), ("testing", "Testing")):
        shown = "options: {show_root_heading: false, heading_level: 2}"
        pages[f"api/{key}.md"] = f"# {heading}\n\n::: zonda.{key}\n    {shown}\n"
    lists += [("Units of parameters", "units", quantities), ("Errors", "errors", raised)]
    found = [operators.get(c.name) for c in operators.candidates() if c.distribution == "zonda"]
    for folder, title in folders.items():
        classes = sorted((c for c in found if folder_of(c) == folder), key=lambda c: c.__name__)
        pages[f"api/{folder}.md"] = f"# {title}\n\n" + "".join(map(operator, classes))
        lists.append((title, folder, [c.__name__ for c in classes]))
    pages["api/index.md"] = index(lists)
    return pages


def page(title: str, names: list[str]) -> str:
    """A title, and what mkdocstrings says of each name."""
    return f"# {title}\n\n" + "".join(f"::: {name}\n\n" for name in names)


def of_reference(name: str) -> Any:
    """A name of `make_reference.py`, which stands beside this file."""
    sys.path.insert(0, str(DOCS))
    try:
        return getattr(importlib.import_module("make_reference"), name)
    finally:
        sys.path.remove(str(DOCS))


def operator(cls: Any) -> str:
    """What mkdocstrings says of an operator, with the parameters that it has from its base
    classes.
    """
    from zonda.core.configuration.describe import described

    inherited = [
        name
        for name in described(cls)
        if name not in vars(cls).get("__annotations__", {}) and name != "name"
    ]
    return (
        f"::: {cls.__module__}.{cls.__qualname__}\n    options: {{inherited_members:"
        f" {inherited}}}\n\n"
    )


def units_page(names: list[str]) -> str:
    """The types of parameters and the units in which they are kept."""
    from zonda.core.configuration import units

    rows = [f"| `zonda.{n}` | {getattr(units, n).__metadata__[0].unit} |" for n in names]
    head = (
        "# Units of parameters\n\nTypes of an operator's parameters. Each takes text with a unit"
        " and is kept as a float.\n"
    )
    return "\n".join(
        [
            head,
            "| type | kept in |",
            "|---|---|",
            *rows,
            "",
            "::: zonda.core.configuration.parameters.quantity",
            "",
        ]
    )


def index(lists: list[tuple[str, str, list[str]]]) -> str:
    """All names, with links to their pages."""
    lines = [
        "# Python",
        "",
        (
            "`import zonda` gives all of these; operators are `zonda.PointingDaisy` and so on."
            " Nothing heavy is"
        ),
    ]
    lines += [
        "imported until a name is used. A first example is [on the front page](../index.md).",
        "",
    ]
    for title, key, names in lists:
        lines += [f"**[{title}]({key}.md)**: " + ", ".join(f"`{n}`" for n in names) + "", ""]
    return "\n".join(lines)
