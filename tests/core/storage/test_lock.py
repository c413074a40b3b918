"""One run at a time in a folder; a lock outlives nobody."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys

import pytest

from zonda.core.errors import OutputError
from zonda.core.storage.output_folder import LOCK, lock

HOLD = """
import sys
from zonda.core.storage.output_folder import lock
with lock(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_two_are_refused_and_nothing_stays(tmp_path):
    with lock(tmp_path):
        with (
            pytest.raises(
                OutputError, match=f"process {os.getpid()} on .* is writing to this folder"
            ),
            lock(tmp_path),
        ):
            pass
        with pytest.raises(OutputError), lock(tmp_path, "1-of-2"):
            pass
    assert list(tmp_path.iterdir()) == []


def test_shares_run_beside_each_other_but_not_beside_a_whole_run(tmp_path):
    with lock(tmp_path, "1-of-2"), lock(tmp_path, "2-of-2"):
        with pytest.raises(OutputError), lock(tmp_path):
            pass
        with pytest.raises(OutputError), lock(tmp_path, "2-of-2"):
            pass
    with lock(tmp_path):
        pass


def test_a_killed_holder_leaves_a_lock_that_is_taken_over(tmp_path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], env=environment, **pipes
    ) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(OutputError, match=f"process {process.pid} on"), lock(tmp_path):
            pass
        process.kill()
        process.wait()
    assert (tmp_path / LOCK).exists()
    with lock(tmp_path):
        pass


def test_a_file_that_nobody_holds_is_taken_over(tmp_path):
    (tmp_path / LOCK).write_text('{"host": "some')
    with lock(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_processes_that_the_holder_starts_do_not_hold_it(tmp_path):
    code = HOLD.replace(
        'print("held", flush=True)',
        "import subprocess; "
        "subprocess.Popen(['sleep', '60'], stdin=-3, stdout=-3); print('held', flush=True)",
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        env=environment,
        start_new_session=True,
        **pipes,
    ) as process:
        assert process.stdout.readline() == "held\n"
        process.kill()
        process.wait()
        with lock(tmp_path):  # the child lives on
            os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOTSUP])
def test_a_file_system_without_locks_is_refused(tmp_path, monkeypatch, number):
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(OutputError, match="without locks") as caught, lock(tmp_path):
        pass
    assert "local disk" in caught.value.cure
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["link", "dangling", "pipe", "folder"])
def test_nothing_but_a_regular_file_is_opened(tmp_path, kind):
    """A link in a folder that others may write to would empty the file that it names; a pipe would
    be waited for.
    """
    place, other = tmp_path / LOCK, tmp_path / "other.txt"
    other.write_text("somebody's")
    if kind == "pipe":
        os.mkfifo(place)
    elif kind == "folder":
        place.mkdir()
    else:
        place.symlink_to(other if kind == "link" else tmp_path / "absent")
    with pytest.raises(OutputError) as told, lock(tmp_path):
        pass
    assert told.value.place == str(place)
    assert "remove it" in told.value.cure
    assert other.read_text() == "somebody's"
    assert not (tmp_path / "absent").exists()
