"""Variants of a registered instrument: ``{like: mustang2, detectors: 170}`` is MUSTANG-2 with 170 detectors."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from .configuration.parameters import named
from .registry import instruments

LIKE = "like"
"""Key that names what a variant differs from."""

LONGEST_NAME = 60
"""Characters of a name that lists the changes; of a longer list it has a hash."""


def is_variant(value: Any) -> bool:
    """Whether ``value`` is the mapping of a variant."""
    return isinstance(value, Mapping) and LIKE in value


def variant(given: Mapping[str, Any], context: Any = None) -> Any:
    """The instrument ``given["like"]`` (a registered name or an Instrument) with the other keys of ``given`` changed.

    A mapping for ``telescope`` changes the keys that it names; ``band`` is replaced as a whole. Where telescope or band change
    and ``fwhm`` is not given, the beam keeps its ratio to the diffraction limit. Where ``name`` is not given it lists the changes
    and is the same however their units are written. A variant without changes is the instrument itself.

    Raises
    ------
    pydantic.ValidationError, PydanticCustomError
        For keys and values that an instrument does not take, and an unknown name.
    """
    base = named(instruments, given[LIKE])
    if not hasattr(base, "focalplane"):
        raise ValueError(f"like takes the name of an instrument, not {given[LIKE]!r}")
    changes = {key: value for key, value in given.items() if key != LIKE}
    if isinstance(changes.get("telescope"), Mapping):
        whole = base.telescope.model_dump(mode="json") | {"site": base.telescope.site}
        changes["telescope"] = whole | dict(changes["telescope"])
    as_it_is = base.model_dump(mode="json") | {"telescope": base.telescope, "band": base.band}
    made = type(base).model_validate(as_it_is | changes, context=context)
    if "fwhm" not in changes and base.fwhm is not None:
        made = made.model_copy(update={"fwhm": base.fwhm * _diffraction(made) / _diffraction(base)})
    found = differences(base, made)
    if not found:
        return base
    told = ", ".join(f"{key} {value}" for key, (_, value) in found.items())
    before = ", ".join(f"{key} {value}" for key, (value, _) in found.items())
    texts = {
        "name": _name(base.name, told),
        "description": f"like {base.name}, with {told}",
        "provenance": f"{base.name} with {told} instead of {before}; {base.provenance}",
    }
    return made.model_copy(update={key: text for key, text in texts.items() if key not in changes})


def differences(base: Any, other: Any) -> dict[str, tuple[Any, Any]]:
    """What differs between two instruments but for their names and descriptions: (of ``base``, of ``other``) by key."""
    one, two = (_flat(x.model_dump(mode="json")) for x in (base, other))
    texts = ("name", "description", "provenance")
    return {key: (one.get(key), two.get(key)) for key in {**one, **two} if one.get(key) != two.get(key) and key not in texts}


def written(given: Mapping[str, Any], made: Any) -> dict[str, Any]:
    """The mapping ``given`` of a variant that came to be ``made``, in units and full paths, to be read again."""
    dumped = made.model_dump(mode="json")
    found: dict[str, Any] = {LIKE: given[LIKE]} | {key: dumped[key] for key in given if key != LIKE}
    if isinstance(changed := given.get("telescope"), Mapping):
        found["telescope"] = {key: dumped["telescope"].get(key, changed[key]) for key in changed}
    return found


def _diffraction(instrument: Any) -> float:
    return 1.0 / float(instrument.band.centre * instrument.telescope.diameter)


def _flat(dumped: Mapping[str, Any]) -> dict[str, Any]:
    telescope = {f"telescope.{key}": value for key, value in dumped["telescope"].items()}
    band = {"band": dumped["band"]["name"]} | {
        f"band.{k}": v for k, v in dumped["band"].items() if k not in ("name", "provenance")
    }
    return {key: value for key, value in dumped.items() if key not in ("telescope", "band")} | telescope | band


def _name(base: str, told: str) -> str:
    name = f"{base} ({told})"
    return name if len(name) <= LONGEST_NAME else f"{base} (variant {hashlib.blake2b(told.encode(), digest_size=4).hexdigest()})"
