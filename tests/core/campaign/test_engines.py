"""A real Dask cluster and real MPI processes give the bits of a run in series."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from zonda.core.campaign.engines import engine
from zonda.core.errors import PipelineError


def test_dask_cluster_of_two_workers(undisturbed, bench):
    distributed = pytest.importorskip("distributed", reason="distributed is not installed: pip install 'zonda[dask]'")
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None, "host": "127.0.0.1"}
    with distributed.LocalCluster(**options) as cluster:
        out = bench.run(bench.CAMPAIGN, "--scheduler", cluster.scheduler_address)
    assert bench.planes(out) == bench.planes(undisturbed)


def test_mpi_with_two_processes(undisturbed, bench):
    pytest.importorskip("mpi4py", reason="mpi4py is not installed: pip install 'zonda[mpi]'")
    beside = Path(sys.executable).with_name("mpiexec")
    mpiexec = str(beside) if beside.exists() else shutil.which("mpiexec")
    if mpiexec is None:
        pytest.skip("there is no mpiexec: pip install mpich")
    out = bench.new()
    arguments = ["run", str(bench.file(bench.CAMPAIGN)), "--engine", "mpi", "--output", str(out)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [mpiexec, "-n", "2", sys.executable, "-m", "zonda.core.cli", *arguments], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{out}/\n"
    assert bench.planes(out) == bench.planes(undisturbed)


@pytest.mark.parametrize(("name", "module"), [("mpi", "mpi4py"), ("dask", "distributed")])
def test_a_missing_package_is_named_with_its_cure(monkeypatch, name, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(PipelineError) as caught, engine(name, scheduler="tcp://127.0.0.1:1"):
        pass
    assert f"pip install 'zonda[{name}]'" in str(caught.value)


def test_dask_connects_only_where_it_is_told(bench, capsys):
    pytest.importorskip("distributed", reason="distributed is not installed")
    assert bench.command("run", bench.file(bench.CAMPAIGN), "--engine", "dask", "--output", bench.new()) == 2
    assert "no Dask scheduler is named" in capsys.readouterr().err
    assert bench.command("run", bench.file(bench.CAMPAIGN), "--scheduler", "no address", "--output", bench.new()) == 2
    assert "cannot reach the Dask scheduler" in capsys.readouterr().err


def test_one_mpi_process_is_not_enough(capsys):
    pytest.importorskip("mpi4py", reason="mpi4py is not installed")
    with pytest.raises(PipelineError, match="leaves no worker"), engine("mpi"):
        pass


def test_cores_and_memory_are_shared_among_workers(monkeypatch):
    monkeypatch.setattr("zonda.core.campaign.engines.available_threads", lambda: 8)
    monkeypatch.setattr("zonda.core.campaign.engines.available_memory", lambda: 16_000)
    with engine("processes", workers=4) as pool:
        assert (pool.workers, pool.threads, pool.memory) == (4, 2, 2000)
    with engine("processes") as pool:
        assert (pool.workers, pool.threads) == (8, 1)


def test_ctrl_c_does_not_reach_workers_that_start():
    """A Ctrl-C of the terminal goes to all processes; one that is still importing would show a traceback."""
    code = (
        "import os, signal, sys, time\n"
        "from zonda.core.campaign.engines import engine\n"
        "if __name__ == '__main__':\n"
        "    with engine('processes', workers=2) as pool:\n"
        "        futures = [pool.executor.submit(time.sleep, 0) for _ in range(2)]\n"
        "        for process in pool.executor._processes.values():\n"
        "            for _ in range(3):\n"
        "                os.kill(process.pid, signal.SIGINT)\n"
        "        print([f.result() for f in futures], signal.pthread_sigmask(signal.SIG_BLOCK, []))\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "[None, None] set()\n", "")
