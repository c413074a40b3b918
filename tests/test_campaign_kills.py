"""Campaigns that are killed: what is resumed has the bits of an undisturbed run, and no file is
half-written at any moment.

SIGKILL gives a process no chance to clean up. The processes are forked from one that has imported
everything, so that twenty kills take seconds; those of the process pool start as they do for a
user.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import lru_cache
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zonda.core.campaign import trees
from zonda.core.campaign.campaign_file import FILE, TASKS, Job
from zonda.core.configuration.pipeline_file import load

from .scenes import camera, write_sky

pytestmark = pytest.mark.skipif(
    not hasattr(os, "fork"), reason="processes are forked and killed as POSIX does"
)

CAMPAIGN = f"""\
{camera(7)}budget: 0 %
campaign: {{nights: 4, realizations: 2}}
operators:
  - PointingDaisy: {{radius: 1 arcmin, speed: 50 arcsec/s, scan_duration: 20 s}}
  - SkyMap: {{file: sky.fits}}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - SaveTOD: {{format: fits}}
  - MaximumLikelihoodMap: {{pixel: 4 arcsec, product: deep}}
  - HighpassFilter
  - BinMap: {{pixel: 4 arcsec}}
  - SaveMap
"""
TASKS_IN_ALL = 8
KILLS_OF_THE_MAIN_PROCESS, KILLS_OF_WORKERS = 16, 4
ROUNDS = 20
"""Most campaigns that are begun anew because a signal came too late."""

NURSERY = """
import json, os, sys, time
import h5py, healpy, numba, scipy.ndimage, astropy.io.fits, astropy.wcs, zonda
from zonda.core import cli
from zonda.core.campaign import command, run
if sys.argv[1:]:
    said = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    assert cli.main(sys.argv[1:]) == 0
    sys.stdout.flush()
    os.dup2(said, 1)
