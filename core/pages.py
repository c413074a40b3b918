"""HTML from jinja2 templates: reports, tables of claims and sweeps, objects in notebooks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def render(package: str, template: str, **values: Any) -> str:
    """The text of a template in the folder ``templates`` of a package, or in that of the core.

    Every value is escaped, unless it is `markupsafe.Markup`.
    """
    return _environment(package).get_template(template).render(**values)


def html_table(title: str, rows: Sequence[tuple[Any, Any]]) -> str:
    """A table of two columns that shows an object in a notebook."""
    return render("zonda.core", "notebook.html", title=title, rows=rows)


@cache
def _environment(package: str) -> Environment:
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    packages = dict.fromkeys((package, "zonda.core"))
    made = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in packages]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["code"] = code
    return made


def code(text: str) -> Markup:
    """Docstring text with single and double backquotes as code."""
    from markupsafe import Markup, escape

    plain = str(escape(" ".join(text.split())))
    return Markup(re.sub(r"``(.+?)``|`(.+?)`", lambda m: f"<code>{m[1] or m[2]}</code>", plain))
