"""What a pipeline file or a data file cannot do: run code, open other files, write outside its
folder, reach the network.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import zonda
from zonda.core import cli
from zonda.core.configuration.pipeline_file import parse
from zonda.core.errors import InputError, OutputError, ZondaError
from zonda.core.storage.files import product_path, write_text

ROOT = Path(__file__).parents[1]
PRODUCT = sorted(
    p
    for f in ("core", "operators", "plugins", "interop", "pipelines", "zonda")
    for p in (ROOT / f).rglob("*.py")
)

# --------------------------------------------------------------------------------------------------
# code

CALLS = {
    "eval",
    "exec",
    "compile",
    "__import__",
    "os.system",
    "os.popen",
    "pickle.load",
    "pickle.loads",
    "marshal.loads",
    "shelve.open",
    "yaml.load",
    "yaml.unsafe_load",
    "yaml.full_load",
    "dill.loads",
    "joblib.load",
    "subprocess.run",
    "subprocess.Popen",
    "subprocess.call",
    "subprocess.check_output",
    "importlib.import_module",
    "import_module",
    "runpy.run_path",
    "urlopen",
    "urllib.request.urlopen",
    "socket.socket",
    "requests.get",
}
ALLOWED = {
    ("core/cli/entry.py", "import_module"): "names from the table in zonda/commands.py",
    ("core/discovery.py", "import_module"): "names from the metadata of installed packages",
    (
        "core/storage/hdf5_files.py",
        "subprocess.run",
    ): "zonda itself, as a child; no shell; the file's path is one argument",
    (
        "operators/atmosphere/weather/era5.py",
        "import_module",
    ): "cdsapi, by its name, when the user asks to fetch",
    ("core/components.py", "import_module"): "names from the registries' own declarations",
    (
        "plugins/checks/dispatch.py",
        "subprocess.run",
    ): "zonda itself, as a child; no shell; the folder's path is one argument",
    (
        "core/storage/table_files.py",
        "yaml.load",
    ): "with the base loader: texts, lists and mappings; tags are not followed",
    ("core/machine.py", "import_module"): "names that bridges and steps state",
    ("zonda/__init__.py", "import_module"): "names from a table in the same file",
}
"""Calls that could run what a file says, and why these do not."""


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    """Names of called functions: ``f``, ``module.f``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def test_no_code_from_data() -> None:
    found = set()
    assert len(PRODUCT) > 100
    for path in PRODUCT:
        where = path.relative_to(ROOT)
        if any(part.is_symlink() for part in [ROOT / p for p in where.parents]):
            continue  # zonda/core and the like lead to the folders above
        for name, call in calls(ast.parse(path.read_text(encoding="utf-8"))):
            if name in CALLS:
                found.add((where.as_posix(), name))
            for keyword in call.keywords:
                assert not (keyword.arg == "shell" and ast.unparse(keyword.value) != "False"), (
                    f"{where}: a shell"
                )
                assert not (
                    keyword.arg == "allow_pickle" and ast.unparse(keyword.value) != "False"
                ), f"{where}: pickles in arrays"
                assert not (
                    keyword.arg == "character_as_bytes" and "pickle" in ast.unparse(call)
                ), where
    assert found <= set(ALLOWED), (
        f"say in ALLOWED why these are safe: {sorted(found - set(ALLOWED))}"
    )


def test_the_walk_sees_what_it_looks_for() -> None:
    text = "import os\nos.system('x')\neval('1')\nyaml.load(t)\nnp.load(f, allow_pickle=True)\n"
    assert {name for name, _ in calls(ast.parse(text))} == {
        "os.system",
        "eval",
        "yaml.load",
        "np.load",
    }