for line in sys.stdin:
    order = json.loads(line)
    pid = os.fork()
    if pid:
        print(pid, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
        continue
    sys.stdin.close()
    os.dup2(os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    os.dup2(2, 1)
    if order["clock"] == "backwards":
        now = [4e9]
        def backwards():
            now[0] -= 3600.0
            return now[0]
        time.time, time.time_ns = backwards, lambda: int(backwards() * 1e9)
    status = cli.main(order["arguments"])
    sys.stdout.flush()
    os._exit(status)
"""


class Nursery:
    """Commands of zonda, one at a time, each in a fresh fork of a process that has imported
    everything.

    ``first``: a command that it runs itself, before, so that its forks find everything compiled and
    loaded.
    """

    def __init__(self, folder: Path, *first: str) -> None:
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        pipes: dict[str, Any] = {
            "stdin": subprocess.PIPE,
            "stdout": subprocess.PIPE,
            "text": True,
            "bufsize": 1,
        }
        self.process = subprocess.Popen(
            [sys.executable, "-c", NURSERY, *first], env=environment, cwd=folder, **pipes
        )
        self.log = folder / "log"

    def begin(self, *arguments: str, clock: str = "") -> int:
        """Start a command; its process number."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(
            json.dumps({"arguments": arguments, "log": str(self.log), "clock": clock}) + "\n"
        )
        return int(self.process.stdout.readline())

    def end(self) -> tuple[int, str]:
        """Wait for it: exit status (negative: a signal) and what it said."""
        assert self.process.stdout is not None
        status = int(self.process.stdout.readline())
        return status, self.log.read_text()

    def run(self, *arguments: str, clock: str = "") -> tuple[int, str]:
        """Start and wait."""
        self.begin(*arguments, clock=clock)
        return self.end()

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("campaign")
    write_sky(folder / "sky.fits", 21, 0.004, 1e-3)
    (folder / "c.yaml").write_text(CAMPAIGN)
    return folder


@pytest.fixture(scope="module")
def nursery(place: Path) -> Iterator[Nursery]:
    made = Nursery(
        place, "run", "c.yaml", "--output", "first", "--engine", "serial", "--threads", "1"
    )
    yield made
    made.close()


@pytest.fixture(scope="module")
def whole_run(place: Path, nursery: Nursery) -> tuple[dict[str, list[np.ndarray]], float]:
    """Products of an undisturbed campaign, and how long it takes."""
    begin = time.monotonic()
    status, said = nursery.run(
        "run", "c.yaml", "--output", "undisturbed", "--engine", "serial", "--threads", "1"
    )
    assert status == 0, said
    found = products(place / "undisturbed")
    assert len([name for name in found if Path(name).name.startswith("tod")]) == TASKS_IN_ALL
    assert {"map.fits", "deep.fits", "noise_model_deep.ecsv"} <= found.keys()
    return found, time.monotonic() - begin


@lru_cache(None)
def numbers(path: Path, stamp: tuple[int, ...]) -> list[np.ndarray]:
    """All numbers of a map, a scan or a table; raises where the file is not whole. ``stamp``: says
    when it is another one.
    """
    from astropy.io import fits
    from astropy.table import Table

    if path.suffix == ".ecsv":
        table = Table.read(path, format="ascii.ecsv")
        return [np.array(table[name]) for name in table.colnames]
    found: list[np.ndarray] = []
    with fits.open(path, memmap=False) as hdus:
        for hdu in hdus:
            hdu.verify("exception")
            if hdu.data is not None and hdu.name not in ("PROVENANCE", "TALLY", "PLAN"):
                found += (
                    [np.array(hdu.data)]
                    if hdu.is_image
                    else [np.array(hdu.data.field(k)) for k in range(len(hdu.columns))]
                )
    assert path.stat().st_size % 2880 == 0
    return found


def products(folder: Path) -> dict[str, list[np.ndarray]]:
    """Numbers in all finished maps, scans and tables, by file name."""
    paths = [
        p
        for p in sorted(folder.rglob("*"))
        if p.suffix in (".fits", ".ecsv") and not p.name.startswith(".")
    ]
    stamps = [(s.st_ino, s.st_mtime_ns, s.st_size) for s in (p.stat() for p in paths)]
    return {
        p.relative_to(folder).as_posix(): numbers(p, stamp)
        for p, stamp in zip(paths, stamps, strict=True)
    }


def same(one: dict[str, list[np.ndarray]], other: dict[str, list[np.ndarray]]) -> bool:
    """Identical bits, NaN included."""
    assert one.keys() == other.keys()
    for name, arrays in one.items():
        assert [a.tobytes() for a in arrays] == [b.tobytes() for b in other[name]], name
    return True


def check_whole(folder: Path) -> None:
    """Every file that bears its final name is whole, now."""
    if not folder.exists():
        return
    products(folder)  # raises where one does not read
    job = Job.read(folder) if (folder / FILE).exists() else None
    keys = {task.product: task.key for task in job.tasks} if job else {}
    for path in folder.rglob("*"):
        if path.name.startswith(".") or path.suffix in (".fits", ".ecsv") or not path.is_file():
            continue  # hidden names are temporary files and the lock
        if path.parent.name == TASKS:
            if path.name in keys or path.name.startswith("layout"):
                trees.read(path, keys.get(path.name, "layout"))
            else:
                json.loads(path.read_text())
        elif path.name.endswith(".yaml"):
            load(path)
        elif path.name == "tasks.npz":
            with np.load(path) as archive:
                assert archive.files
        else:
            assert path.name in (FILE, "zonda-files.jsonl"), path


def forward(place: Path, name: str) -> list[str]:
    """The command that goes on with what is there."""
    if (place / name / FILE).exists():
        return ["resume", name, "--engine", "serial"]
    return ["run", "c.yaml", "--output", name, "--engine", "serial", "--threads", "1"]


def done(place: Path, name: str) -> int:
    """Number of partial products."""
    return len(list((place / name / TASKS).glob("[0-9]*.npz")))


def killed(
    place: Path, nursery: Nursery, name: str, moments: random.Random, *arguments: str
) -> bool:
    """Begin or resume, or what ``arguments`` say, and kill at a random moment: after some more
    tasks and a while.

    Whether that came in time.
    """
    before, more, pause = done(place, name), moments.randrange(4), moments.uniform(0, 0.05)
    pid = nursery.begin(*(arguments or forward(place, name)))
    ended = select.poll()
    assert nursery.process.stdout is not None
    ended.register(nursery.process.stdout, select.POLLIN)
    while done(place, name) < before + more and not ended.poll(2):
        pass
    time.sleep(pause)
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    status, said = nursery.end()
    assert status in (0, -signal.SIGKILL), said
    check_whole(place / name)
    return status != 0


def partly(place: Path, nursery: Nursery, name: str) -> None:
    """A campaign that was killed when some of its tasks, not all, were done."""
    for _ in range(ROUNDS):
        pid = nursery.begin(*forward(place, name))
        while len(list((place / name / TASKS).glob("[0-9]*.npz"))) < 4:
            time.sleep(0.002)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        status, said = nursery.end()
        if status:
            break
        shutil.rmtree(place / name)  # it was quicker
    assert status == -signal.SIGKILL, said
    check_whole(place / name)
    assert 4 <= len(list((place / name / TASKS).glob("[0-9]*.npz"))) < TASKS_IN_ALL


def finish(place: Path, nursery: Nursery, name: str, **options: str) -> str:
    status, said = nursery.run(*forward(place, name), **options)
    assert status == 0, said
    check_whole(place / name)
    assert not [p for p in (place / name).rglob(".*") if p.is_file()], "something is left behind"
    return said


def test_the_main_process_killed_at_random_moments(
    place: Path, nursery: Nursery, whole_run: Any
) -> None:
    expected = whole_run[0]
    moments, kills, rounds = random.Random(20241121), 0, 0
    while kills < KILLS_OF_THE_MAIN_PROCESS:
        rounds += 1
        name = f"killed-{rounds}"
        while kills < KILLS_OF_THE_MAIN_PROCESS:
            if not killed(place, nursery, name, moments):
                break  # it was quicker
            kills += 1
        if not (place / name / "map.fits").exists() or (place / name / TASKS).exists():
            finish(place, nursery, name)
        assert same(products(place / name), expected)
        shutil.rmtree(place / name)


def workers_of(pid: int) -> list[int]:
    """Worker processes of a pool, by Linux's table of processes (the pool's helper is no
    worker).
    """
    found = []
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        command = Path(f"/proc/{child}/cmdline").read_bytes()
        if b"spawn_main" in command:
            found.append(int(child))
    return found


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the workers in /proc")
def test_workers_killed_at_random_moments(place: Path, nursery: Nursery, whole_run: Any) -> None:
    """The campaign goes on without them; where they die too often it says so, and resumes, with
    another number of workers.
    """
    expected, _ = whole_run
    moments, kills, name = random.Random(7), 0, "workers"
    numbers_of_workers = cycle((3, 4, 1, 2))
    while kills < KILLS_OF_WORKERS or not (place / name / "map.fits").exists():
        more = ["--engine", "processes", "--workers", str(next(numbers_of_workers))]
        arguments = (
            ["resume", name]
            if (place / name / FILE).exists()
            else ["run", "c.yaml", "--output", name, "--threads", "1"]
        )
        pid = nursery.begin(*arguments, *more)
        while kills < KILLS_OF_WORKERS and Path(f"/proc/{pid}").exists():
            before = len(list((place / name / TASKS).glob("[0-9]*.npz")))
            while (
                Path(f"/proc/{pid}/task").exists()
                and len(list((place / name / TASKS).glob("[0-9]*.npz"))) == before
            ):
                time.sleep(0.01)
                if "Z" in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2][:3]:
                    break
            time.sleep(moments.uniform(0, 0.1))
            try:
                victims = workers_of(pid)
            except FileNotFoundError:
                break
            if not victims:
                break
            os.kill(moments.choice(victims), signal.SIGKILL)
            kills += 1
            check_whole(place / name)
        status, said = nursery.end()
        assert status in (0, 2), said
        assert "Traceback" not in said
        check_whole(place / name)
        if status == 0 and kills < KILLS_OF_WORKERS:
            assert same(products(place / name), expected)
            shutil.rmtree(place / name)
    assert same(products(place / name), expected)


