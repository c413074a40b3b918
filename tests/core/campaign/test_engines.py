"""A real Dask cluster and real MPI processes give the bits of a run in series."""

from __future__ import annotations

import gc
import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from zonda.core.errors import InputError, PipelineError
from zonda.core.experiment import engines
from zonda.core.experiment.engines import engine


def test_dask_cluster_of_two_workers(undisturbed, bench):
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
    with distributed.LocalCluster(**options) as cluster:
        out = bench.run(bench.CAMPAIGN, "--scheduler", cluster.scheduler_address)
    assert bench.planes(out) == bench.planes(undisturbed)


TOO_FAST = ("50 arcsec/s", "500 arcsec/s")
"""For the sample rate: planning and tasks warn of it."""


@pytest.mark.nightly
def test_workers_of_dask_leave_their_warnings_to_the_main_process(bench, capfd, recwarn):
    distributed = pytest.importorskip(
        "distributed", reason="distributed is not installed: pip install 'zonda[dask]'"
    )
    options = {
        "n_workers": 1,
        "threads_per_worker": 2,
        "processes": True,
        "dashboard_address": None,
        "host": "127.0.0.1",
    }
    with distributed.LocalCluster(**options) as cluster:
        bench.run("{nights: 2}", "--scheduler", cluster.scheduler_address, changes=(TOO_FAST,))
    assert "samples per FWHM" not in capfd.readouterr().err
    assert sum("samples per FWHM" in str(one.message) for one in recwarn) == 1


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """``ca.pem``, ``node.pem`` which it signed, ``other.pem`` which it did not; each with its
    ``.key``.
    """
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("there is no openssl command to make certificates with")
    folder = tmp_path_factory.mktemp("certificates")

    def make(*arguments):
        subprocess.run([openssl, *arguments], cwd=folder, check=True, capture_output=True)

    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    for name in ("ca", "other"):
        make(
            "req",
            "-x509",
            *key,
            "-days",
            "2",
            "-subj",
            f"/CN={name}",
            "-keyout",
            f"{name}.key",
            "-out",
            f"{name}.pem",
        )
    make("req", *key, "-subj", "/CN=node", "-keyout", "node.key", "-out", "node.csr")
    make(
        "x509",
        "-req",
        "-in",
        "node.csr",
        "-CA",
        "ca.pem",
        "-CAkey",
        "ca.key",
        "-CAcreateserial",
        "-days",
        "2",
        "-out",
        "node.pem",
    )
    return folder


@pytest.fixture(scope="module")
def encrypted(certificates):
    """Address of a Dask cluster that talks to nobody without a certificate."""
    distributed = pytest.importorskip(
        "distributed", reason="distributed is not installed: pip install 'zonda[dask]'"
    )
    pairs = {
        f"tls_{who}_{what}": str(certificates / file)
        for who in ("scheduler", "worker", "client")
        for what, file in (("cert", "node.pem"), ("key", "node.key"))
    }
    security = distributed.Security(
        tls_ca_file=str(certificates / "ca.pem"), require_encryption=True, **pairs
    )
    options = {
        "n_workers": 1,
        "threads_per_worker": 1,
        "processes": True,
        "dashboard_address": None,
        "host": "127.0.0.1",
    }
    with distributed.LocalCluster(**options, protocol="tls://", security=security) as cluster:
        assert cluster.scheduler_address.startswith("tls://")
        yield cluster.scheduler_address


