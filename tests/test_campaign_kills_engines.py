"""As `test_campaign_kills`, of processes that are not forks: Dask's workers, MPI's, the jobs of an
array.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from zonda.core.campaign.campaign_file import FILE

from .test_campaign_kills import (
    ROUNDS,
    TASKS_IN_ALL,
    Nursery,
    check_whole,
    done,
    finish,
    forward,
    killed,
    nursery,
    place,
    products,
    same,
    whole_run,
)

__all__ = ["nursery", "place", "whole_run"]

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds processes in /proc"),
]


def wait_for(condition: Callable[[], bool], alive: Callable[[], bool]) -> None:
    while not condition() and alive():
        time.sleep(0.002)


# ---- Dask


@pytest.fixture(scope="module")
def cluster(place: Path) -> Iterator[Any]:
    distributed = pytest.importorskip(
        "distributed", reason="distributed is not installed: pip install 'zonda[dask]'"
    )
    options = {
        "n_workers": 2,
        "threads_per_worker": 1,
        "processes": True,
        "dashboard_address": None,
        "host": "127.0.0.1",
    }
    with distributed.LocalCluster(**options) as made, distributed.Client(made) as client:
        client.run(lambda: __import__("zonda.core.campaign.tasks") and None)
        yield made


def test_a_dask_worker_killed(place: Path, nursery: Nursery, whole_run: Any, cluster: Any) -> None:
    """Another worker does its task; its nanny starts it again."""
    moments, kills, name = random.Random(3), 0, "dask-worker"
    for _ in range(ROUNDS):
        pid = nursery.begin(
            "run", "c.yaml", "--output", name, "--scheduler", cluster.scheduler_address
        )
        wait_for(lambda: done(place, name) > 0, Path(f"/proc/{pid}/exe").exists)
        time.sleep(moments.uniform(0, 0.05))
        worker = moments.choice(list(cluster.workers.values())).pid
        alive = 0 < done(place, name) < TASKS_IN_ALL
        if worker:
            os.kill(worker, signal.SIGKILL)
            check_whole(place / name)
            kills += alive
        status, said = nursery.end()
        assert status == 0, said
        assert same(products(place / name), whole_run[0])
        shutil.rmtree(place / name)
        if kills == 2:
            return
    pytest.fail("no worker could be killed in time")


def test_the_main_process_of_a_dask_campaign_killed(
    place: Path, nursery: Nursery, whole_run: Any, cluster: Any
) -> None:
    moments, more, kills = random.Random(4), ["--scheduler", cluster.scheduler_address], 0
    for number in range(ROUNDS):
        name = f"dask-main-{number}"
        while kills < 3 and killed(place, nursery, name, moments, *_forward(place, name), *more):
            kills += 1
        if not (place / name / "map.fits").exists():
            status, said = nursery.run(*_forward(place, name), *more)
            assert status == 0, said
        check_whole(place / name)
        assert same(products(place / name), whole_run[0])
        if kills == 3:
            return
    pytest.fail("the main process could not be killed in time")


def test_the_dask_scheduler_killed(place: Path, nursery: Nursery, whole_run: Any) -> None:
    """The campaign ends with one clean error, and goes on elsewhere."""
    pytest.importorskip(
        "distributed", reason="distributed is not installed: pip install 'zonda[dask]'"
    )
    name, at = "dask-scheduler", place / "scheduler.json"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    options: dict[str, Any] = {
        "cwd": place,
        "env": environment,
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
    }
    dask = [
        sys.executable,
        "-m",
        "distributed.cli.dask_{}",
        "--scheduler-file",
        str(at),
        "--no-dashboard",
        "--host",
        "127.0.0.1",
    ]
    scheduler = subprocess.Popen([*(a.format("scheduler") for a in dask), "--port", "0"], **options)
    worker = subprocess.Popen(
        [*(a.format("worker") for a in dask), "--no-nanny", "--nthreads", "1"], **options
    )
    try:
        wait_for(at.exists, lambda: scheduler.poll() is None)
        pid = nursery.begin("run", "c.yaml", "--output", name, "--scheduler", str(at))
        wait_for(lambda: done(place, name) > 0, Path(f"/proc/{pid}/exe").exists)
        scheduler.kill()
        status, said = nursery.end()
    finally:
        for process in (worker, scheduler):
            process.kill()
            process.wait()
    check_whole(place / name)
    if status:  # it was not quicker
        assert status == 2, said
        error, cure = said.splitlines()[-2:]
        assert error.startswith(f"error: {name}: the engine "), (
            said
        )  # it is gone, or failed when it combined
        assert cure == f"  = zonda resume {name}", said
        assert "Traceback" not in said
        finish(place, nursery, name)
    assert same(products(place / name), whole_run[0])


def _forward(place: Path, name: str) -> list[str]:
    """As `forward`, leaving the engine open."""
    return (
        ["resume", name] if (place / name / FILE).exists() else ["run", "c.yaml", "--output", name]
    )


# ---- MPI


def ranks_of(pid: int) -> dict[int, int]:
    """Process numbers of MPI's processes below mpiexec, by rank."""
    found, below = {}, [pid]
    while below:
        parent = below.pop()
        with contextlib.suppress(OSError):
            below += map(int, Path(f"/proc/{parent}/task/{parent}/children").read_text().split())
            variables = Path(f"/proc/{parent}/environ").read_bytes().split(b"\0")
            if Path(f"/proc/{parent}/cmdline").read_bytes().startswith(sys.executable.encode()):
                found |= {
                    int(v.partition(b"=")[2]): parent
                    for v in variables
                    if v.startswith(b"PMI_RANK=")
                }
    return found


