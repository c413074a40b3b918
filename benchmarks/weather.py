"""What the weather costs: loading, one profile, the water by month, and the largest focal plane.

python benchmarks/weather.py
"""

from __future__ import annotations

import subprocess
import sys
from time import perf_counter

LOAD = """
import numpy, zonda.core.site, zonda.core.registry, zonda.core.configuration.time
from zonda.operators.atmosphere.weather import absorption, climatology
from time import perf_counter
site = zonda.core.registry.sites.create("chajnantor")
when = zonda.core.configuration.time.Instant.parse("2022-08-01T23:00")
start = perf_counter()
climatology.profile(site, when)
first = perf_counter()
absorption.absorption_table()
table = perf_counter()
for hour in range(100):
    climatology.profile(site, when.shifted(3600 * hour))
print(first - start, table - first, (perf_counter() - table) / 100)
"""


def main() -> None:
    runs = [
        subprocess.run(
            [sys.executable, "-c", LOAD], capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(5)
    ]
    names = (
        "climatology loaded and first profile",
        "absorption table loaded",
        "each further profile",
    )
    for name, values in zip(names, zip(*runs, strict=True), strict=True):
        print(f"{name:40s} {1e3 * min(float(v) for v in values):8.2f} ms")

    from zonda.core.registry import instruments, sites
    from zonda.operators.atmosphere.weather.climatology import pwv_by_month

    start = perf_counter()
    pwv_by_month(sites.create("chajnantor"))
    print(f"{'water by month and hour (96 profiles)':40s} {1e3 * (perf_counter() - start):8.2f} ms")
    start = perf_counter()
    plane = instruments.create("atlast_full").focalplane()
    print(
        f"{f'focal plane of {len(plane)} detectors':40s} {1e3 * (perf_counter() - start):8.2f} ms"
    )


if __name__ == "__main__":
    main()
