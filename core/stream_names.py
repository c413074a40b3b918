"""Which block streams an operator reads, when that is one of its parameters."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from .signal import BUILT_IN, MAIN

StreamName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""What a parameter ``streams`` may list: ``signal``, a component (``sky``, or one of a plugin), or what else a step makes
(``pwv``)."""

COMPONENTS = frozenset(map(str, BUILT_IN))
"""Signal components of zonda's own operators."""

UNITS = {"transmission": "", "opacity": "", "flags": "", "pwv": "m", "path_delay": "m"}
"""Units of streams that are not in K."""


class StreamsAsked:
    """The ``optional`` of an operator with a parameter ``streams``: all components for the class, those asked for in an object.

    So the executor keeps no stream that nobody reads, see `core.run.execution`.
    """

    def __get__(self, operator: Any, owner: type) -> frozenset[str]:
        asked = getattr(operator, "streams", None)
        return COMPONENTS if asked is None else COMPONENTS & frozenset(asked)


class StreamsNeeded:
    """The ``requires`` of such an operator: ``signal``, and streams that are no components of zonda's own.

    Nobody makes these by default: a name that no step provides is an error.
    """

    def __get__(self, operator: Any, owner: type) -> frozenset[str]:
        return frozenset({MAIN, *(getattr(operator, "streams", None) or ())}) - COMPONENTS
