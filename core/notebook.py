"""How objects look in notebooks."""

from __future__ import annotations

from html import escape
from typing import Any


def html_table(title: str, rows: list[tuple[Any, Any]]) -> str:
    """A two-column table for notebooks; everything is escaped."""
    body = "".join(
        f"<tr><th style='text-align:left'>{escape(str(a))}</th><td>{escape(str(b))}</td></tr>"
        for a, b in rows
    )
    return f"<table><caption>{escape(title)}</caption>{body}</table>"
