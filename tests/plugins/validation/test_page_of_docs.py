"""docs/validation.md shows the stored table, and the table has the rows of the shipped claims."""

import importlib.util
from pathlib import Path

from zonda.plugins.validation.claims import SHIPPED, Verdict, read

DOCS = Path(__file__).parents[3] / "docs"


def maker():
    spec = importlib.util.spec_from_file_location("make_validation", DOCS / "make_validation.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_that_of_the_stored_table():
    made = maker()
    assert made.PAGE.read_text(encoding="utf-8") == made.page(made.stored())


def test_the_stored_table_has_the_rows_of_the_shipped_claims():
    table, claims = maker().stored(), read(SHIPPED).claims
    assert list(table["id"]) == [claim.id for claim in claims]
    for row, claim in zip(table, claims, strict=True):
        assert row["claim"] == claim.claim
        assert row["unit"] == claim.paper.unit
        assert abs(row["paper"] * claim.paper.factor - claim.paper.value) <= 1e-8 * abs(
            claim.paper.value
        )
        assert Verdict(row["verdict"]).decided, row["id"]
