"""What the fuzzers share: coverage-guided mutation by atheris (libFuzzer), findings kept, each kind
told once.

    pip install atheris
    python tests/fuzz/fuzz_yaml.py --seconds 600

Every finding is written to ``--artifacts`` and the run goes on; exit status 1 when there was one.
Inputs that take longer than 20 s or more than 2 GB stop the run (libFuzzer writes them to the same
folder). ``tests/fuzz/corpus`` holds what was found interesting or wrong;
`tests/fuzz/test_corpus.py` replays it.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
CORPUS = Path(__file__).parent / "corpus"
SECONDS_EACH, MEGABYTES = 20, 2048

Target = Callable[[bytes], None]
"""Reads one input; whatever it raises is a finding: a clean error is caught inside."""


def guided_by(*modules: str) -> contextlib.AbstractContextManager[Any]:
    """Around the imports of what is fuzzed: coverage of these modules guides the search, where a
    fuzzer runs.
    """
    if "--seconds" not in sys.argv:  # a replay
        return contextlib.nullcontext()
    import atheris

    return atheris.instrument_imports(include=list(modules))  # type: ignore[no-any-return]


def little_memory() -> None:
    """Let readers believe that 256 MB are free: what would ask for more is refused, and libFuzzer's
    own limit is a finding.
    """
    from zonda.core import machine

    machine.available_memory = lambda: 256 << 20  # type: ignore[assignment]


def told(error: Exception) -> None:
    """A clean error says something."""
    assert str(error).strip(), f"{type(error).__name__} without a message"


def scratch(suffix: str) -> Path:
    """A file of this process's own, in memory where the system has a folder for it."""
    folder = "/dev/shm" if os.path.isdir("/dev/shm") else None
    made = Path(tempfile.mkdtemp(prefix="zonda-fuzz-", dir=folder))
    import atexit
    import shutil

    atexit.register(shutil.rmtree, made, True)
    return made / f"input{suffix}"


def fuzz(
    name: str,
    target: Target,
    seeds: Callable[[], Iterable[bytes]],
    mutate: Callable[[bytes, int, int], bytes] | None = None,
    longest: int = 4096,
    words: Iterable[str] = (),
) -> None:
    """The command line of a fuzzer. ``seeds``: whole inputs to begin with; ``words``: what is put
    in here and there.
    """
    options = argparse.ArgumentParser(description=f"Fuzz {name}.")
    options.add_argument("--seconds", type=int, required=True)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument(
        "--work",
        type=Path,
        default=Path(tempfile.gettempdir()) / f"zonda-fuzz-{name}",
        help="growing corpus",
    )
    options.add_argument(
        "--artifacts",
        type=Path,
        default=None,
        help="folder for findings [default: beside the corpus]",
    )
    given = options.parse_args()
    try:
        import atheris
    except ImportError:
        sys.exit("fuzzing needs atheris: pip install atheris")
    little_memory()
    given.work.mkdir(parents=True, exist_ok=True)
    artifacts = given.artifacts or given.work.with_name(given.work.name + "-found")
    artifacts.mkdir(parents=True, exist_ok=True)
    for seed in seeds():
        (given.work / hashlib.sha1(seed).hexdigest()).write_bytes(seed)
    dictionary = given.work.with_name(given.work.name + "-words")
    words = list(words)
    escaped = ("".join(f"\\x{byte:02x}" for byte in word.encode()) for word in words)
    dictionary.write_text("".join(f'"{word}"\n' for word in escaped))
    told: set[tuple[Any, ...]] = set()
    count, began = 0, time.monotonic()

    def one(data: bytes) -> None:
        nonlocal count
        count += 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                target(data)
        except Exception as err:
            frames = [
                (f.filename, f.lineno)
                for f in traceback.extract_tb(err.__traceback__)
                if "zonda" in f.filename or "core" in f.filename
            ]
            kind = (type(err), *frames[-2:])
            if kind not in told:
                told.add(kind)
                path = artifacts / f"{type(err).__name__}-{hashlib.sha1(data).hexdigest()[:12]}"
                path.write_bytes(data)
                print(
                    f"\nFOUND {path}: {type(err).__name__}: {err}"[:600],
                    *frames[-3:],
                    sep="\n  ",
                    flush=True,
                )
        if time.monotonic() - began > given.seconds:
            print(
                f"\n{name}: {count} inputs in {time.monotonic() - began:.0f} s, {len(told)} kinds"
                " of findings",
                flush=True,
            )
            os._exit(1 if told else 0)

    for found in (CORPUS / name).glob("*"):
        if not found.name.startswith("hang"):  # what a library hangs on would end the run at once
            shutil.copy(found, given.work)
    arguments = [
        sys.argv[0],
        str(given.work),
        f"-seed={given.seed}",
        f"-timeout={SECONDS_EACH}",
        f"-rss_limit_mb={MEGABYTES}",
        f"-max_len={longest}",
        f"-artifact_prefix={artifacts}/",
        *([f"-dict={dictionary}"] if words else []),
        "-verbosity=0",
        "-print_final_stats=0",
    ]
    extra = {"custom_mutator": mutate} if mutate is not None else {}
    atheris.Setup(arguments, one, **extra)
    atheris.Fuzz()