@pytest.mark.parametrize(
    "tag",
    [
        "python/object/apply:os.system [touch owned]",
        "python/name:os.system ''",
        "python/module:os ''",
        "python/object:x.Y {}",
    ],
)
def test_yaml_makes_no_objects(tag: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ZondaError, match=r"the tag !!python/"):
        parse(f"site: !!{tag}\noperators: [BinMap]\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name", ["os:system", "subprocess.Popen", "zonda.core.cli:main", "../../evil", "builtins:eval"]
)
def test_operators_are_only_those_of_installed_packages(name: str) -> None:
    with pytest.raises(ZondaError, match="unknown operator"):
        parse(
            "site: green_bank\ninstrument: mustang2\ntime: 2024-11-25T07:00\noperators:"
            f" ['{name}']\n"
        )
    with pytest.raises(ZondaError, match="unknown site"):
        parse(
            f"site: '{name}'\ninstrument: mustang2\ntime: 2024-11-25T07:00\noperators: [BinMap]\n"
        )


# --------------------------------------------------------------------------------------------------
# data files


def hdf5(path: Path) -> Path:
    """A file of time-ordered data with the pointing taken out."""
    sys.path.insert(0, str(ROOT / "tests" / "fuzz"))
    try:
        from fuzz_hdf5 import tiny_scan
    finally:
        sys.path.pop(0)
    from zonda.operators.io.save_tod import save_tod

    return save_tod(path, tiny_scan())


@pytest.mark.parametrize("how", ["external link", "external storage", "virtual"])
def test_hdf5_files_lead_to_no_other_file(how: str, tmp_path: Path) -> None:
    from zonda.operators.io.save_tod import load_tod

    path = hdf5(tmp_path / "scan.h5")
    assert load_tod(path).n_samples == 5
    with h5py.File(tmp_path / "secret.h5", "w") as secret:
        secret["times"] = np.arange(5.0)
    with h5py.File(path, "a") as file:
        del file["shared/times"]
        if how == "external link":
            file["shared/times"] = h5py.ExternalLink(tmp_path / "secret.h5", "/times")
        elif how == "external storage":
            file.create_dataset(
                "shared/times",
                (5,),
                "f8",
                external=[(str(tmp_path / "secret.h5"), 0, h5py.h5f.UNLIMITED)],
            )
        else:
            layout = h5py.VirtualLayout((5,), "f8")
            layout[:] = h5py.VirtualSource(tmp_path / "secret.h5", "times", (5,))
            file.create_virtual_dataset("shared/times", layout)
    with pytest.raises(InputError, match="in another file"):
        load_tod(path)


def test_a_soft_link_stays_in_the_file(tmp_path: Path) -> None:
    from zonda.operators.io.save_tod import load_tod

    path = hdf5(tmp_path / "scan.h5")
    with h5py.File(path, "a") as file:
        file["elsewhere"] = file["shared/times"][:]
        del file["shared/times"]
        file["shared/times"] = h5py.SoftLink("/elsewhere")
        file["loop"] = h5py.SoftLink("/loop")
    assert load_tod(path).n_samples == 5


def test_a_table_of_air_is_numbers_only(tmp_path: Path) -> None:
    from zonda.core.configuration.time import Instant
    from zonda.core.site import Site
    from zonda.operators.atmosphere.weather.sources import Table

    (tmp_path / "air.csv").write_text(
        "height [m], pressure [hPa], temperature [K], relative humidity [%]\n__import__('os'), 1,"
        " 2, 3\n"
    )
    site = Site(name="s", latitude="0 deg", longitude="0 deg")
    with pytest.raises(InputError, match="not a finite number"):
        Table(table=tmp_path / "air.csv").column(site, Instant.parse("2024-03-01"))


# --------------------------------------------------------------------------------------------------
# output folder


@settings(max_examples=300, derandomize=True, deadline=None, database=None)
@given(name=st.text(min_size=1, max_size=300) | st.from_regex(r"(\.\./|/|\\|~|\x00|a){1,20}"))
def test_no_name_leaves_the_output_folder(name: str) -> None:
    try:
        path = product_path("/out/run", name, ".fits")
    except OutputError:
        return
    assert os.path.normpath(path) == str(path)
    assert path.parent == Path("/out/run")
    assert "\0" not in path.name
    assert not path.name.startswith((".", "-", "~"))


