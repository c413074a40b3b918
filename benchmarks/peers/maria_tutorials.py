"""maria's tutorials with our map in place of those that it downloads: python maria_tutorials.py
NAME MAP.fits

NAME is ``mustang`` (`mustang-galaxy`), ``cluster`` (`MUSTANG-2_cluster`), ``custom``
(`custom-map-simulations`), ``transfer`` (`transfer-functions`) or ``transfer-150`` (its array at
150 GHz alone). Pictures are left out. ``MARIA_CACHE_DIR`` is a folder with the tables that
`maria_tables.write_tables` makes for the two sites, so that nothing is downloaded.
docs/coming_from_maria.md has the figures.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from typing import Any

import maria
from maria.band import Band
from maria.mappers import BinMapper
from maria_observation import quiet


def mustang(path: str) -> Any:
    """MUSTANG-2, a daisy of ten minutes, 50 Hz."""
    centre = (75.0, 20.0)
    sky = maria.map.load(path, nu=93e9, units="K_RJ", center=centre)
    plan = maria.Plan.generate(
        scan_pattern="daisy",
        scan_options={"radius": 2 / 60, "speed": 0.5 / 60},
        duration=600,
        sample_rate=50,
        scan_center=centre,
        frame="ra/dec",
        start_time="2024-11-25T07:00:00",
        site="green_bank",
    )
    tods = maria.Simulation(
        maria.get_instrument("MUSTANG-2"),
        plans=[plan],
        site="green_bank",
        map=sky,
        atmosphere="2d",
        progress_bars=False,
    ).run()
    return BinMapper(
        tods=tods,
        center=centre,
        frame="ra/dec",
        width=6 / 60,
        height=6 / 60,
        resolution=0.03 / 60,
        units="uK_RJ",
        tod_preprocessing={
            "remove_modes": {"modes_to_remove": 1},
            "remove_spline": {"knot_spacing": 30},
        },
        progress_bars=False,
    ).run()


def cluster(path: str) -> Any:
    """MUSTANG-2, a daisy of twenty minutes, 50 Hz; without the random CMB, whose spectrum would be
    downloaded.
    """
    centre = (150.0, 10.0)
    sky = maria.map.load(path, nu=93e9, units="K_RJ", center=centre)
    plan = maria.Plan.generate(
        start_time="2024-11-25T11:00:00",
        scan_pattern="daisy",
        scan_options={"radius": 0.05, "speed": 0.01},
        duration=1200,
        sample_rate=50,
        scan_center=centre,
        frame="ra/dec",
        site="green_bank",
    )
    tods = maria.Simulation(
        maria.get_instrument("MUSTANG-2"),
        plans=[plan],
        site="green_bank",
        map=sky,
        atmosphere="2d",
        progress_bars=False,
    ).run()
    return BinMapper(
        tods=tods,
        center=centre,
        frame="ra/dec",
        width=0.1,
        height=0.1,
        resolution=2e-4,
        units="uK_RJ",
        progress_bars=False,
        tod_preprocessing={
            "window": {"name": "hamming"},
            "remove_modes": {"modes_to_remove": 1},
            "remove_spline": {"knot_spacing": 10},
        },
        map_postprocessing={"gaussian_filter": {"sigma": 1}},
    ).run()


def transfer(path: str, arrays: Sequence[str] = ("array-1", "array-3")) -> Any:
    """Two arrays of TolTEC (1172 and 4012 detectors), a daisy of six minutes, and the transfer
    function of the map.
    """
    from maria.instrument import Instrument, get_instrument_config

    config = get_instrument_config("TolTEC")
    config["arrays"] = {name: config["arrays"][name] for name in arrays}
    maps = [
        maria.map.load(path, nu=nu, units="K_RJ", center=(75.0, -20.0)) for nu in (150e9, 270e9)
    ]
    sky = maria.map.concatenate(maps, dim="nu") if len(arrays) > 1 else maps[0]
    planner = maria.Planner(
        target=sky,
        start_time="2024-01-01T22:00:00",
        site="llano_de_chajnantor",
        constraints={"el": (60, 90)},
    )
    plans = planner.generate_plans(
        total_duration=360,
        max_chunk_duration=3600,
        scan_options={"radius": 6.5 / 60, "miss_factor": 0.3},
    )
    tods = maria.Simulation(
        Instrument.from_config(config),
        plans=plans,
        site="llano_de_chajnantor",
        map=sky,
        atmosphere="2d",
        progress_bars=False,
    ).run()
    print(f"{sum(tod.signal.size for tod in tods)} samples")
    output = BinMapper(
        tods=tods,
        units="uK_RJ",
        stokes="I",
        resolution=sky.resolution,
        progress_bars=False,
        map_postprocessing={},
        tod_preprocessing={
            "remove_modes": {"modes_to_remove": 1},
            "remove_spline": {"knot_spacing": 60, "remove_el_gradient": True},
        },
    ).run()
    return output.transfer_function(window=True)


def transfer_150(path: str) -> Any:
    """The array at 150 GHz alone, which needs less memory."""
    return transfer(path, ["array-1"])


def custom(path: str) -> Any:
    """A camera of two bands made from scratch, 25 m, half a degree, a daisy of fifteen minutes at
    50 Hz.
    """
    centre = (291.156, -31.23)
    bands = [
        Band(center=nu, width=width, NET_RJ=net, knee=1.0)
        for nu, width, net in ((90e9, 20e9, 40e-6), (150e9, 30e9, 60e-6))
    ]
    array = {
        "field_of_view": 0.5,
        "shape": "circle",
        "beam_spacing": 1.5,
        "primary_size": 25,
        "bands": bands,
    }
    sky = maria.map.load(path, nu=150e9, units="K_RJ", center=centre)
    plan = maria.Plan.generate(
        start_time="2024-08-06T03:00:00",
        scan_pattern="daisy",
        scan_options={"radius": 0.5, "speed": 0.1},
        duration=900,
        sample_rate=50,
        scan_center=centre,
        frame="ra/dec",
        site="llano_de_chajnantor",
    )
    tods = maria.Simulation(
        maria.get_instrument(array=array),
        plans=[plan],
        site="llano_de_chajnantor",
        atmosphere="2d",
        atmosphere_kwargs={"weather": {"pwv": 0.5}},
        map=sky,
        progress_bars=False,
    ).run()
    return BinMapper(
        tods=tods,
        center=centre,
        frame="ra/dec",
        width=1.0,
        height=1.0,
        resolution=1.0 / 256,
        units="mK_RJ",
        tod_preprocessing={
            "remove_modes": {"modes_to_remove": 1},
            "remove_spline": {"knot_spacing": 30},
        },
        progress_bars=False,
    ).run()


if __name__ == "__main__":
    quiet()
    wall, cpu = time.perf_counter(), time.process_time()
    tutorials = {
        "mustang": mustang,
        "cluster": cluster,
        "custom": custom,
        "transfer": transfer,
        "transfer-150": transfer_150,
    }
    tutorials[sys.argv[1]](sys.argv[2])
    print(
        json.dumps(
            {
                "wall": time.perf_counter() - wall,
                "cpu": time.process_time() - cpu,
                "version": maria.__version__,
            }
        )
    )
