"""Turbulence that bands of one camera look through: its tiles are made once, with the bits that
each band has alone.
"""

from __future__ import annotations

import gc
from typing import Any
from weakref import WeakSet

import numpy as np
import pytest

import zonda
from zonda.core.run.execution import Execution
from zonda.operators.atmosphere.turbulence import lattice, tiles
from zonda.operators.atmosphere.turbulence.tiles import Tiles

BANDS = {
    "f090": ("77 GHz", "106 GHz"),
    "f150": ("130 GHz", "170 GHz"),
    "f220": ("190 GHz", "250 GHz"),
}
CASES = {"of each detector": ("6 deg", "6 m"), "at nodes": ("4 arcmin", "50 m")}
"""Field and dish: so wide that each of the detectors is evaluated by itself; so narrow that four
nodes serve.
"""


def scene(
    field: str, *names: str, dish: str = "6 m", detectors: int = 19, **changes: Any
) -> zonda.Scene:
    bands = [{"name": n, "low": BANDS[n][0], "high": BANDS[n][1]} for n in names]
    camera = zonda.Instrument(
        name="camera",
        telescope={"name": "dish", "diameter": dish},
        detectors=detectors,
        field_of_view=field,
        net="1 mK s(1/2)",
        main_beam_efficiency=0.8,
        illumination_efficiency=0.9,
        sample_rate="50 Hz",
        **({"bands": bands} if len(names) > 1 else {"band": bands[0]}),
        **changes,
    )
    return zonda.Scene(
        site="llano_de_chajnantor",
        instrument=camera,
        time="2022-08-01T23:00",
        target="260d -10d",
        seed=3,
    )


def run(
    where: zonda.Scene, tolerance: str = "1 %", response: Any = "layer", **settings: Any
) -> zonda.Data:
    """Two scans of 40 s."""
    steps = [
        zonda.PointingDaisy(radius="1 deg", speed="20 arcmin/s", scan_duration="40 s", scans=2),
        zonda.AtmosphereLayers(
            pwv="1 mm", pwv_rms="2 %", layers=4, tolerance=tolerance, layer_response=response
        ),
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="0.1 Hz"),
        zonda.CommonModeFilter(),
        zonda.BinMap(pixel="2 arcmin"),
    ]
    return zonda.Pipeline(steps).run(where, **settings)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How many lattice points are drawn."""
    found, normals = {"points": 0}, lattice.lattice_normals

    def counted(*of: Any) -> Any:
        values = normals(*of)
        found["points"] += values.size
        return values

    monkeypatch.setattr(lattice, "lattice_normals", counted)
    return found


def told_of(data: zonda.Data, what: str) -> dict[str, str]:
    """By band."""
    return {label.split()[-1]: text for label, name, text in data.log if name == what}


@pytest.mark.parametrize(("field", "dish"), CASES.values(), ids=CASES)
def test_tiles_are_made_once_and_have_the_bits_of_a_band_alone(
    field: str, dish: str, drawn: dict[str, int]
) -> None:
    together = run(scene(field, *BANDS, dish=dish), keep=["atmosphere"], threads=1)
    points, drawn["points"] = drawn["points"], 0
    for name in BANDS:
        alone = run(scene(field, name, dish=dish), keep=["atmosphere"], threads=2)
        for scan in range(2):
            other = together.tod("atmosphere", f"scan-{scan:03d}-{name}")
            np.testing.assert_array_equal(alone.tod("atmosphere", scan), other)
        np.testing.assert_array_equal(alone["map"].signal, together[f"map_{name}"].signal)
        others = ", ".join(f"{n} (4 of 4 layers)" for n in BANDS if n != name)
        assert (
            told_of(together, "turbulence beside other bands")[name]
            == f"lattices made once with those of {others}"
        )
    assert points == drawn["points"] / len(BANDS)  # the random numbers of one band


OTHERS = {
    "steps": ("6 deg", 19, "0.46 %", "step in time"),
    "steps at nodes": ("20 arcmin", 127, "1.2 %", "step in time"),
    "nodes": ("20 arcmin", 127, "1.8 %", "nodes"),
    "nodes beside none": ("20 arcmin", 127, "0.62 %", "nodes"),
}
"""Field, detectors, tolerance, and what then differs between f090 and f150 where layers respond as
the column does.
"""


@pytest.mark.parametrize(("threads", "response"), [(1, "column"), (2, "layer")])
@pytest.mark.parametrize(("field", "detectors", "tolerance", "what"), OTHERS.values(), ids=OTHERS)
def test_bands_of_other_nodes_and_steps_share_tiles(
    field: str,
    detectors: int,
    tolerance: str,
    what: str,
    threads: int,
    response: str,
    drawn: dict[str, int],
) -> None:
    names = "f090", "f150"
    both = run(
        scene(field, *names, detectors=detectors),
        tolerance,
        response,
        keep=["atmosphere"],
        threads=threads,
    )
    points, drawn["points"] = drawn["points"], 0
    assert (
        len({text.split(";")[0] for text in told_of(both, what).values()}) == 2
        or response == "layer"
    )
    for name, other in (names, names[::-1]):
        told = told_of(both, "turbulence beside other bands")[name]
        assert told == f"lattices made once with those of {other} (4 of 4 layers)"
        alone = run(
            scene(field, name, detectors=detectors),
            tolerance,
            response,
            keep=["atmosphere"],
            threads=1,
        )
        for scan in range(2):
            np.testing.assert_array_equal(
                alone.tod("atmosphere", scan), both.tod("atmosphere", f"scan-{scan:03d}-{name}")
            )
    assert points < 0.6 * drawn["points"]


def test_tiles_that_are_dropped_are_made_again_for_a_band_alone(
    drawn: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where there is no room to keep them for a band to come, whose step in time is another."""
    steps = "0.46 %"
    alone = run(scene("6 deg", "f150"), steps, "column", keep=["signal"], threads=1)
    points, drawn["points"] = drawn["points"], 0
    monkeypatch.setattr(tiles, "BYTES_KEPT", 0)
    both = run(scene("6 deg", "f090", "f150"), steps, "column", keep=["signal"], threads=1)
    for scan in range(2):
        np.testing.assert_array_equal(alone.tod(scan=scan), both.tod(scan=f"scan-{scan:03d}-f150"))
    assert drawn["points"] >= 2 * points


