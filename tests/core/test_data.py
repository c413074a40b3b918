"""Counts and their shares."""

from __future__ import annotations

import pytest

from zonda.core.data import Log, percent


def test_counts_are_told_with_their_share():
    """Parts and wholes are added up over scans; what happened to none has no share, nor what was
    counted among nothing.
    """
    log, other = Log(), Log()
    log.count("SkyMap", "samples outside", 30, 1000)
    other.count("SkyMap", "samples outside", 173, 0)
    other.count("SkyMap", "samples outside", 0, 3000)
    other.count("BinMap", "samples dropped", 0, 3000)
    other.count("BinMap", "pixels", 5)
    other.state("BinMap", "weights", "uniform")
    log.update(other, prefix="")
    assert list(log.told()) == [
        ("BinMap", "pixels", "5"),
        ("BinMap", "samples dropped", "0"),
        ("BinMap", "weights", "uniform"),
        ("SkyMap", "samples outside", "203 (5.08 %)"),  # of 4000
    ]
    assert ("SkyMap", "samples outside", "203") in list(log)  # files keep the number
    log.update(other, prefix="source_free/")
    assert ("source_free/SkyMap", "samples outside", "173 (5.77 %)") in list(log.told())


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.20345, "20.3 %"),
        (1.0, "100 %"),
        (0.99999, "more than 99.9 %"),
        (1e-9, "1e-07 %"),
        (0.5, "50 %"),
    ],
)
def test_shares_are_readable(share, text):
    assert percent(share) == text
