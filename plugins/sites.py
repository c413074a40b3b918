"""Built-in sites."""

from __future__ import annotations

from zonda.core.site import Site


def green_bank() -> Site:
    """Green Bank Observatory, West Virginia."""
    return Site(
        name="green_bank",
        description="Green Bank Observatory, West Virginia, USA",
        latitude="38.4331 deg",
        longitude="-79.8398 deg",
        altitude="825 m",
        climatology="green_bank",
        provenance="van Marrewijk, Morris et al. 2024 (position); maria 1.5.1 site table (825 m; the paper's Table 1 says 818 m)",
    )
