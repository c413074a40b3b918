"""Turbulence that bands of one camera see at the same points: evaluated once, with the bits that each band has alone."""

from __future__ import annotations

import gc
from typing import Any
from weakref import WeakSet

import numpy as np
import pytest

import zonda
from zonda.core.shared import SharedScan
from zonda.operators.atmosphere.turbulence import lattice
from zonda.operators.atmosphere.turbulence.sampling import DriftingLayers
from zonda.operators.atmosphere.turbulence.tiles import Tiles

BANDS = {"f090": ("77 GHz", "106 GHz"), "f150": ("130 GHz", "170 GHz"), "f220": ("190 GHz", "250 GHz")}
CASES = {"of each detector": ("6 deg", "6 m"), "at nodes": ("4 arcmin", "50 m")}
"""Field and dish: so wide that each of the detectors is evaluated by itself; so narrow that four nodes serve."""


def scene(field: str, *names: str, dish: str = "6 m", detectors: int = 19, **changes: Any) -> zonda.Scene:
    bands = [{"name": n, "low": BANDS[n][0], "high": BANDS[n][1]} for n in names]
    camera = zonda.Instrument(
        name="camera", telescope={"name": "dish", "diameter": dish}, detectors=detectors, field_of_view=field, net="1 mK s(1/2)",
        main_beam_efficiency=0.8, illumination_efficiency=0.9, sample_rate="50 Hz",
        **({"bands": bands} if len(names) > 1 else {"band": bands[0]}), **changes,
    )  # fmt: skip
    return zonda.Scene(site="llano_de_chajnantor", instrument=camera, time="2022-08-01T23:00", target="260d -10d", seed=3)


def run(where: zonda.Scene, **settings: Any) -> zonda.Data:
    """Two scans of 40 s."""
    steps = [
        zonda.PointingDaisy(radius="1 deg", speed="20 arcmin/s", scan_duration="40 s", scans=2),
        zonda.AtmosphereLayers(pwv="1 mm", pwv_rms="2 %", layers=4, tolerance="1 %"),
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="0.1 Hz"),
        zonda.CommonModeFilter(),
        zonda.BinMap(pixel="2 arcmin"),
    ]
    return zonda.Pipeline(steps).run(where, **settings)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What is evaluated, by the bands it is for, and how many lattice points are drawn."""
    found: dict[str, Any] = {"bands": [], "points": 0}
    of_bands, normals = DriftingLayers.of_bands, lattice.lattice_normals

    def watched(self: DriftingLayers, bands: tuple[int, ...], *rest: Any) -> Any:
        found["bands"].append(bands)
        return of_bands(self, bands, *rest)

    def counted(*of: Any) -> Any:
        values = normals(*of)
        found["points"] += values.size
        return values

    monkeypatch.setattr(DriftingLayers, "of_bands", watched)
    monkeypatch.setattr(lattice, "lattice_normals", counted)
    return found


@pytest.mark.parametrize(("field", "dish"), CASES.values(), ids=CASES)
def test_it_is_evaluated_once_and_has_the_bits_of_a_band_alone(field: str, dish: str, drawn: dict[str, Any]) -> None:
    together = run(scene(field, *BANDS, dish=dish), keep=["atmosphere"], threads=1)
    assert set(drawn["bands"]) == {(0, 1, 2)}
    points, drawn["points"] = drawn["points"], 0
    for name in BANDS:
        alone = run(scene(field, name, dish=dish), keep=["atmosphere"], threads=2)
        for scan in range(2):
            other = together.tod("atmosphere", f"scan-{scan:03d}-{name}")
            np.testing.assert_array_equal(alone.tod("atmosphere", scan), other)
        np.testing.assert_array_equal(alone["map"].signal, together[f"map_{name}"].signal)
        others = ", ".join(n for n in BANDS if n != name)
        told = [text for label, what, text in together.tally if what == "turbulence beside other bands" and label.endswith(name)]
        assert told == [f"evaluated once with that of {others}"]
    assert points == drawn["points"] / len(BANDS)  # the random numbers of one band


@pytest.mark.parametrize("room", [0, 4000, 1 << 30])
@pytest.mark.parametrize("threads", [1, 3])
def test_room_and_threads_change_no_bit(room: int, threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is no room for a band to come, it evaluates its own; what is kept is within the room and given back."""
    alone = run(scene("6 deg", "f150"), keep=["signal"], threads=1)
    kept: list[int] = []
    made, claim = SharedScan.__init__, SharedScan.claim

    def begin(self: SharedScan, _: int) -> None:
        made(self, room)

    def watched(self: SharedScan, size: int) -> bool:
        granted = claim(self, size)
        kept.append(self.room - self._free)
        return granted

    monkeypatch.setattr(SharedScan, "__init__", begin)
    monkeypatch.setattr(SharedScan, "claim", watched)
    both = run(scene("6 deg", "f090", "f150"), keep=["signal"], threads=threads)
    for scan in range(2):
        np.testing.assert_array_equal(alone.tod(scan=scan), both.tod(scan=f"scan-{scan:03d}-f150"))
    assert 0 <= min(kept) <= max(kept) <= room
    assert (max(kept) > 0) is (room > 4000)
    assert kept[-1] == 0


def test_streams_that_are_made_again_have_the_same_bits() -> None:
    """In so little memory that streams are spilled or made again."""
    where = scene("6 deg", "f090", "f150", detectors=217)
    ample, little = (run(where, threads=1, memory=memory) for memory in (1 << 30, 3_000_000))
    assert any("stream" in what for _, what, _ in little.tally)
    for name in ("f090", "f150"):
        np.testing.assert_array_equal(ample[f"map_{name}"].signal, little[f"map_{name}"].signal)


def test_bands_whose_detectors_stand_elsewhere_evaluate_their_own(drawn: dict[str, Any]) -> None:
    data = run(scene("6 deg", "f090", "f150", pixels="separate"), threads=1)
    assert set(drawn["bands"]) == {(0,)}
    assert [text for _, what, text in data.tally if what == "turbulence beside other bands"] == [
        "evaluated by itself: other nodes or steps"
    ] * 2


@pytest.mark.parametrize("pixels", ["shared", "separate"])
@pytest.mark.parametrize(("field", "dish"), CASES.values(), ids=CASES)
def test_tiles_are_released_with_the_last_band_that_needs_them(
    field: str, dish: str, pixels: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not only when the scan is done: tiles take up to 512 MB for each set of nodes, which no forecast counts."""
    alive: WeakSet[Tiles] = WeakSet()
    begin, forget, left = Tiles.__init__, SharedScan.forget, []

    def born(self: Tiles) -> None:
        begin(self)
        alive.add(self)

    def watched(self: SharedScan) -> None:
        gc.collect()
        left.append(len(alive))
        forget(self)

    monkeypatch.setattr(Tiles, "__init__", born)
    monkeypatch.setattr(SharedScan, "forget", watched)
    run(scene(field, "f090", "f150", dish=dish, pixels=pixels), threads=1)
    assert left == [0, 0]
