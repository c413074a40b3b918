"""One run at a time in a folder; a lock outlives nobody."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from zonda.core.errors import OutputError
from zonda.core.storage.lock import NAME, _myself, lock

HOLD = """
import sys
from zonda.core.storage.lock import lock
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
    assert (tmp_path / NAME).exists()
    with lock(tmp_path):
        pass


@pytest.mark.parametrize(
    ("change", "taken"),
    [
        (
            {},
            True,
        ),  # this process itself, but the file is not locked: it was written by an earlier one
        ({"host": "elsewhere"}, False),
        ({"boot": "before"}, True),
        ({"began": "1"}, True),  # the number of the process was given away again
    ],
)
def test_who_is_gone(tmp_path, change, taken):
    (tmp_path / NAME).write_text(json.dumps(_myself() | change))
    if taken:
        with lock(tmp_path):
            pass
    else:
        with pytest.raises(OutputError, match="on elsewhere"), lock(tmp_path):
            pass


def test_without_locks_of_the_file_system_the_process_decides(tmp_path, monkeypatch):
    monkeypatch.setattr("zonda.core.storage.lock._flock", lambda handle: None)
    for change, taken in (
        ({}, False),
        ({"began": "1"}, True),
        ({"boot": "before"}, True),
        ({"pid": -5}, True),
    ):
        (tmp_path / NAME).write_text(json.dumps(_myself() | change))
        if taken:
            with lock(tmp_path):
                pass
        else:
            with pytest.raises(OutputError), lock(tmp_path):
                pass


def test_a_lock_that_was_cut_short_names_nobody(tmp_path):
    (tmp_path / NAME).write_text('{"host": "some')
    with lock(tmp_path):
        pass