@pytest.mark.parametrize("damage", ["bytes", "another's"])
def test_a_damaged_partial_product(
    place: Path, nursery: Nursery, whole_run: Any, damage: str
) -> None:
    name = f"part-{damage[:3]}"
    partly(place, nursery, name)
    path, other = sorted((place / name / TASKS).glob("[0-9]*.npz"))[:2]
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    if damage == "missing":
        path.unlink()
    elif damage == "another's":
        shutil.copy(other, path)
    else:
        spoilt = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
        path.write_bytes({"cut": content[:middle], "empty": b"", "bytes": spoilt}[damage])
    said = finish(place, nursery, name)
    assert "1 partial product damaged: run again" in said
    assert same(products(place / name), whole_run[0])


def test_an_input_removed_before_it_is_resumed(
    place: Path, nursery: Nursery, whole_run: Any
) -> None:
    name = "input"
    partly(place, nursery, name)
    os.rename(place / "sky.fits", place / "away.fits")
    try:
        status, said = nursery.run("resume", name, "--engine", "serial")
        assert status == 2
        assert "sky.fits" in said
        assert "Traceback" not in said
    finally:
        os.rename(place / "away.fits", place / "sky.fits")
    finish(place, nursery, name)
    assert same(products(place / name), whole_run[0])


