"""The twin of mustang2_cluster.yaml in Python: the same bits.

python -m zonda.pipelines.mustang2_cluster
"""

from __future__ import annotations

from pathlib import Path

import zonda


def scene() -> zonda.Scene:
    """Scene: the telescope, its site, the time and the target."""
    return zonda.Scene(
        site="green_bank",
        instrument="mustang2",
        time="2024-11-25T02:00-05:00",  # 02:00 EST
        target="05h00m00s +20d00m00s",  # ICRS
        seed=20241125,
    )


def pipeline() -> zonda.Pipeline:
    """Pipeline of the observation, from the scan to the report."""
    return zonda.Pipeline(
        [
            zonda.PointingDaisy(
                radius="4 arcmin",
                speed="50 arcsec/s",
                scan_duration="8.6 min",
                scans=5,
                gap="30 s",
                offsets="box",
                offset_size="1 arcmin",
            ),
            zonda.SkyMap(file=Path(__file__).parent / "data" / "merging_cluster.fits"),
            zonda.AtmosphereLayers(pwv="7.7 mm", pwv_rms="0.5 %", layer_response="column"),
            zonda.WhiteNoise(),
            zonda.PinkNoise(shared=0.8),
            zonda.Efficiency(),
            zonda.PowerSpectrum(),
            zonda.TimeStreams(),
            zonda.HighpassFilter(frequency="0.08 Hz"),
            zonda.CommonModeFilter(modes=1),
            zonda.BinMap(pixel="2 arcsec", half_difference=True),
            zonda.SaveMap(),
            zonda.Plots(),
            zonda.Report(),
        ],
        runs={
            "noiseless": {"only": ["sky"], "modes": "full"},
            "source_free": {"without": ["sky"], "modes": "full"},
        },
        name="mustang2_cluster",
        description=(
            "MUSTANG-2 on the GBT maps a merging galaxy cluster, 45 min of daisy scans at 90 GHz"
        ),
    )


if __name__ == "__main__":
    data = pipeline().run(scene(), output="out/mustang2_cluster")
    print(data)
