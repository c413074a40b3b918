"""maria's tutorials with our map in place of those that it downloads: python maria_tutorials.py mustang|custom MAP.fits

Pictures are left out. ``MARIA_CACHE_DIR`` is a folder with the tables that `maria_tables.write_tables` makes for
the two sites, so that nothing is downloaded. docs/coming_from_maria.md has the figures.
"""

from __future__ import annotations

import json
import sys
import time
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
        scan_pattern="daisy", scan_options={"radius": 2 / 60, "speed": 0.5 / 60}, duration=600, sample_rate=50,
        scan_center=centre, frame="ra/dec", start_time="2024-11-25T07:00:00", site="green_bank",
    )  # fmt: skip
    tods = maria.Simulation(
        maria.get_instrument("MUSTANG-2"), plans=[plan], site="green_bank", map=sky, atmosphere="2d", progress_bars=False
    ).run()
    return BinMapper(
        tods=tods, center=centre, frame="ra/dec", width=6 / 60, height=6 / 60, resolution=0.03 / 60, units="uK_RJ",
        tod_preprocessing={"remove_modes": {"modes_to_remove": 1}, "remove_spline": {"knot_spacing": 30}}, progress_bars=False,
    ).run()  # fmt: skip


def custom(path: str) -> Any:
    """A camera of two bands made from scratch, 25 m, half a degree, a daisy of fifteen minutes at 50 Hz."""
    centre = (291.156, -31.23)
    bands = [Band(center=nu, width=width, NET_RJ=net, knee=1.0) for nu, width, net in ((90e9, 20e9, 40e-6), (150e9, 30e9, 60e-6))]
    array = {"field_of_view": 0.5, "shape": "circle", "beam_spacing": 1.5, "primary_size": 25, "bands": bands}
    sky = maria.map.load(path, nu=150e9, units="K_RJ", center=centre)
    plan = maria.Plan.generate(
        start_time="2024-08-06T03:00:00", scan_pattern="daisy", scan_options={"radius": 0.5, "speed": 0.1}, duration=900,
        sample_rate=50, scan_center=centre, frame="ra/dec", site="llano_de_chajnantor",
    )  # fmt: skip
    tods = maria.Simulation(
        maria.get_instrument(array=array), plans=[plan], site="llano_de_chajnantor", atmosphere="2d",
        atmosphere_kwargs={"weather": {"pwv": 0.5}}, map=sky, progress_bars=False,
    ).run()  # fmt: skip
    return BinMapper(
        tods=tods, center=centre, frame="ra/dec", width=1.0, height=1.0, resolution=1.0 / 256, units="mK_RJ",
        tod_preprocessing={"remove_modes": {"modes_to_remove": 1}, "remove_spline": {"knot_spacing": 30}}, progress_bars=False,
    ).run()  # fmt: skip


if __name__ == "__main__":
    quiet()
    wall, cpu = time.perf_counter(), time.process_time()
    {"mustang": mustang, "custom": custom}[sys.argv[1]](sys.argv[2])
    print(json.dumps({"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu, "version": maria.__version__}))
