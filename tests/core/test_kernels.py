from __future__ import annotations

import dis
import os
import pkgutil
import subprocess
import sys
import warnings
from functools import cache
from importlib import import_module, util
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import zonda
from zonda.core import kernels
from zonda.core.cli import main
from zonda.core.errors import OutputError

INNER = """
from zonda.core.kernels import kernel
FACTOR = {factor}

@kernel
def inner(x):
    return FACTOR * x
"""
OUTER = """
from zonda.core.kernels import kernel
from zonda.toy_inner import inner

@kernel
def outer(x):
    return inner(x) + 1
"""
PROCESS = """
import importlib.util, sys, warnings
import numpy as np
warnings.simplefilter("error")
for name in ("toy_inner", "toy_outer"):
    spec = importlib.util.spec_from_file_location(f"zonda.{name}", f"{sys.argv[1]}/{name}.py")
    module = sys.modules[f"zonda.{name}"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
for kind in sys.argv[2:]:
    print(module.outer(np.dtype(kind).type(2)))
print(sum(module.outer.stats.cache_hits.values()))
"""
TYPES = ("float64", "float32", "int64", "int32")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder, and the modules of `INNER` and `OUTER`."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    write(tmp_path)
    return tmp_path


def write(place: Path, factor: float = 3.0) -> None:
    (place / "toy_inner.py").write_text(INNER.format(factor=factor))
    (place / "toy_outer.py").write_text(OUTER)


def start(place: Path, *kinds: str, **environment: str) -> subprocess.Popen[str]:
    """A process that calls `outer` with 2 of each type; see `values`."""
    return subprocess.Popen(
        [sys.executable, "-c", PROCESS, str(place), *kinds],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
            "PYTHONDONTWRITEBYTECODE": "1",  # sources of one second and size look the same to it
            **environment,
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def values(process: subprocess.Popen[str]) -> list[float]:
    """Values that a process printed, and how many kernels it loaded."""
    out, err = process.communicate()
    assert process.returncode == 0, err
    return [float(word) for word in out.split()]


def test_four_first_runs_at_once_with_different_types(place: Path) -> None:
    """Each gets its own value, and so does every later run, which compiles nothing."""
    first = [values(process)[0] for process in [start(place, kind) for kind in TYPES]]
    assert first == [7.0] * 4
    later = [start(place, *TYPES[k:], *TYPES[:k]) for k in range(4)]
    assert [values(process) for process in later] == [[7.0] * 4 + [4.0]] * 4


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_changes(place: Path) -> None:
    assert values(start(place, "float64")) == [7.0, 0.0]
    assert values(start(place, "float64")) == [7.0, 1.0]
    write(place, factor=5.0)
    assert values(start(place, "float64")) == [11.0, 0.0]


def test_another_processor_has_its_own_machine_code(place: Path) -> None:
    assert values(start(place, "float64")) == [7.0, 0.0]
    assert values(start(place, "float64", NUMBA_CPU_NAME="generic")) == [7.0, 0.0]
    assert len(list((place / "cache" / "zonda-kernels").glob("zonda-*"))) == 2


def test_the_folder_is_the_users_alone(place: Path) -> None:
    values(start(place, "float64"))
    folder = place / "cache" / "zonda-kernels"
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    process = start(place, "float64")
    assert "others may write to" in process.communicate()[1]


def test_kernels_of_others_stay_where_numba_has_them(place: Path) -> None:
    before = numba.config.CACHE_DIR
    loaded(place, "toy_inner")
    assert before == numba.config.CACHE_DIR


def test_where_nothing_can_be_stored_kernels_work_and_one_warning_names_the_cure(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(place / "file" / "below"))
    monkeypatch.setattr(kernels, "folder", cache(kernels.folder.__wrapped__))
    with pytest.warns(UserWarning, match="set NUMBA_CACHE_DIR to a folder"):
        inner = loaded(place, "toy_inner").inner
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        outer = loaded(place, "toy_outer").outer
    assert (inner(2.0), outer(2.0)) == (6.0, 7.0)
    assert main(["compile", "mustang2_cluster"]) == 2


def test_the_users_cache_folder_unless_numba_is_told_another(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(kernels.event, "register", lambda *arguments: None)
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("ZONDA_CACHE_DIR", str(tmp_path / "mine"))
    assert kernels.folder.__wrapped__() == tmp_path / "mine" / "zonda-kernels"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "numba"))
    assert kernels.folder.__wrapped__() == tmp_path / "numba" / "zonda-kernels"


