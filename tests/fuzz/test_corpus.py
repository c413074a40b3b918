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

from zonda.core import cli

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
@many(2_000)
@given(seed=st.integers(0, 2**32), how=st.sampled_from(HOW))
def test_damage_at_many_places(name: str, seed: int, how: str) -> None:
    damage(name, seed, how)


MAP = """\
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
operators:
  - PointingDaisy: {scan_duration: 0.2 s}
  - SkyMap: {file: damaged.fits}
  - BinMap: {pixel: 20 arcsec}
  - SaveMap
"""


def flipped(data: bytes, seed: int) -> bytes:
    """``data`` with a bit or some turned over, mostly of values of cards."""
    rng, made = random.Random(seed), bytearray(data)
    cards = [at for at in range(0, len(data), 80) if data[at + 8 : at + 10] == b"= "]
    for _ in range(rng.choice((1, 1, 2, 8))):
        known = rng.random() < 0.8
        at = rng.choice(cards) + rng.randrange(10, 32) if known else rng.randrange(len(made))
        made[at] ^= 1 << rng.randrange(rng.choice((4, 8)))
    return bytes(made)


def flip(seed: int) -> int:
    """Compare a map with its damaged copy, and observe it: done, or a user's mistake (2)."""
    every = whole("fits")[:3] + whole("fits")[5:6]
    data = every[seed % len(every)]
    Path("whole.fits").write_bytes(data)
    Path("damaged.fits").write_bytes(flipped(data, seed))
    Path("p.yaml").write_text(MAP)
    assert cli.main(["compare", "whole.fits", "damaged.fits", "--output", "out"]) in (0, 2)
    status = cli.main(["run", "p.yaml", "--output", "run"])
    assert status in (0, 2)
    return status


def test_flipped_bits_of_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert {flip(seed) for seed in range(106, 110)} == {0, 2}


@pytest.mark.nightly
def test_many_flipped_bits_of_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for seed in range(200, 600):
        flip(seed)


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
