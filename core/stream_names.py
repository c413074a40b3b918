"""Names of block streams that an operator reads, if they are one of its parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from .configuration.diagnostics import nearest
from .errors import PipelineError
from .signal import BUILT_IN, MAIN, is_signal

if TYPE_CHECKING:
    from collections.abc import Iterable

    from .observation import Observation

StreamName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""A name that a parameter ``streams`` may list: ``signal``, a component (``sky``, or one of a
plugin), or another stream that a step makes (``pwv``)."""

AnyStream = Annotated[
    str, Field(pattern=rf"^([A-Za-z_][A-Za-z0-9_]*|{MAIN}/[A-Za-z][A-Za-z0-9_]*)$")
]
"""The same, or the stream of a signal of `runs` (``signal/noiseless``)."""

COMPONENTS = frozenset(map(str, BUILT_IN))
"""Signal components of zonda's own operators."""

UNITS = {"transmission": "", "opacity": "", "flags": "", "pwv": "m", "path_delay": "m"}
"""Units of streams that are not in K."""


def streams_asked(streams: Iterable[str] | None) -> frozenset[str]:
    """Components of zonda's own and streams of signals among ``streams`` (None: all components),
    for `Operator.optional`: the executor keeps no stream that nobody reads (`core.run.execution`).
    """
    if streams is None:
        return COMPONENTS
    return frozenset(name for name in streams if name in COMPONENTS or f"{MAIN}/" in name)


def streams_needed(streams: Iterable[str] | None) -> frozenset[str]:
    """``signal``, and those of ``streams`` that are no components of zonda's own, for
    `Operator.requires`: no step makes these by default, so that a name without a maker is an error.
    """
    asked = (MAIN if is_signal(name) else name for name in streams or ())
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
