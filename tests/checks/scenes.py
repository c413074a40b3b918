"""What the checks of the slow half share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from zonda.core.errors import ZondaError


def unrefused(attempts: list[tuple[Callable[[], Any], str]]) -> tuple[int, str]:
    """How many of the attempts do not end in an error a user can mend whose text has the words;
    what they were.
    """
    missed = []
    for attempt, words in attempts:
        try:
            attempt()
        except (ZondaError, ValueError) as err:
            if words in str(err):
                continue
        missed.append(words)
    return len(missed), ", ".join(missed)
