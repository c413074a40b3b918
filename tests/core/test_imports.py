"""What a run of the shipped MUSTANG-2 pipeline imports before its first block: each of these takes
0.1 s or more.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

HEAVY = {
    "astropy.visualization",
    "h5py",
    "healpy",
    "matplotlib",
    "scipy.interpolate",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.sparse",
    "scipy.spatial",
    "scipy.stats",
}

RUN = """
import os, sys
from zonda.core import cli
from zonda.core.run.block_maker import BlockMaker

def first_block(*arguments, **named):
    print(*sorted(sys.modules))
    sys.stdout.flush()
    os._exit(0)

BlockMaker.make = first_block
cli.main(["run", "mustang2_cluster", "--output", sys.argv[1], "--threads", "1",
          "--set", "PointingDaisy.scan_duration=20 s", "--set", "PointingDaisy.scans=2"])
"""


def test_a_run_imports_nothing_heavy_before_its_first_block(tmp_path: Path) -> None:
    own = {
        **os.environ,
        "ZONDA_CACHE_DIR": str(tmp_path / "cache"),
    }
    for _ in range(2):  # the first compiles
        done = subprocess.run(
            [sys.executable, "-c", RUN, str(tmp_path / "out")],
            capture_output=True,
            text=True,
            env=own,
        )
        assert done.returncode == 0, done.stderr
    found = set(done.stdout.split())
    assert "zonda.operators.maps.bin_map" in found
    assert not sorted(found & HEAVY)
