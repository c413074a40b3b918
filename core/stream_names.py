"""Which block streams an operator reads, when that is one of its parameters."""

from __future__ import annotations

from typing import Any, Literal

from .signal import BUILT_IN

StreamName = Literal["signal", "sky", "atmosphere", "transmission", "white", "pink"]
"""What a parameter ``streams`` may list."""

COMPONENTS = frozenset(map(str, BUILT_IN))
"""Signal components that a block may hold besides ``signal``."""


class StreamsAsked:
    """The ``optional`` of an operator with a parameter ``streams``: all components for the class, those asked for in an object.

    So the executor keeps no stream that nobody reads, see `core.run.execution`.
    """

    def __get__(self, operator: Any, owner: type) -> frozenset[str]:
        if operator is None or operator.streams is None:
            return COMPONENTS
        return COMPONENTS & frozenset(operator.streams)
