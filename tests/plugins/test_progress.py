"""Progress in a log: a line every ten seconds, by a clock of our own."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from zonda.plugins.progress import LOGGED, Progress


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def log(capsys: pytest.CaptureFixture[str]) -> Callable[[], str]:
    return lambda: capsys.readouterr().err


def test_a_line_every_ten_seconds(log: Callable[[], str]) -> None:
    clock = Clock()
    progress = Progress(clock)
    progress.zonda_pipeline_start(pipeline=None)
    for second in range(1, 36):  # one call each second
        clock.now = 1000.0 + second
        progress.zonda_progress(done=second, total=100, what="scan-000: map")
    progress.zonda_pipeline_end(pipeline=None)
    text = log()
    assert "\r" not in text
    lines = text.splitlines()
    assert [one.partition("] ")[2].partition(" %")[0] for one in lines] == ["10", "20", "30"]
    assert all(one.startswith("scan-000: map [") for one in lines)


def test_a_short_run_writes_nothing(log: Callable[[], str]) -> None:
    clock = Clock()
    progress = Progress(clock)
    progress.zonda_pipeline_start(pipeline=None)
    clock.now += LOGGED - 0.1
    progress.zonda_progress(done=100, total=100, what="scan")
    assert log() == ""


def test_a_long_silence_is_one_line(log: Callable[[], str]) -> None:
    clock = Clock()
    progress = Progress(clock)
    progress.zonda_pipeline_start(pipeline=None)
    clock.now += 7 * LOGGED
    progress.zonda_progress(done=1, total=2, what="scan")
    progress.zonda_progress(done=2, total=2, what="scan")
    assert log().splitlines() == ["scan [##########..........] 50 %"]


def test_another_run_counts_anew(log: Callable[[], str]) -> None:
    clock = Clock()
    progress = Progress(clock)
    for _ in range(3):
        progress.zonda_pipeline_start(pipeline=None)
        clock.now += LOGGED - 1
        progress.zonda_progress(done=1, total=2, what="scan")
    assert log() == ""


def test_campaigns_too(log: Callable[[], str]) -> None:
    clock = Clock()
    progress = Progress(clock)
    for done in range(26):
        progress.zonda_campaign_progress(done, 100, 0, done, 100, float(done))
        clock.now += 1
    shown = [text.split()[1] for text in log().splitlines()]
    assert shown == ["10", "20"]