def test_bands_that_look_alike_need_no_room_for_tiles_of_each(
    drawn: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are interpolated together."""
    run(scene("6 deg", "f150"), threads=1)
    points, drawn["points"] = drawn["points"], 0
    monkeypatch.setattr(tiles, "BYTES_KEPT", 0)
    run(scene("6 deg", "f090", "f150"), threads=1)
    assert drawn["points"] == points


@pytest.mark.parametrize(
    ("tolerance", "steps"), [("1 %", 1), ("0.5 %", 2)], ids=["same steps", "other steps"]
)
def test_streams_that_are_made_again_have_the_same_bits(tolerance: str, steps: int) -> None:
    """In so little memory that streams are spilled or made again."""
    where = scene("6 deg", "f090", "f150", detectors=217)
    ample, little = (
        run(where, tolerance, "column", threads=1, memory=memory) for memory in (1 << 30, 3_000_000)
    )
    assert any("stream" in what for _, what, _ in little.log)
    assert len({text.split(";")[0] for text in told_of(little, "step in time").values()}) == steps
    for name in ("f090", "f150"):
        np.testing.assert_array_equal(ample[f"map_{name}"].signal, little[f"map_{name}"].signal)


def test_bands_whose_detectors_stand_elsewhere_make_their_own() -> None:
    data = run(scene("6 deg", "f090", "f150", pixels="separate"), threads=1)
    own = "lattices of its own: other beams or directions"
    assert told_of(data, "turbulence beside other bands") == {"f090": own, "f150": own}


@pytest.mark.parametrize("pixels", ["shared", "separate"])
@pytest.mark.parametrize(("field", "dish"), CASES.values(), ids=CASES)
def test_tiles_are_released_with_the_last_band_that_needs_them(
    field: str, dish: str, pixels: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not only when the scan is done: tiles take up to 512 MB for each set of nodes, which no
    forecast counts.
    """
    alive: WeakSet[Tiles] = WeakSet()
    begin, execute, left = Tiles.__init__, Execution.run, []

    def born(self: Tiles) -> None:
        begin(self)
        alive.add(self)

    def watched(self: Execution, *arguments: Any) -> None:
        execute(self, *arguments)
        gc.collect()
        last = self.views[-1].observation.instrument.band.name == "f150"
        left.extend([len(alive)] if last else [])

    monkeypatch.setattr(Tiles, "__init__", born)
    monkeypatch.setattr(Execution, "run", watched)
    run(scene(field, "f090", "f150", dish=dish, pixels=pixels), threads=1)
    assert left == [0, 0]
