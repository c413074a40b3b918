"""Variants of a registered instrument: ``{like: mustang2, detectors: 170}`` is MUSTANG-2 with 170
detectors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .band import PASSBAND, PER_BAND
from .configuration.diagnostics import mistake, nearest
from .configuration.parameters import named
from .registry import bands as registered_bands
from .registry import instruments

LIKE = "like"
"""Key that names what a variant differs from."""

LONGEST_NAME = 60
"""Characters of a name that lists the changes; of a longer list it has a hash."""


def is_variant(value: Any) -> bool:
    """True for the mapping of a variant."""
    return isinstance(value, Mapping) and LIKE in value


def variant(given: Mapping[str, Any], context: Any = None) -> Any:
    """The instrument ``given["like"]`` (a registered name or an Instrument) with the other keys of
    ``given`` changed.

    A mapping for ``telescope`` changes the keys that it names, and so does a band of ``bands`` that
    has the name of one of the instrument's; ``band`` is replaced as a whole. Where telescope or
    band change and ``fwhm`` is not given, the beam keeps its ratio to the diffraction limit. What
    bands may state for themselves, such as ``detectors`` or ``net``, holds for all of them where it
    is changed. Where ``name`` is not given it lists the changes and is the same however their units
    are written. A variant without changes is the instrument itself.

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
    if one_of(base, changes.get("band")):
        base = base.cameras[changes.pop("band")]
    elif changes.get("bands"):
        changes["band"] = None
    elif changes.get("band") is not None:
        _check_band(base, changes["band"], "band")
        changes["bands"] = []
    for_all = {
        key: None for key in PER_BAND if changes.get(key) is not None
    }  # stands above what the bands state
    own = [band.model_copy(update=for_all) for band in base.bands]
    if isinstance(changes.get("bands"), list):
        named_own = {band.name: band for band in own}
        changes["bands"] = [
            _as_in_base(base, named_own, k, band) for k, band in enumerate(changes["bands"])
        ]
    as_it_is = base.model_dump(mode="json") | {
        "telescope": base.telescope,
        "band": base.band,
        "bands": own,
    }
    if changes.get("layout", base.layout) != base.layout:
        as_it_is["wafers"] = 1
    if changes.get("focalplane") is not None:  # number and field follow from the table
        as_it_is |= {
            "detectors": None,
            "field_of_view": None,
            "polarization": "none",
            "layout": "hexagon",
            "wafers": 1,
        }
        as_it_is["bands"] = [band.model_copy(update={"detectors": None}) for band in own]
    made = type(base).model_validate(as_it_is | changes, context=context)
    if "fwhm" not in changes:
        made = _with_beams(base, made, kept="bands" not in changes)
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
    """Differences between two instruments but for their names and descriptions: (of ``base``, of
    ``other``) by key.
    """
    one, two = (_flat(x.model_dump(mode="json")) for x in (base, other))
    texts = ("name", "description", "provenance")
    return {
        key: (one.get(key), two.get(key))
        for key in {**one, **two}
        if one.get(key) != two.get(key) and key not in texts
    }


def written(given: Mapping[str, Any], made: Any) -> dict[str, Any]:
    """The mapping ``given`` of a variant that came to be ``made``, in units and full paths, to be
    read again.
    """
    dumped = made.model_dump(mode="json")
    found: dict[str, Any] = {LIKE: given[LIKE]} | {key: dumped[key] for key in given if key != LIKE}
    if one_of(named(instruments, given[LIKE]), given.get("band")):
        found["band"] = given["band"]
    if isinstance(changed := given.get("telescope"), Mapping):
        found["telescope"] = {key: dumped["telescope"].get(key, changed[key]) for key in changed}
    return found


def one_of(instrument: Any, band: Any) -> bool:
    """True if ``band`` is the name of one of the bands of an instrument that has several."""
    return isinstance(band, str) and any(
        own.name == band for own in getattr(instrument, "bands", ())
    )


def _check_band(base: Any, band: Any, *at: str | int) -> None:
    """Raise what a validator does where ``band`` is a name that neither ``base``, which has
    several, nor anything else has.
    """
    if isinstance(band, str) and base.bands and band not in registered_bands:
        names = [own.name for own in base.bands]
        cure = (
            f"its bands: {', '.join(names)}; or a registered band (`zonda plugins`), or give a"
            " passband: low, high or file"
        )
        raise mistake(f"{base.name} has no band {band!r}", nearest(band, names), cure, at=at)


def _as_in_base(base: Any, own: Mapping[str, Any], k: int, band: Any) -> Any:
    """The ``k``-th of the bands given. Without a passband it is the one of ``base`` with its name
    but for what is given.
    """
    given = {"name": band} if isinstance(band, str) else band
    if not isinstance(given, Mapping) or PASSBAND & {key for key, value in given.items() if value}:
        return band
    if given.get("name") in own:
        return own[given["name"]].model_dump(mode="json") | dict(given)
    _check_band(base, given.get("name"), "bands", k, "name")
    return band


def _with_beams(base: Any, made: Any, kept: bool) -> Any:
    """``made`` with beams that have the ratio to the diffraction limit that those of ``base`` have,
    where these are stated.

    ``kept``: it has the bands of ``base``.
    """
    if base.bands and made.bands:
        wider = base.telescope.diameter / made.telescope.diameter
        bands = [
            b.model_copy(update={"fwhm": b.fwhm and b.fwhm * wider}) if kept else b
            for b in made.bands
        ]
        return made.model_copy(update={"fwhm": base.fwhm and base.fwhm * wider, "bands": bands})
    if base.fwhm is None or base.bands or made.bands or _diffraction(made) == _diffraction(base):
        return made
    return made.model_copy(update={"fwhm": base.fwhm * _diffraction(made) / _diffraction(base)})


def _diffraction(instrument: Any) -> float:
    return 1.0 / float(instrument.band.centre * instrument.telescope.diameter)


def _flat(dumped: Mapping[str, Any]) -> dict[str, Any]:
    telescope = {f"telescope.{key}": value for key, value in dumped["telescope"].items()}
    bands: dict[str, Any] = {}
    for place, band in (
        ("band", dumped["band"]),
        *((f"bands.{b['name']}", b) for b in dumped["bands"]),
    ):
        bands |= {place: band["name"]} if band and place == "band" else {}
        bands |= {
            f"{place}.{k}": v for k, v in (band or {}).items() if k not in ("name", "provenance")
        }
    rest = {
        key: value for key, value in dumped.items() if key not in ("telescope", "band", "bands")
    }
    if rest.get("focalplane") is not None:  # the same in every folder
        rest["focalplane"] = Path(rest["focalplane"]).name
    return rest | telescope | bands


def _name(base: str, told: str) -> str:
    name = f"{base} ({told})"
    return (
        name
        if len(name) <= LONGEST_NAME
        else f"{base} (variant {hashlib.blake2b(told.encode(), digest_size=4).hexdigest()})"
    )
