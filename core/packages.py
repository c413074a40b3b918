"""Packages that come with an extra."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from .errors import InputError


def needed(module: str, extra: str, place: str = "") -> Any:
    """A module of a package that the extra ``extra`` installs. Raises InputError at ``place`` where
    it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as err:
        cure = f"pip install 'zonda[{extra}]'"
        raise InputError(
            f"cannot import {module}: {err}", place=place or f"zonda.interop.{extra}", cure=cure
        ) from None