def test_a_clock_that_jumps_before_it_is_resumed(
    place: Path, nursery: Nursery, whole_run: Any
) -> None:
    partly(place, nursery, "clock")
    finish(place, nursery, "clock", clock="backwards")
    assert same(products(place / "clock"), whole_run[0])


def test_two_main_processes_at_once(place: Path, nursery: Nursery, whole_run: Any) -> None:
    """The second is refused and changes nothing, even while the first stands still; when that is
    killed, the folder is free.
    """
    name = "two"
    pid = nursery.begin(*forward(place, name))
    while len(list((place / name / TASKS).glob("[0-9]*.npz"))) < 2:
        time.sleep(0.002)
    os.kill(pid, signal.SIGSTOP)
    second = Nursery(place)
    second.log = place / "log-2"
    try:
        before = {p: p.stat().st_mtime_ns for p in (place / name).rglob("*") if p.is_file()}
        for arguments in (["resume", name], ["run", "c.yaml", "--output", name]):
            status, said = second.run(*arguments, "--engine", "serial")
            assert status == 2
            assert "is writing to this folder" in said
        assert before == {p: p.stat().st_mtime_ns for p in (place / name).rglob("*") if p.is_file()}
    finally:
        os.kill(pid, signal.SIGKILL)
        second.close()
    nursery.end()
    finish(place, nursery, name)
    assert same(products(place / name), whole_run[0])


def test_sigterm_ends_a_campaign_cleanly(place: Path, nursery: Nursery, whole_run: Any) -> None:
    name = "term"
    for _ in range(ROUNDS):
        pid = nursery.begin(*forward(place, name))
        while len(list((place / name / TASKS).glob("[0-9]*.npz"))) < 2:
            time.sleep(0.002)
        os.kill(pid, signal.SIGTERM)
        status, said = nursery.end()
        if status:
            break
        shutil.rmtree(place / name)  # it was quicker
    assert status == 143, said
    assert not [p for p in (place / name).rglob(".*") if p.is_file()], (
        "a lock or a temporary file is left"
    )
    finish(place, nursery, name)
    assert same(products(place / name), whole_run[0])
