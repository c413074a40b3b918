"""Results of an operator that are kept for its next observation."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any


class Cache:
    """Computed values by key. Thread-safe; copies and pickles are empty.

    Parameters
    ----------
    limit
        Bytes kept; the values least recently used go first (an observation that needs them holds
        them itself).
    """

    def __init__(self, limit: int = 2**30) -> None:
        self._limit = limit
        self._lock = threading.RLock()
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The value of ``key``, made where it is not there. Values have ``nbytes``."""
        with self._lock:
            if key not in self._kept:
                self._kept[key] = make()
                while (
                    len(self._kept) > 1 and sum(v.nbytes for v in self._kept.values()) > self._limit
                ):
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Cache)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[type[Cache], tuple[int]]:
        return Cache, (self._limit,)
