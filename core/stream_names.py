"""Which block streams an operator reads, when that is one of its parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from .configuration.diagnostics import nearest
from .errors import PipelineError
from .signal import BUILT_IN, MAIN, is_signal

if TYPE_CHECKING:
    from collections.abc import Iterable

    from .observation import Observation

StreamName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""What a parameter ``streams`` may list: ``signal``, a component (``sky``, or one of a plugin), or
what else a step makes (``pwv``)."""

AnyStream = Annotated[
    str, Field(pattern=rf"^([A-Za-z_][A-Za-z0-9_]*|{MAIN}/[A-Za-z][A-Za-z0-9_]*)$")
]
"""The same, or the stream of a signal of `runs` (``signal/noiseless``)."""

COMPONENTS = frozenset(map(str, BUILT_IN))
"""Signal components of zonda's own operators."""

UNITS = {"transmission": "", "opacity": "", "flags": "", "pwv": "m", "path_delay": "m"}
"""Units of streams that are not in K."""


class StreamsAsked:
    """The ``optional`` of an operator with a parameter ``streams``: all components for the class,
    those asked for in an object, and the streams of signals among them.

    So the executor keeps no stream that nobody reads, see `core.run.execution`.
    """

    def __get__(self, operator: Any, owner: type) -> frozenset[str]:
        asked = getattr(operator, "streams", None)
        return (
            COMPONENTS
            if asked is None
            else frozenset(name for name in asked if name in COMPONENTS or f"{MAIN}/" in name)
        )


class StreamsNeeded:
    """The ``requires`` of such an operator: ``signal``, and streams that are no components of
    zonda's own.

    Nobody makes these by default: a name that no step provides is an error.
    """

    def __get__(self, operator: Any, owner: type) -> frozenset[str]:
        asked = (
            MAIN if is_signal(name) else name for name in getattr(operator, "streams", None) or ()
        )
        return frozenset({MAIN, *asked}) - COMPONENTS


def check_signals(streams: Iterable[str], observation: Observation, place: str) -> None:
    """Refuse the stream of a signal that is not formed: that `runs` does not have, or that is a
    remainder (PipelineError).
    """
    for name in streams:
        if is_signal(name) and name not in observation.signals:
            have = [one for one in observation.signals if not one.partition("/")[2].startswith("_")]
            listed = f"streams of signals: {', '.join(have)}; of a remainder there are maps alone"
            cure = "\n".join(filter(None, (nearest(name, have[1:]), listed)))
            raise PipelineError(f"there is no stream {name!r}", place=place, cure=cure)
