"""Built-in passbands."""

from __future__ import annotations

from zonda.core.instrument import Band


def mustang2_90ghz() -> Band:
    """MUSTANG-2's band, taken as flat from 78 to 108 GHz."""
    return Band(name="mustang2_90ghz", low="78 GHz", high="108 GHz", provenance="van Marrewijk, Morris et al. 2024, Table 1")


def flat_150ghz() -> Band:
    """A flat band in the 2 mm atmospheric window."""
    return Band(
        name="flat_150ghz", low="128 GHz", high="172 GHz", provenance="a common choice for cosmic-microwave-background cameras"
    )
