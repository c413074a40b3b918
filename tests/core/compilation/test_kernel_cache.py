from __future__ import annotations

import errno
import importlib.util
import os
import pkgutil
import subprocess
import sys
import warnings
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher

import zonda
from zonda.core.compilation import kernel_cache
from zonda.core.compilation.kernel_cache import SUFFIX, KernelCache, KernelFiles, meaning
from zonda.core.registry import operators

INNER = """
import numba as nb
FACTOR = {factor}

@nb.njit(nogil=True, cache=True)
def inner(x):
    return FACTOR * x
"""
OUTER = """
import numba as nb
from zonda.toy_inner import inner

@nb.njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def outer(x):
    return inner(x) + 1
"""
INTRINSIC = """
import numba as nb
from numba.extending import intrinsic

def build(builder, x):
    return builder.{add}(x, x)

@intrinsic
def twice(context, x):
    def generate(context, builder, signature, arguments):
        return build(builder, arguments[0])
    return x(x), generate

@nb.njit(nogil=True, cache=True)
def inner(x):
    return {sign}twice(x)
"""
PROCESS = """
import importlib.util, sys, warnings
warnings.simplefilter("error")
import zonda.core.compilation.kernel_cache as cache
cache.install()
for name in ("toy_inner", "toy_outer"):
    spec = importlib.util.spec_from_file_location(f"zonda.{name}", f"{sys.argv[1]}/{name}.py")
    module = sys.modules[f"zonda.{name}"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
print(module.outer(2.0), module.outer(2), sum(module.outer.stats.cache_hits.values()))
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    import numba

    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    kernel_cache.install()
    write(tmp_path)
    return tmp_path


def write(folder: Path, factor: float = 3.0) -> None:
    (folder / "toy_inner.py").write_text(INNER.format(factor=factor))
    (folder / "toy_outer.py").write_text(OUTER)


def fresh(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """`outer`, as a new process would have it."""
    monkeypatch.setattr(
        sys, "dont_write_bytecode", True
    )  # Python takes sources of the same second and size for the same
    for name in ("toy_inner", "toy_outer"):
        spec = importlib.util.spec_from_file_location(f"zonda.{name}", folder / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module: ModuleType = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, f"zonda.{name}", module)
        spec.loader.exec_module(module)
    return module.outer


def kept(folder: Path, name: str = "") -> list[Path]:
    return sorted(p for p in folder.rglob("*") if name in p.name and SUFFIX in p.name)


def hits(kernel: Any) -> int:
    return sum(kernel.stats.cache_hits.values())


def test_compiled_once(folder, monkeypatch):
    first, second = fresh(folder, monkeypatch), None
    assert (first(2.0), hits(first)) == (7.0, 0)
    second = fresh(folder, monkeypatch)
    assert (second(2.0), hits(second)) == (7.0, 1)
    assert len(kept(folder, "outer")) == 1


def test_a_kernel_is_compiled_with_a_kept_one(folder, monkeypatch):
    """What is loaded at first is machine code alone; the bitcode of what a kernel calls is there
    when it is compiled.
    """
    assert fresh(folder, monkeypatch)(2.0) == 7.0
    for path in kept(folder, "outer"):
        path.unlink()
    outer = fresh(folder, monkeypatch)
    inner = sys.modules["zonda.toy_inner"].inner
    assert (inner(2.0), hits(inner)) == (6.0, 1)
    (loaded,) = inner.overloads.values()
    assert loaded.library._shared_module is None  # nothing was parsed to load it
    assert (outer(2.0), hits(outer)) == (7.0, 0)
    (made,) = outer.overloads.values()
    declared = {f.name for f in made.library._final_module.functions if f.is_declaration}
    assert loaded.fndesc.llvm_func_name not in declared  # linked, or inlined
    again = fresh(folder, monkeypatch)
    assert (again(2.0), hits(again)) == (7.0, 1)


@pytest.mark.parametrize("damage", [b"", b"short", "half", "flipped", "pickle"])
def test_a_damaged_file_is_compiled_again(folder, monkeypatch, damage):
    assert fresh(folder, monkeypatch)(2.0) == 7.0
    (path,) = kept(folder, "outer")
    whole = path.read_bytes()
    middle = len(whole) // 2
    if damage == "half":
        damage = whole[:middle]
    elif damage == "flipped":
        damage = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
    elif damage == "pickle":  # the digest is right, what it stands for is not
        import hashlib

        body = b"no pickle"
        damage = hashlib.blake2b(body, digest_size=16).digest() + body
    path.write_bytes(damage)
    again = fresh(folder, monkeypatch)
    with pytest.warns(UserWarning, match="was damaged; it is compiled again"):
        assert again(2.0) == 7.0
    assert hits(again) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mended = fresh(folder, monkeypatch)
        assert (mended(2.0), hits(mended)) == (7.0, 1)


def test_who_shares_waits_for_what_another_compiles(folder, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    monkeypatch.setattr(kernel_cache, "_CLAIMS", kernel_cache._Claims())
    assert fresh(folder, monkeypatch)(2.0) == 7.0
    made = {path: path.read_bytes() for path in kept(folder)}
    for path in made:
        path.unlink()
    (outer,) = (path for path in made if "outer" in path.name)
    handle = os.open(outer.with_suffix(".claim"), os.O_RDWR | os.O_CREAT)  # as another process does
    fcntl.flock(handle, fcntl.LOCK_EX)
    kernel_cache.share(polite=True)
    with pytest.raises(kernel_cache.Taken):
        fresh(folder, monkeypatch)(2.0)
    kernel_cache.share()

    def done(seconds: float) -> None:
        outer.write_bytes(made[outer])
        os.close(handle)

    monkeypatch.setattr(kernel_cache.time, "sleep", done)
    kernel = fresh(folder, monkeypatch)
    assert kernel(2.0) == 7.0
    assert hits(kernel) == 1
    assert kept(folder) == [outer]  # what it calls was not needed
    assert fresh(folder, monkeypatch)(2) == 7
    assert not kernel_cache._CLAIMS.held
    assert not list(folder.rglob("*.claim"))


def test_nobody_is_waited_for_without_end(folder, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    monkeypatch.setattr(kernel_cache, "_CLAIMS", kernel_cache._Claims())
    monkeypatch.setattr(kernel_cache, "WAIT", 0.02)
    assert fresh(folder, monkeypatch)(2.0) == 7.0
    (outer,) = (path for path in kept(folder) if "outer" in path.name)
    outer.unlink()
    with open(outer.with_suffix(".claim"), "w") as claim:
        fcntl.flock(claim, fcntl.LOCK_EX)
        kernel_cache.share()
        assert fresh(folder, monkeypatch)(2.0) == 7.0
    assert outer in kept(folder)


def test_a_change_in_a_called_kernel_counts(folder, monkeypatch):
    """numba looks at the file of the kernel alone, and would give 7 again."""
    assert fresh(folder, monkeypatch)(2.0) == 7.0
    write(folder, factor=4.0)
    assert fresh(folder, monkeypatch)(2.0) == 9.0


def test_a_change_in_an_intrinsic_counts(tmp_path, monkeypatch):
    """In the intrinsic itself, or in what it is generated by."""
    made = set()
    for add, sign in (("fadd", ""), ("fsub", ""), ("fadd", "-")):
        (tmp_path / "toy_inner.py").write_text(INTRINSIC.format(add=add, sign=sign))
        (tmp_path / "toy_outer.py").write_text(OUTER)
        outer = fresh(tmp_path, monkeypatch)
        made.add((meaning(outer.py_func), outer(2.0)))
    assert {value for _, value in made} == {5.0, 1.0, -3.0}
    assert len({key for key, _ in made}) == 3


EVERYTHING = """
import math
import numba as nb
import numpy as np

