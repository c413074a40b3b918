"""HDF5 of sotodlib's `AxisManager.save`, written with h5py alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

NAMES = ["a", "b", "c", "d", "dark", "lost"]
N, RATE = 400, 50.0
TURNS = [(0, 20), (200, 220), (380, 400)]
LEFT, RIGHT = [(20, 200)], [(220, 380)]


def spans(rows: list[list[tuple[int, int]]]) -> dict[str, Any]:
    """A RangesMatrix as sotodlib flattens it; of one row it is a Ranges."""
    flat = [edge for row in rows for pair in row for edge in pair]
    shape = [N] if len(rows) == 1 else [len(rows), N]
    ends = np.cumsum([2 * len(row) for row in rows])
    return {"shape": np.array(shape), "intervals": np.array(flat, np.int32), "ends": ends}


def content() -> dict[str, Any]:
    """Fields of a recorded scan: two bands, a dark detector and one without a place."""
    t = np.arange(N) / RATE
    names = np.array(NAMES, "S")
    glitch = [[(100, 110)], [], [], [(300, 301), (310, 320)], [], []]
    whole = [[], [(0, N)], [], [], [], []]
    return {
        "timestamps": 1.75e9 + t,
        "signal": np.arange(6.0)[:, None] * 1e-3 + np.sin(t),
        "boresight": {
            "az": np.radians(180 + 5 * np.sin(2 * np.pi * t / 8)),
            "el": np.full(N, np.radians(50)),
            "roll": np.full(N, np.radians(10)),
        },
        "focal_plane": {
            "xi": np.array([0.01, 0.01, -0.02, -0.02, 0.0, np.nan]),
            "eta": np.array([0.03, 0.03, 0.0, 0.0, 0.0, np.nan]),
            "gamma": np.radians([0, 90, 45, 135, 0, np.nan]),
        },
        "flags": {
            "turnarounds": spans([TURNS]),
            "left_scan": spans([LEFT]),
            "right_scan": spans([RIGHT]),
            "glitches": spans(glitch),
            "slow": spans(whole),
            "gap": spans([[(150, 160)]] * 6),
            "source_flags": spans([[(250, 255)]] * 6),
        },
        "hwp_angle": (2 * np.pi * 2 * t) % (2 * np.pi),
        "det_info": {
            "readout_id": names,
            "wafer_slot": np.array(["ws0"] * 3 + ["ws1"] * 3, "S"),
            "wafer": {"bandpass": np.array(["f090"] * 2 + ["f150"] * 2 + ["NC", "f150"], "S")},
        },
        "obs_info": {"obs_id": "obs_1750000000_satp1_1111111", "telescope": "satp1"},
    }


def write(group: Any, fields: dict[str, Any], units: dict[str, str] | None = None) -> None:
    """Write fields as sotodlib's `_save_axisman` does: arrays of (dets, samps), (samps,) or (dets,)."""
    axes = {(N,): ["samps"], (len(NAMES),): ["dets"], (len(NAMES), N): ["dets", "samps"]}
    schema: list[dict[str, Any]] = []
    scalars = {}
    for name, value in fields.items():
        item: dict[str, Any] = {"name": name, "axes": [None]}
        if isinstance(value, dict) and "intervals" in value:
            item |= {"encoding": "rangesmatrix", "axes": axes.get(tuple(value["shape"]), [None])}
            for key, array in value.items():
                group.create_dataset(f"{name}/{key}", data=array)
        elif isinstance(value, dict):
            item |= {"encoding": "axisman", "subclass": "AxisManager"}
            write(group.create_group(name), value)
        elif isinstance(value, np.ndarray):
            encoding = "quantity" if name in (units or {}) else "ndarray"
            item |= {"encoding": encoding, "axes": axes.get(value.shape, [None])}
            group.create_dataset(name, data=value)
        else:
            item["encoding"] = "scalar"
            scalars[name] = value
        schema.append(item)
    label = {"name": "dets", "encoding": "axis", "type": "label", "args": ["dets", NAMES]}
    offset = {"name": "samps", "encoding": "axis", "type": "offset", "args": ["samps", N, 0, "x"]}
    group.attrs["_axisman"] = json.dumps({"version": 0, "schema": [*schema, label, offset]})
    group.attrs["_scalars"] = json.dumps(scalars)
    group.attrs["_units"] = json.dumps(units or {})


def saved(path: Path, units: dict[str, str] | None = None, **changes: Any) -> Path:
    """A file of `content` with fields changed."""
    with h5py.File(path, "w") as file:
        write(file, content() | changes, units)
    return path
