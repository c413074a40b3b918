"""What the fuzzers found stays mended, and files damaged at random places are read right or refused
with a clean error.
"""

from __future__ import annotations

import contextlib
import importlib.util
import random
import subprocess
import sys
import warnings
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

HERE = Path(__file__).parent
FUZZERS = ("yaml", "fits", "hdf5", "text")
CORPUS = sorted(p for name in FUZZERS for p in (HERE / "corpus" / name).glob("*"))


@cache
def fuzzer(name: str) -> ModuleType:
    sys.path.insert(0, str(HERE))
    try:
        spec = importlib.util.spec_from_file_location(f"fuzz_{name}", HERE / f"fuzz_{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(HERE))
    return module


@cache
def whole(name: str) -> list[bytes]:
    return list(fuzzer(name).seeds())


@pytest.fixture(autouse=True)
def _limits(monkeypatch: pytest.MonkeyPatch) -> None:
    from zonda.core import machine

    monkeypatch.setattr(machine, "available_memory", lambda: 256 << 20)


def read(name: str, data: bytes) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fuzzer(name).target(data)


@pytest.mark.parametrize("path", CORPUS, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_what_was_found(path: Path) -> None:
    read(path.parent.name, path.read_bytes())


@pytest.mark.parametrize("name", FUZZERS)
def test_whole_inputs(name: str) -> None:
    for data in whole(name):
        read(name, data)


def damaged(data: bytes, seed: int, how: str) -> bytes:
    """``data`` with some of it changed; the first byte, which may name the reader, stays."""
    rng, made = random.Random(seed), bytearray(data)
    at = rng.randrange(1, len(made))
    if how == "cut":
        del made[at:]
    elif how == "lost":
        del made[at : at + rng.choice((1, 80, 512, 2880))]
    elif how == "zeros":
        made[at : at + 512] = bytes(len(made[at : at + 512]))
    else:
        for _ in range(rng.choice((1, 3, 30))):
            made[rng.randrange(1, len(made))] = (
                rng.randrange(256) if how == "bytes" else rng.choice(b"0123456789-'.ETN")
            )
    return bytes(made)


def many(examples: int) -> settings:
    return settings(
        max_examples=examples,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


HOW = ["cut", "lost", "zeros", "bytes", "digits"]


def damage(name: str, seed: int, how: str) -> None:
    """Read a damaged input: of HDF5 those of NetCDF 3, since libhdf5 may crash or hang."""
    every = [d for d in whole(name) if name != "hdf5" or d[1:4] == b"CDF"]
    read(name, damaged(every[seed % len(every)], seed, how))


@pytest.mark.parametrize("name", FUZZERS)
@many(150)
@given(seed=st.integers(0, 2**32), how=st.sampled_from(HOW))
def test_damage_at_random_places(name: str, seed: int, how: str) -> None:
    damage(name, seed, how)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["fits", "hdf5", "text"])
@many(10_000)
@given(seed=st.integers(0, 2**32), how=st.sampled_from(HOW))
def test_damage_at_many_places(name: str, seed: int, how: str) -> None:
    damage(name, seed, how)


CHILD = """
import sys
sys.path.insert(0, sys.argv[1])
import test_corpus
every = [d for d in test_corpus.whole("hdf5") if d[1:4] != b"CDF"]
for seed in range(int(sys.argv[2]), int(sys.argv[2]) + 20):
    how = test_corpus.HOW[seed % 5]
    test_corpus.read("hdf5", test_corpus.damaged(every[seed // 5 % len(every)], seed, how))
"""


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(0, 400, 20))
def test_damaged_hdf5_files(seed: int) -> None:
    """Each is read or refused. libhdf5 may crash or hang (docs/reliability.md): the process ends by
    a signal, and is no failure."""
    command = [sys.executable, "-c", CHILD, str(HERE), str(seed)]
    with contextlib.suppress(subprocess.TimeoutExpired):
        made = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert made.returncode <= 0, made.stderr


@pytest.mark.parametrize("name", FUZZERS)
@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\0",
        b"\1",
        b"\xff" * 5000,
        b"SIMPLE  =",
        b"\x89HDF\r\n\x1a\n",
        b"CDF\1",
        b"PK\3\4",
        b"\x1f\x8b\x08",
    ],
)
def test_stumps(name: str, data: bytes) -> None:
    for first in (b"", b"\0", b"\1", *(bytes([letter]) for letter in b"TPCDRSMNF")):
        read(name, first + data)