@pytest.mark.parametrize("name", ["../up", "/etc/x", "a/b", ".", "a\\nb", "a\\0b", "~"])
def test_names_in_a_pipeline_file(name: str) -> None:
    """The pipeline's name makes the folder, so it is refused; a step's name makes files, see
    `product_path`.
    """
    head = "site: green_bank\ninstrument: mustang2\ntime: 2024-11-25T07:00\ntarget: 05h +20d\n"
    steps = "operators: [PointingDaisy, WhiteNoise, Efficiency, BinMap]\n"
    assert parse(head + steps).output == Path("out/_text_".strip("_")) or parse(
        head + steps
    ).output.parent == Path("out")
    with pytest.raises(ZondaError):
        parse(f'name: "{name}"\n{head}{steps}')
    with pytest.raises(ZondaError):
        parse(f'runs: {{"{name}": {{only: [white]}}}}\n{head}{steps}')


def test_a_null_character_in_the_folder_is_refused() -> None:
    with pytest.raises(ZondaError, match="null character"):
        parse(
            'outputs: "a\\0b"\nsite: green_bank\ninstrument: mustang2\ntime:'
            " 2024-11-25T07:00\noperators: [BinMap]\n"
        )


def test_a_link_in_the_output_folder_is_replaced_not_followed(tmp_path: Path) -> None:
    """Whoever may write into the folder could otherwise have the run overwrite any file of its
    user's.
    """
    out = tmp_path / "out"
    out.mkdir()
    precious = tmp_path / "precious"
    precious.write_text("precious")
    (out / "map.fits").symlink_to(precious)
    write_text(out / "map.fits", "new")
    assert precious.read_text() == "precious"
    assert not (out / "map.fits").is_symlink()
    assert (out / "map.fits").read_text() == "new"


STEPS = """\
  - PointingDaisy: {scan_duration: 2 s}
  - WhiteNoise: {name: "../../white"}
  - Efficiency
  - BinMap: {name: "../../../map", pixel: 10 arcsec}
  - SaveTOD: {name: "/etc/tod"}
  - SaveMap
  - Report
"""


def test_a_run_with_names_like_paths_stays_in_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / "a" / "b" / "c"
    deep.mkdir(parents=True)
    monkeypatch.chdir(deep)
    head = (
        "site: green_bank\ninstrument: mustang2\ntime: 2024-11-25T07:00\ntarget: 05h"
        " +20d\noperators:\n"
    )
    (deep / "p.yaml").write_text(head + STEPS)
    status = cli.main(["run", "p.yaml", "--output", "out"])
    assert status == 0
    files = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert files == {"a/b/c/p.yaml"} | {f for f in files if f.startswith("a/b/c/out/")}
    assert len(files) >= 5


# --------------------------------------------------------------------------------------------------
# network

OFFLINE = """
import sys
def refuse(event, arguments):
    calls = ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.bind", "socket.sendto", "urllib.Request")
    if event in calls:
        print("NETWORK", event, arguments, file=sys.stderr, flush=True)
        import os
        os._exit(77)
sys.addaudithook(refuse)
if sys.argv[1:] == ["doctor"]:  # what reads tables of the Earth's orientation and looks at the machine; all else is arithmetic
    from zonda.core import checks
    every = checks.registered
    checks.registered = lambda: [c for c in every() if c.name.startswith("machine.") or c.name == "numerics.over_a_day"]
from zonda.core.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    "arguments",
    [
        [
            "run",
            "mustang2_cluster",
            "--set",
            "PointingDaisy.scan_duration=4 s",
            "--set",
            "PointingDaisy.scans=2",
            "--output",
            "out",
        ],
        ["doctor"],
        ["plugins", "--check"],
    ],
    ids=lambda a: a[0],
)
def test_nothing_reaches_for_the_network(arguments: list[str], tmp_path: Path) -> None:
    command = [sys.executable, "-c", OFFLINE, *arguments]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert "NETWORK" not in done.stderr, done.stderr
    assert done.returncode == 0, done.stderr


def test_the_guard_sees_a_connection(tmp_path: Path) -> None:
    text = OFFLINE.replace(
        "from zonda.core.cli",
        "import socket\nsocket.create_connection(('127.0.0.1', 9))\nfrom zonda.core.cli",
    )
    done = subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 77
    assert zonda.__version__