FORK = """
import os, sys
from zonda.core.kernels import CacheLock

lock = CacheLock(sys.argv[1])
lock.on_start(None)
child = os.fork()
if child:
    lock.on_end(None)
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
lock.on_start(None)  # when the other process has released it
lock.on_end(None)
"""


def test_a_forked_process_has_a_lock_of_its_own(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", FORK, str(tmp_path / "lock")], check=True)


def test_the_lock_is_held_while_a_kernel_is_compiled(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = kernels.CacheLock(place / "lock")
    other = kernels.filelock.FileLock(place / "lock", timeout=0)
    lock.on_start(None)
    lock.on_start(None)  # another thread
    lock.on_end(None)
    with pytest.raises(kernels.filelock.Timeout):
        other.acquire()
    lock.on_end(None)
    with other:
        lock.try_out()
        monkeypatch.setattr(kernels, "PATIENCE", 0)
        with pytest.raises(OutputError, match="another process has been compiling"):
            lock.on_start(None)


@pytest.mark.nightly
def test_compile_leaves_nothing_to_compile(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "small.yaml"
    path.write_text(
        "site: green_bank\ninstrument: mustang2\ntime: 2024-11-25T07:00\ntarget: 05h +20d\n"
        "operators:\n- PointingDaisy: {scan_duration: 20 s}\n- WhiteNoise\n- Efficiency\n- BinMap\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(place / "cache"), "NUMBA_DEBUG_CACHE": "1"}

    def command(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "zonda", *arguments],
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "data saved to" in command("compile", str(path))
    assert "data saved to" not in command("run", str(path), "--output", str(tmp_path / "out"))


def loaded(place: Path, name: str) -> ModuleType:
    """A module of ``place``."""
    spec = util.spec_from_file_location(f"zonda.{name}", place / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[f"zonda.{name}"] = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def every_kernel() -> dict[Any, Dispatcher]:
    """The kernels of zonda by their Python functions."""
    found: dict[Any, Dispatcher] = {}
    for module in pkgutil.walk_packages(zonda.__path__, "zonda."):
        if module.name.startswith(("zonda.core", "zonda.operators", "zonda.plugins.forecast")):
            for value in vars(import_module(module.name)).values():
                if isinstance(value, Dispatcher):
                    found[value.py_func] = value
    assert len(found) > 40
    return found


def test_kernels_that_others_call_say_how_they_round() -> None:
    """A kernel that does not state ``fastmath`` inherits it from whoever has it compiled first;
    numba keeps the result for all: bits would depend on the order of compilation."""
    silent = set()
    for function, kernel in every_kernel().items():
        if kernel.targetoptions.get("fastmath"):
            called = (function.__globals__.get(name) for name in function.__code__.co_names)
            silent |= {
                k.py_func.__qualname__
                for k in called
                if isinstance(k, Dispatcher) and "fastmath" not in k.targetoptions
            }
    assert not silent


def test_what_kernels_import_is_part_of_their_folder() -> None:
    """Kernels, intrinsics and plain numbers are; anything else could change unseen."""

    def names(code: CodeType) -> set[str]:
        inner = (names(c) for c in code.co_consts if isinstance(c, CodeType))
        own = {i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"}
        return own.union(*inner)

    unseen = set()
    for function in every_kernel():
        for name in names(function.__code__) & function.__globals__.keys():
            value = function.__globals__[name]
            module = getattr(value, "__module__", None) or ""
            seen = (
                isinstance(value, (int, float, np.generic))
                or module in kernels._with_kernels
                or (
                    not getattr(value, "__name__", module).startswith("zonda.")
                    and not module.startswith("zonda.")
                    and not isinstance(value, (tuple, np.ndarray))
                )
            )
            if not seen:
                unseen.add(f"{function.__module__}.{function.__name__}: {name}")
    assert not unseen
