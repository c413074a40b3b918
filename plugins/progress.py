"""Progress on stderr: a line that moves on a terminal, and in a log a line every ten seconds.

A plugin of zonda's own hooks, and a pattern for others.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from zonda.core.hooks import hookimpl

INTERVAL = 0.1
"""Seconds between two updates on a terminal."""
LOGGED = 10.0
"""Seconds before the first line of a log, and between two."""


class Progress:
    """Writes to stderr.

    Parameters
    ----------
    clock
        Seconds since any moment.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._lock = threading.Lock()
        self._clock = clock
        self._what = ""
        self._began = 0.0
        self._shown = 0.0
        self._visible = False
        self._logged: float | None = None

    @hookimpl
    def zonda_pipeline_start(self, pipeline: Any) -> None:
        """A log begins to count its ten seconds."""
        with self._lock:
            self._logged = self._clock()

    @hookimpl
    def zonda_progress(self, done: int, total: int, what: str) -> None:
        """One line: ``what [#####.....] 50 %, 12 s left``."""
        if total == 0:
            self._clear()
            return
        now = self._clock()
        with self._lock:
            if what != self._what:
                self._what = what
                self._began = now
                self._shown = 0.0
            self._show(now, done == total, line(done, total, what, now - self._began))

    @hookimpl
    def zonda_campaign_progress(
        self,
        done: int,
        total: int,
        failed: int,
        samples: int,
        all_samples: int,
        seconds: float,
    ) -> None:
        """One line: ``tasks 12 of 100 [##........] 12 %, 3.1e+06 samples/s, 80 s left``."""
        with self._lock:
            self._show(
                self._clock(),
                done == total,
                campaign_line(done, total, failed, samples, all_samples, seconds),
            )

    def _show(self, now: float, last: bool, text: str) -> None:
        """Write where it is time: on a terminal over the line before, in a log as a line of its
        own.
        """
        if not sys.stderr.isatty():
            if self._logged is None:
                self._logged = now
            if now - self._logged >= LOGGED:
                self._logged = now
                sys.stderr.write(text + "\n")
                sys.stderr.flush()
        elif last or now - self._shown >= INTERVAL:
            self._shown = now
            self._visible = True
            sys.stderr.write("\r\033[K" + text)
            sys.stderr.flush()

    @hookimpl
    def zonda_campaign_end(self) -> None:
        """Clear the line."""
        self._clear()

    @hookimpl
    def zonda_pipeline_end(self, pipeline: Any) -> None:
        """Clear the line."""
        self._clear()

    def _clear(self) -> None:
        with self._lock:
            if self._visible:
                sys.stderr.write("\r\033[K")
                sys.stderr.flush()
            self._what = ""
            self._visible = False


def line(done: int, total: int, what: str, seconds: float, width: int = 20) -> str:
    """The text of the progress line after ``seconds``; ``width`` characters of bar."""
    share = min(1.0, done / total) if total > 0 else 1.0
    bar = "#" * int(width * share)
    left = f", {seconds * (1 - share) / share:.0f} s left" if 0 < share < 1 and seconds >= 1 else ""
    return f"{what[:60]} [{bar:.<{width}}] {100 * share:.0f} %{left}"


def campaign_line(
    done: int,
    total: int,
    failed: int,
    samples: int,
    all_samples: int,
    seconds: float,
    width: int = 20,
) -> str:
    """The text of a campaign's progress line. Time left: as the samples that are left take at the
    rate so far.
    """
    share = min(1.0, samples / all_samples) if all_samples > 0 else 1.0
    bar = "#" * int(width * share)
    text = f"tasks {done} of {total} [{bar:.<{width}}] {100 * share:.0f} %"
    if samples and seconds > 0:
        left = seconds * (1 - share) / share
        words = (
            f"{left:.0f} s"
            if left < 120
            else f"{left / 60:.0f} min"
            if left < 7200
            else f"{left / 3600:.1f} h"
        )
        text += f", {samples / seconds:.3g} samples/s, {words} left"
    return text + (f", {failed} attempts failed" if failed else "")


progress = Progress()
"""What the entry point names."""
