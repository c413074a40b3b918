"""What the bands of a camera share of a scan, or of a block: made by the band that needs it first,
released after the last.

Nothing that a band computes may depend on the others: what is shared has the bits that each band
would make by itself.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

T = TypeVar("T")

ROOM = 64 << 20
"""Most bytes that are kept of the blocks of a scan at a time; of short scans, no more than a stream
of one band takes.
"""


def room_for(n_detectors: int, n_samples: int) -> int:
    """Bytes that are kept of the blocks of one scan at most."""
    return min(ROOM, 4 * n_detectors * n_samples)


class SharedScan:
    """One scan of a camera with several bands. Safe for threads.

    Parameters
    ----------
    room
        Most bytes that `of_block` keeps at a time.
    bands
        Number of bands that look through the same pixels; 1: each looks through others.
    """

    def __init__(self, room: int, bands: int = 1) -> None:
        self._free = self.room = room
        self.bands = bands
        self._announced: dict[str, dict[str, Any]] = {}
        self._made: dict[Hashable, Any] = {}
        self._lock = threading.RLock()
        self._of_thread = threading.local()

    def announce(self, label: str, band: str, part: Any) -> None:
        """Say what a band adds to what the step ``label`` makes for all; in `Operator.observe`, in
        the order of the bands.
        """
        self._announced.setdefault(label, {})[band] = part

    def made(self, label: str, make: Callable[[Mapping[str, Any]], T]) -> T:
        """What the step ``label`` made for all bands; the first one that asks makes it, of what was
        announced by each.
        """
        return self.once(label, lambda: make(self._announced.get(label, {})))

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """What is the same for all bands that have this ``key``: made by the first that asks."""
        with self._lock:
            if key not in self._made:
                self._made[key] = make()
            found: T = self._made[key]
            return found

    @contextmanager
    def block(self) -> Iterator[None]:
        """While one thread works on a block with one band after the other: `of_block` keeps what it
        makes until the end.
        """
        kept: dict[Hashable, tuple[Any, int]] = {}
        self._of_thread.kept, self._of_thread.put_off = kept, {}
        try:
            yield
        finally:
            self._of_thread.kept = self._of_thread.put_off = None
            self.claim(-sum(size for _, size in kept.values()))

    def put_off(
        self, label: str, key: Hashable, part: Any, work: Callable[[list[Any]], None]
    ) -> bool:
        """Let ``work`` be called once for the parts of all bands that have this ``key``, after the
        last of them.

        The step ``label`` must be the same. False, and nothing is put off, outside of `block`.
        """
        put_off = getattr(self._of_thread, "put_off", None)
        if put_off is None:
            return False
        put_off.setdefault((label, key), (work, []))[1].append(part)
        return True

    def due(self) -> Iterator[tuple[str, Callable[[], None]]]:
        """What the bands have put off in this block: the step's label, and the work."""
        for (label, _), (work, parts) in self._of_thread.put_off.items():
            yield label, partial(work, parts)

    def of_block(self, key: Hashable, size: int, make: Callable[[], T]) -> T:
        """What is the same in a block for all bands that have this ``key``, of ``size`` bytes: made
        by the first that asks.

        Made for this band alone outside of `block`, and where there is no room to keep it.
        """
        kept = getattr(self._of_thread, "kept", None)
        if kept is None:
            return make()
        if key not in kept:
            found = make()
            if not self.claim(size):
                return found
            kept[key] = found, size
        same: T = kept[key][0]
        return same

    def claim(self, size: int) -> bool:
        """Whether ``size`` bytes more may be kept; a negative size gives back."""
        with self._lock:
            if size > self._free:
                return False
            self._free -= size
            return True

    def forget(self) -> None:
        """Release what was made: the last band has observed the scan."""
        with self._lock:
            self._made.clear()
            self._free = self.room


def once(shared: SharedScan | None, key: Hashable, make: Callable[[], T]) -> T:
    """`SharedScan.once`, and ``make`` where there is one band."""
    return make() if shared is None else shared.once(key, make)


def of_block(shared: SharedScan | None, key: Hashable, size: int, make: Callable[[], T]) -> T:
    """`SharedScan.of_block`, and ``make`` where there is one band."""
    return make() if shared is None else shared.of_block(key, size, make)
