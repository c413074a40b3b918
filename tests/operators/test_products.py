"""What steps add up over scans."""

from __future__ import annotations

from collections.abc import Iterator

from zonda.core.product import Product, Record
from zonda.core.registry import operators, products


def kinds(cls: type[Product]) -> Iterator[type[Product]]:
    """All that are derived from a class, at any depth."""
    for kind in cls.__subclasses__():
        yield from kinds(kind)
        yield kind


def test_processes_of_a_campaign_find_every_class_of_partial_products():
    for found in operators.candidates():
        if found.distribution == "zonda":
            operators.get(found.qualified)  # imports what it adds up
    own = {
        kind.__name__: kind
        for kind in kinds(Product)
        if kind is not Record and kind.__module__.startswith("zonda.operators")
    }
    assert {"MapSums", "Spectrum", "StreamComparison"} <= set(own)
    for name, kind in own.items():
        if kind.__subclasses__():  # a base class
            continue
        assert products.get(name) is kind
