from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from zonda.operators.diagnostics.drawing.artist import Artist


@pytest.fixture
def artist():
    made = Artist()
    yield made
    made.close()


def test_it_answers_in_order(artist):
    answers = [artist.submit(math.sqrt, x) for x in (1.0, 4.0, 9.0)]
    assert [a.result() for a in answers] == [1.0, 2.0, 3.0]


def test_failures_warnings_and_what_cannot_be_sent_are_none(artist):
    assert artist.submit(math.sqrt, -1.0).result() is None
    assert artist.submit(warnings.warn, "careful").result() is None
    assert artist.submit(os.getpid).result() != os.getpid()
    assert artist.submit(math.sqrt, 4.0).result() == 2.0
    assert artist.submit(lambda: 1).result() is None


def test_what_is_printed_does_not_come_between(artist):
    assert artist.submit(print, "hello").result() is None
    assert artist.submit(math.sqrt, 4.0).result() == 2.0


def test_a_dead_process_is_none(artist):
    artist._process.kill()
    artist._process.wait()
    assert artist.submit(math.sqrt, 4.0).result() is None


@pytest.mark.skipif(sys.platform != "linux", reason="one draws elsewhere")
def test_two_draw_at_a_time(artist):
    two = _two(artist)
    assert {os.getpgid(pid) for pid in two} == {artist._process.pid}
    artist.close()
    assert _gone({artist._process.pid, *two})


@pytest.mark.skipif(sys.platform != "linux", reason="one draws elsewhere")
def test_where_one_of_them_is_killed_no_call_waits(artist):
    two = _two(artist)
    os.kill(min(two), signal.SIGKILL)
    answers = [artist.submit(os.getpid).result(30) for _ in range(6)]
    assert set(answers) <= {None, max(two)}
    artist.close()
    assert _gone({artist._process.pid, *two})


@pytest.mark.skipif(sys.platform != "linux", reason="one draws elsewhere")
def test_those_at_work_end_where_the_first_is_dead(artist):
    first, two = artist._process.pid, _two(artist)
    answers = [artist.submit(time.sleep, 600.0) for _ in range(2)]
    os.kill(first, signal.SIGKILL)
    while not _zombie(first):
        time.sleep(0.01)
    assert [answer.result(30) for answer in answers] == [None, None]
    assert artist.submit(math.sqrt, 4.0).result(30) is None
    artist.close()
    assert _gone(two)


def _zombie(pid):
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


def _two(artist):
    """Their numbers: two tasks at a time, until both have answered."""
    patience, found = time.monotonic() + 30, set()
    while time.monotonic() < patience and len(found) < 2:
        both = [
            artist.submit(subprocess.check_output, ["sh", "-c", "sleep 0.2; echo $PPID"])
            for _ in range(2)
        ]
        found |= {int(answer.result(30)) for answer in both}
    return found


def _gone(pids):
    patience = time.monotonic() + 30
    while time.monotonic() < patience and any(_alive(pid) for pid in pids):
        time.sleep(0.02)
    return not any(_alive(pid) for pid in pids)


def test_it_ends_with_its_owner():
    made = Artist()
    process = made._process
    del made
    assert process.wait(10) is not None


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
@pytest.mark.parametrize("wait", [0.0, 0.3])
def test_it_ends_with_an_owner_that_is_killed(wait):
    """Also while it is importing, and where one has drawn already."""
    source = f"""
import os, signal, time
from zonda.operators.diagnostics.drawing.artist import Artist
artist = Artist()
pids = {{artist._process.pid}}
if {wait}:
    pids |= {{artist.submit(os.getpid).result() for _ in range(8)}}
print(*pids, flush=True)
time.sleep({wait})
os.kill(os.getpid(), signal.SIGKILL)
"""
    run = subprocess.run([sys.executable, "-c", source], stdout=subprocess.PIPE, text=True)
    assert run.returncode == -signal.SIGKILL
    assert _gone({int(pid) for pid in run.stdout.split()})


def _alive(pid):
    """Whether a process runs (one that nobody has waited for yet does not)."""
    stat = Path(f"/proc/{pid}/stat")
    with contextlib.suppress(OSError):
        if Path("/proc/self").is_dir():
            return stat.read_text().rpartition(")")[2].split()[0] != "Z" if stat.exists() else False
        os.kill(pid, 0)
        return True
    return False