def in_a_shell(arguments, **variables):
    """The command line in a process of its own; its exit status, and what it said."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | variables
    command = [sys.executable, "-m", "zonda", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    return done.returncode, done.stderr


@pytest.mark.nightly
def test_dask_with_tls_by_its_own_configuration(
    undisturbed, bench, certificates, encrypted, tmp_path
):
    """Certificates in variables of the environment, as Dask reads them."""
    names = {"CA_FILE": "ca.pem", "CLIENT__CERT": "node.pem", "CLIENT__KEY": "node.key"}
    variables = {
        f"DASK_DISTRIBUTED__COMM__TLS__{name}": str(certificates / file)
        for name, file in names.items()
    }
    out = bench.new()
    status, said = in_a_shell(
        ["run", bench.file(bench.CAMPAIGN), "--scheduler", encrypted, "--output", out], **variables
    )
    assert status == 0, said
    assert bench.planes(out) == bench.planes(undisturbed)


def test_dask_with_tls_by_the_pipeline_file(bench, certificates, encrypted):
    tls = (
        f"{{ca_file: {certificates}/ca.pem, cert: {certificates}/node.pem, key:"
        f" {certificates}/node.key}}"
    )
    out = bench.run(f"{{engine: dask, scheduler: '{encrypted}', tls: {tls}}}")
    assert (out / "map.fits").exists()


@pytest.mark.parametrize(
    ("ca", "pair", "why"),
    [
        (None, None, "no ca_file for TLS is named"),
        ("ca", None, "no cert for TLS is named"),
        ("gone", "node", "ca_file of TLS: there is no file"),
        ("ca", ("node", "other"), "the certificates for TLS cannot be used"),  # not a pair
        (
            "other",
            "other",
            "cannot reach the Dask scheduler: ",
        ),  # the scheduler's was signed by somebody else
        ("ca", "other", "cannot reach the Dask scheduler: "),  # the scheduler does not accept it
    ],
)
def test_wrong_certificates_are_one_clean_error(
    bench, certificates, encrypted, capfd, ca, pair, why
):
    dask = pytest.importorskip("dask")
    cert, key = pair if isinstance(pair, tuple) else (pair, pair)
    files = {
        "ca-file": ca and f"{ca}.pem",
        "client.cert": cert and f"{cert}.pem",
        "client.key": key and f"{key}.key",
    }
    with dask.config.set(
        {f"distributed.comm.tls.{k}": str(certificates / v) for k, v in files.items() if v}
    ):
        out = bench.run(bench.CAMPAIGN, "--scheduler", encrypted, status=2)
    gc.collect()  # a client that was never connected says so when it is thrown away
    said = [
        line
        for line in capfd.readouterr().err.splitlines()
        if "distributed" not in line.partition(" - ")[2]
    ]
    assert said[0].startswith(f"error: {encrypted}: {why}"), said
    assert len(said) == 2, said
    assert "certificates" in said[1] or "comm.tls" in said[1]
    assert not out.exists()


@pytest.fixture
def mpi(bench):
    """Runs a campaign in so many processes of MPI; the output folder, and what they said."""
    pytest.importorskip("mpi4py", reason="mpi4py is not installed: pip install 'zonda[mpi]'")
    beside = Path(sys.executable).with_name("mpiexec")
    mpiexec = str(beside) if beside.exists() else shutil.which("mpiexec")
    if mpiexec is None:
        pytest.skip("there is no mpiexec: pip install mpich")

    def run(number, campaign, *changes):
        out = bench.new()
        arguments = [
            "run",
            str(bench.file(campaign, *changes)),
            "--engine",
            "mpi",
            "--output",
            str(out),
        ]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        command = [mpiexec, "-n", str(number), sys.executable, "-m", "zonda", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        assert done.stdout == f"{out}/\n"
        return out, done.stderr

    return run


def test_mpi_with_two_processes(undisturbed, bench, mpi):
    assert bench.planes(mpi(2, bench.CAMPAIGN)[0]) == bench.planes(undisturbed)


def test_workers_of_mpi_leave_their_warnings_to_the_main_process(mpi):
    assert mpi(3, "{nights: 2}", TOO_FAST)[1].count("samples per FWHM") == 1


@pytest.mark.parametrize(("name", "module"), [("mpi", "mpi4py"), ("dask", "distributed")])
def test_a_missing_package_is_named_with_its_cure(monkeypatch, name, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError) as caught, engine(name, scheduler="tcp://127.0.0.1:1"):
        pass
    assert f"pip install 'zonda[{name}]'" in str(caught.value)


def test_dask_connects_only_where_it_is_told(bench, capsys):
    pytest.importorskip("distributed", reason="distributed is not installed")
    assert (
        bench.command(
            "run", bench.file(bench.CAMPAIGN), "--engine", "dask", "--output", bench.new()
        )
        == 2
    )
    assert "no Dask scheduler is named" in capsys.readouterr().err
    assert (
        bench.command(
            "run", bench.file(bench.CAMPAIGN), "--scheduler", "no address", "--output", bench.new()
        )
        == 2
    )
    assert "cannot reach the Dask scheduler" in capsys.readouterr().err


def test_a_scheduler_file_that_is_still_being_written_is_waited_for(monkeypatch, tmp_path):
    """Dask writes it in place, and a job script starts scheduler and campaign together."""
    file, tries = tmp_path / "scheduler.json", []

    def write_more(seconds):
        tries.append(seconds)
        file.write_text(
            {1: "", 2: '{"type": "Sched', 3: "{}"}.get(
                len(tries), '{"address": "tcp://127.0.0.1:8786"}'
            )
        )

    monkeypatch.setattr(engines.time, "sleep", write_more)
    assert engines._address(str(file)) == "tcp://127.0.0.1:8786"
    assert len(tries) == 4


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (None, "No such file"),
        ("", "JSONDecodeError"),
        ("[]", "TypeError"),
        ("{}", "KeyError: 'addr"),
        ("\xff", "UnicodeDecode"),
    ],
)
def test_a_scheduler_file_that_never_comes(monkeypatch, tmp_path, text, why):
    pytest.importorskip("distributed", reason="distributed is not installed")
    monkeypatch.setattr(engines, "SCHEDULER_FILE_WAIT", 0.0)
    file = tmp_path / "scheduler.json"
    if text is not None:
        file.write_bytes(text.encode("latin-1"))
    with (
        pytest.raises(PipelineError, match=f"its file cannot be read: .*{why}") as caught,
        engine("dask", scheduler=str(file)),
    ):
        pass
    assert caught.value.place == str(file)


def test_one_mpi_process_is_not_enough(capsys):
    pytest.importorskip("mpi4py", reason="mpi4py is not installed")
    try:
        importlib.import_module("mpi4py.MPI")
    except RuntimeError:
        pytest.skip("there is no library of MPI")
    with pytest.raises(PipelineError, match="leaves no worker"), engine("mpi"):
        pass


def test_mpi4py_without_a_library_of_mpi(monkeypatch):
    class Without:
        def find_spec(self, name, path=None, target=None):
            if name == "mpi4py.MPI":
                raise RuntimeError("cannot load MPI library\nlibmpi.so: no such file")

    pytest.importorskip("mpi4py", reason="mpi4py is not installed")
    for name in [name for name in sys.modules if name.startswith("mpi4py")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Without(), *sys.meta_path])
    with pytest.raises(PipelineError, match="cannot load MPI library") as told, engine("mpi"):
        pass
    assert told.value.place == "engine mpi"
    assert "MPICH" in told.value.cure


def test_cores_and_memory_are_shared_among_workers(monkeypatch):
    monkeypatch.setattr("zonda.core.experiment.engines.available_threads", lambda: 8)
    monkeypatch.setattr("zonda.core.experiment.engines.available_memory", lambda: 16_000)
    with engine("processes", workers=4) as pool:
        assert (pool.workers, pool.threads, pool.memory) == (4, 2, 2000)
    with engine("processes") as pool:
        assert (pool.workers, pool.threads) == (8, 1)


@pytest.mark.nightly
def test_ctrl_c_does_not_reach_workers_that_start():
    """A Ctrl-C of the terminal goes to all processes; one that is still importing would show a
    traceback.
    """
    code = (
        "import os, signal, sys, time\nfrom zonda.core.experiment.engines import engine\nif __name__"
        " == '__main__':\n    with engine('processes', workers=2) as pool:\n        futures ="
        " [pool.executor.submit(time.sleep, 0) for _ in range(2)]\n        for process in"
        " pool.executor._processes.values():\n            for _ in range(3):\n               "
        " os.kill(process.pid, signal.SIGINT)\n        print([f.result() for f in futures],"
        " signal.pthread_sigmask(signal.SIG_BLOCK, []))\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "[None, None] set()\n", "")