@pytest.mark.parametrize("victim", [0, 1])
def test_an_mpi_process_killed(place: Path, nursery: Nursery, whole_run: Any, victim: int) -> None:
    """That ends all of them; the next job goes on."""
    pytest.importorskip("mpi4py", reason="mpi4py is not installed: pip install 'zonda[mpi]'")
    beside = Path(sys.executable).with_name("mpiexec")
    mpiexec = str(beside) if beside.exists() else shutil.which("mpiexec")
    if mpiexec is None:
        pytest.skip("there is no mpiexec: pip install mpich")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    moments = random.Random(victim)

    def begin(*arguments: str) -> subprocess.Popen[str]:
        command = [
            mpiexec,
            "-n",
            "2",
            sys.executable,
            "-m",
            "zonda",
            *arguments,
            "--engine",
            "mpi",
        ]
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, cwd=place, env=environment, text=True, **pipes)  # type: ignore[call-overload,no-any-return]

    for number in range(ROUNDS):
        name = f"mpi-{victim}-{number}"
        process = begin("run", "c.yaml", "--output", name)
        wait_for(
            lambda name=name: done(place, name) > 0, lambda process=process: process.poll() is None
        )  # type: ignore[misc]
        time.sleep(moments.uniform(0, 0.02))
        victims = ranks_of(process.pid)
        if victim in victims:
            os.kill(victims[victim], signal.SIGKILL)
        assert process.stderr is not None
        said = process.stderr.read()
        late = process.wait() == 0 or not done(place, name)
        assert "Traceback" not in said
        check_whole(place / name)
        if not late:
            break
    assert not late, "no process could be killed in time"
    if victim:
        process = begin("resume", name)
        _, said = process.communicate()
        assert process.returncode == 0, said
    else:
        finish(place, nursery, name)
    assert same(products(place / name), whole_run[0])


# ---- job arrays


def test_a_job_of_an_array_killed(place: Path, nursery: Nursery, whole_run: Any) -> None:
    """Submitted again or not: `zonda resume` runs what is missing and combines."""
    moments, kills, name, number = random.Random(5), 0, "array", 0
    while kills < 6 and number < ROUNDS:
        number += 1
        share = [
            "run",
            "c.yaml",
            "--output",
            name,
            "--engine",
            "serial",
            "--threads",
            "1",
            "--task",
            f"{1 + kills % 2}/2",
        ]
        kills += killed(place, nursery, name, moments, *share)
        if kills == 3:  # once in between
            assert nursery.run("status", name)[0] == (0 if (place / name / FILE).exists() else 2)
        if done(place, name) == TASKS_IN_ALL or kills == 5:
            while not (place / name / FILE).exists():  # killed before it was worked out
                assert nursery.run(*share)[0] == 0
            finish(place, nursery, name)
            assert same(products(place / name), whole_run[0])
            shutil.rmtree(place / name)
    assert kills == 6
    status, said = nursery.run(
        "run", "c.yaml", "--output", name, "--engine", "serial", "--threads", "1", "--task", "2/2"
    )
    assert status == 0, said
    assert forward(place, name)[0] == "resume"
    finish(place, nursery, name)
    assert same(products(place / name), whole_run[0])
    assert (place / name / "tasks.npz").exists()