@nb.njit(nogil=True, cache=True)
def outer(x):
    if x.size < 2:
        raise ValueError("too short")
    made = np.empty((x.size, 2))
    for k in range(x.size):
        made[k, 0], made[k, 1] = np.sin(x[k]) ** 0.7, np.exp(x[k]) % 1.0 + x[k] ** 3
    total = 0.0
    for row in made[1::2].T.copy():
        total += row[0] * row[-1] + np.arctan2(row[1], math.gamma(row[2] + 1))
    return total + made.sum() + abs(x[0]) + min(1, x.size)
"""
LOADED = """
import importlib.util, os, sys
import numpy as np
import zonda.core.compilation.kernel_cache as cache
cache.install()
spec = importlib.util.spec_from_file_location("zonda.toy_outer", os.path.join(sys.argv[1], "toy_outer.py"))
module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
found = module.outer(np.linspace(0.1, 2.0, 50))
try:
    module.outer(np.ones(1))
except ValueError as err:
    print(repr(found), err, "numba.np.linalg" in sys.modules)
"""


def test_a_kept_kernel_is_loaded_without_the_compiler(tmp_path):
    (tmp_path / "toy_outer.py").write_text(EVERYTHING)
    command = [sys.executable, "-c", LOADED, str(tmp_path)]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True) for _ in range(2)
    )
    assert first.stdout.endswith("too short True\n"), first.stderr
    assert second.stdout == first.stdout.replace("True", "False"), second.stderr


def test_a_full_disk_is_no_error(folder, monkeypatch):
    def full(self, key, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(KernelFiles, "save", full)
    with pytest.warns(UserWarning, match="cannot be kept for the next run: No space left"):
        assert fresh(folder, monkeypatch)(2.0) == 7.0


def test_a_failed_save_leaves_nothing(tmp_path, monkeypatch):
    def fail(source, target):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="Input"):
        KernelFiles(str(tmp_path), "base", kept).save("key", 1)
    assert list(tmp_path.iterdir()) == []


def run(folder: Path, **environment: str) -> subprocess.Popen[str]:
    clean = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    return subprocess.Popen(
        [sys.executable, "-c", PROCESS, str(folder)],
        env={**clean, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_first_runs_at_once(tmp_path):
    """Same answers, no warning, a file for each kernel and type, however strings are hashed."""
    write(tmp_path)
    for expected in ("0", "2"):
        processes = [run(tmp_path, PYTHONHASHSEED=str(k)) for k in range(3)]
        for process in processes:
            out, err = process.communicate()
            assert (out.split()[:2], err) == (["7.0", "7.0"], "")
            if expected == "2":
                assert out.split()[2] == expected
    assert len(kept(tmp_path)) == 4


def test_another_processor_has_its_own_files(tmp_path):
    write(tmp_path)
    for number, processor in enumerate(("", "generic"), 1):
        out, err = run(
            tmp_path, **({"NUMBA_CPU_NAME": processor} if processor else {})
        ).communicate()
        assert (out.split(), err) == (["7.0", "7.0", "0"], "")
        assert len(kept(tmp_path)) == 4 * number


def test_beside_a_read_only_installation_the_user_keeps_it(tmp_path):
    program, caches = tmp_path / "program", tmp_path / "home"
    program.mkdir()
    write(program)
    (program / "__pycache__").touch()  # a file: no folder can be made, not even by root
    for expected in ("0", "2"):
        out, err = run(
            program, XDG_CACHE_HOME=str(caches), HOME=str(caches), PYTHONDONTWRITEBYTECODE="1"
        ).communicate()
        assert (out.split(), err) == (["7.0", "7.0", expected], "")
    assert kept(program) == []
    assert len(kept(caches)) == 4


CHANGED_NUMBA = """
import importlib.util, os, sys, warnings
import numba.core.caching as caching, numba.core.dispatcher as dispatcher
from numba.core import environment
{change}
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    from zonda.core.compilation import jit
    from zonda.core.numerics import random
    for name in ("toy_inner", "toy_outer"):
        spec = importlib.util.spec_from_file_location(f"zonda.{{name}}", f"{{sys.argv[1]}}/{{name}}.py")
        module = sys.modules[f"zonda.{{name}}"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    jit.share()
    print(module.outer(2.0), module.outer(2), len(told), *{{str(w.message).partition(" (")[0] for w in told}}, sep="|")
"""


@pytest.mark.parametrize(
    ("change", "own"),
    [
        ("del caching.CacheImpl._locator_classes", True),
        ("del caching.CompileResultCacheImpl", False),
        ("del caching.Cache._save_overload", False),
        (
            (
                "del dispatcher.FunctionCache; dispatcher.Dispatcher.enable_caching = lambda self:"
                " None"
            ),
            False,
        ),
    ],
)
def test_a_numba_with_another_inside_keeps_kernels_itself(tmp_path, change, own):
    """Whatever of its inside is gone: the numbers are right, and it is said once; never a
    traceback.
    """
    import numba

    if own and not hasattr(numba.config, "CACHE_LOCATOR_CLASSES"):
        pytest.skip("this numba has no other list of locators")
    write(tmp_path)
    first, second, count, *told = run_with_numba(
        tmp_path, change, "InTreeCacheLocator,UserWideCacheLocator" if own else ""
    )
    assert (first, second) == ("7.0", "7.0")
    assert bool(kept(tmp_path)) == own
    if own:
        assert count == "0"
    else:
        assert (count, told) == (
            "1",
            [f"zonda cannot keep compiled code itself with numba {numba.__version__}"],
        )


def test_a_numba_that_cannot_load_what_is_kept_says_so_once(tmp_path):
    """Not that the files are damaged: their hashes are right."""
    import numba

    write(tmp_path)
    assert run_with_numba(tmp_path, "")[2] == "0"
    assert len(kept(tmp_path)) >= 3
    first, second, count, *told = run_with_numba(
        tmp_path, "del caching.CompileResultCacheImpl.rebuild"
    )
    assert (first, second) == ("7.0", "7.0")
    assert (count, told) == (
        "1",
        [f"zonda cannot keep compiled code itself with numba {numba.__version__}"],
    )


def run_with_numba(folder, change, locators=""):
    """What `CHANGED_NUMBA` prints, in parts."""
    env = {**os.environ, "NUMBA_CACHE_LOCATOR_CLASSES": locators}
    env |= {
        "XDG_CACHE_HOME": str(folder / "caches"),
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    env.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-c", CHANGED_NUMBA.format(change=change), str(folder)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().split("|")


def test_meaning_covers_options_and_constants(folder, monkeypatch):
    outer = fresh(folder, monkeypatch)
    before = meaning(outer.py_func)
    assert meaning(outer.py_func) == before
    monkeypatch.setitem(outer.targetoptions, "fastmath", {"contract"})
    assert meaning(outer.py_func) != before


def test_kernels_of_others_stay_with_numba():
    def kernel(x):
        return x

    assert type(kernel_cache._cache_of(kernel)) is FunctionCache


def test_every_kernel_is_kept_this_way():
    for name in operators:
        operators.get(name)
    for name in ("zonda.operators.atmosphere.weather.era5", "zonda.core.numerics.celestial"):
        import_module(name)
    found = {
        id(value): value
        for module in [m for n, m in sys.modules.items() if n.startswith("zonda.")]
        for value in vars(module).values()
        if isinstance(value, Dispatcher) and value.py_func.__module__ in sys.modules
    }
    ours = [
        k
        for k in found.values()
        if k.py_func.__module__.startswith("zonda.") and "toy_" not in k.py_func.__module__
    ]
    assert len(ours) > 30
    assert [k for k in ours if not isinstance(k._cache, KernelCache)] == []


def test_kernels_that_others_call_say_how_they_round():
    """A kernel that does not state ``fastmath`` inherits it from whoever has it compiled first;
    numba keeps the result for all: bits would depend on the order of compilation."""
    kernels: dict[Any, Dispatcher] = {}
    for module in pkgutil.walk_packages(zonda.__path__, "zonda."):
        if module.name.startswith(("zonda.core", "zonda.operators")):
            for kernel in vars(import_module(module.name)).values():
                if isinstance(kernel, Dispatcher):
                    kernels[kernel.py_func] = kernel
    assert len(kernels) > 40
    silent = set()
    for function, kernel in kernels.items():
        if kernel.targetoptions.get("fastmath"):
            called = (function.__globals__.get(name) for name in function.__code__.co_names)
            silent |= {
                k.py_func.__qualname__
                for k in called
                if isinstance(k, Dispatcher) and "fastmath" not in k.targetoptions
            }
    assert not silent


def test_a_kernel_in_the_place_of_another_does_not_run(folder, monkeypatch):
    """A whole file of another kernel under this one's name: its content is right, its name is
    not.
    """
    assert fresh(folder, monkeypatch)(2.0) == 7.0
    (mine,) = kept(folder, "outer")
    write(folder, factor=5.0)
    assert fresh(folder, monkeypatch)(2.0) == 11.0
    (other,) = (path for path in kept(folder, "outer") if path != mine)
    mine.write_bytes(other.read_bytes())
    write(folder)
    again = fresh(folder, monkeypatch)
    with pytest.warns(UserWarning, match="was damaged; it is compiled again"):
        assert again(2.0) == 7.0


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="owners and modes are those of POSIX")
def test_a_kernel_that_others_may_write_to_does_not_run(folder, monkeypatch, tmp_path):
    monkeypatch.setenv("ZONDA_CACHE_DIR", str(tmp_path / "mine"))
    assert fresh(folder, monkeypatch)(2.0) == 7.0
    (path,) = kept(folder, "outer")
    path.chmod(0o666)
    again = fresh(folder, monkeypatch)
    with pytest.warns(UserWarning, match="is not taken from .*it may be written to by others"):
        assert (again(2.0), hits(again)) == (7.0, 0)
    assert path.stat().st_mode & 0o777 == 0o644  # made anew
    path.parent.chmod(0o777)
    elsewhere = fresh(folder, monkeypatch)
    assert (elsewhere(2.0), hits(elsewhere)) == (7.0, 0)
    assert kept(tmp_path / "mine", "outer")
    assert (tmp_path / "mine/kernels").stat().st_mode & 0o777 == 0o700
    third = fresh(folder, monkeypatch)
    assert (third(2.0), hits(third)) == (7.0, 1)
