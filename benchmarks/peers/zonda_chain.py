"""zonda's whole MUSTANG-2 chain, sky to map: python zonda_chain.py CASE.npz. The second of two
runs, and the first.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any

from common import case, cpu, peak, report

import zonda

CLUSTER = (
    files("zonda.pipelines") / "data" / "merging_cluster.fits"
)  # in an installed package and in this tree


def run(c: dict[str, Any]) -> dict[str, float]:
    start = cpu()
    scene = zonda.Scene(
        site="chajnantor", instrument="mustang2", time=c["date"], target="17h20m -23d", seed=1
    )
    zonda.Pipeline(
        [
            zonda.PointingDaisy(
                radius="4 arcmin",
                speed="50 arcsec/s",
                scan_duration=f"{c['duration']} s",
                sample_rate=f"{c['rate']} Hz",
            ),
            zonda.SkyMap(file=CLUSTER, centre="target"),
            zonda.AtmosphereLayers(pwv="1 mm", pwv_rms="3 %"),
            zonda.WhiteNoise(),
            zonda.PinkNoise(),
            zonda.Efficiency(),
            zonda.HighpassFilter(frequency="0.08 Hz"),
            zonda.CommonModeFilter(modes=1),
            zonda.BinMap(pixel="2 arcsec", width="15 arcmin"),
        ]
    ).run(scene, threads=1)
    return {"simulation": cpu() - start, "mapping": 0.0}


if __name__ == "__main__":
    given, before = case(), peak()
    first = run(given)["simulation"]
    report(before=before, first=first, **run(given), peak=peak(), version=zonda.__version__)
