"""The same as maria_tutorials.py with zonda: python zonda_tutorials.py NAME MAP.fits"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from typing import Any

import zonda


def mustang(path: str) -> Any:
    """See `maria_tutorials.mustang`."""
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="75 deg 20 deg"
    )
    steps = [
        zonda.PointingDaisy(
            radius="2 arcmin", speed="30 arcsec/s", scan_duration="10 min", sample_rate="50 Hz"
        ),
        zonda.SkyMap(file=path, centre="target"),
        zonda.AtmosphereLayers(),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="0.033 Hz"),
        zonda.CommonModeFilter(),
        zonda.BinMap(pixel="1.8 arcsec", width="6 arcmin"),
    ]
    return zonda.Pipeline(steps).run(scene)["map"].to("uK_RJ")


def cluster(path: str) -> Any:
    """See `maria_tutorials.cluster`."""
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T11:00", target="150 deg 10 deg"
    )
    steps = [
        zonda.PointingDaisy(
            radius="3 arcmin", speed="36 arcsec/s", scan_duration="20 min", sample_rate="50 Hz"
        ),
        zonda.SkyMap(file=path, centre="target"),
        zonda.AtmosphereLayers(),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="0.1 Hz"),
        zonda.CommonModeFilter(),
        zonda.BinMap(pixel="0.72 arcsec", width="6 arcmin"),
    ]
    return zonda.Pipeline(steps).run(scene)["map"].smooth("1.7 arcsec").to("uK_RJ")


def transfer(path: str, names: Sequence[str] = ("lmt_150ghz", "lmt_280ghz")) -> Any:
    """See `maria_tutorials.transfer`: a camera for each band, as many detectors."""
    found = []
    for name in names:  # 1172 and 4012 detectors
        scene = zonda.Scene(
            site="llano_de_chajnantor", instrument={"like": name, "sample_rate": "50 Hz"},
            time="2024-01-01T22:00", target="75 deg -20 deg",
        )  # fmt: skip
        steps = [
            zonda.PointingDaisy(radius="6.5 arcmin", speed="100 arcsec/s", scan_duration="6 min"),
            zonda.SkyMap(file=path, centre="target"),
            zonda.AtmosphereLayers(),
            zonda.WhiteNoise(),
            zonda.PinkNoise(),
            zonda.Efficiency(),
            zonda.HighpassFilter(frequency="0.0167 Hz"),
            zonda.CommonModeFilter(),
            zonda.BinMap(pixel="1 arcsec"),
            zonda.TransferFunction(),
        ]
        found.append(zonda.Pipeline(steps).run(scene)["transfer_function"])
    return found


def transfer_150(path: str) -> Any:
    """See `maria_tutorials.transfer_150`."""
    return transfer(path, ["lmt_150ghz"])


def custom(path: str) -> Any:
    """See `maria_tutorials.custom`: a camera for each band."""
    found = []
    for low, high, net in (
        ("80 GHz", "100 GHz", "40 uK s(1/2)"),
        ("135 GHz", "165 GHz", "60 uK s(1/2)"),
    ):
        camera = zonda.Instrument(
            name=low,
            telescope={"name": "25 m", "diameter": "25 m"},
            band={"name": low, "low": low, "high": high},
            net=net,
            field_of_view="30 arcmin",
            detectors=1058,
            knee="1 Hz",
            sample_rate="50 Hz",
            main_beam_efficiency=1.0,
            illumination_efficiency=1.0,
        )
        scene = zonda.Scene(
            site="llano_de_chajnantor",
            instrument=camera,
            time="2024-08-06T03:00",
            target="291.156 deg -31.23 deg",
            weather={"pwv": "0.5 mm"},
        )
        steps = [
            zonda.PointingDaisy(radius="0.5 deg", speed="0.1 deg/s", scan_duration="15 min"),
            zonda.SkyMap(file=path, centre="target"),
            zonda.AtmosphereLayers(),
            zonda.WhiteNoise(),
            zonda.PinkNoise(),
            zonda.Efficiency(),
            zonda.HighpassFilter(frequency="0.033 Hz"),
            zonda.CommonModeFilter(),
            zonda.BinMap(pixel="14 arcsec", width="1 deg"),
        ]
        found.append(zonda.Pipeline(steps).run(scene)["map"].to("mK_RJ"))
    return found


if __name__ == "__main__":
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
                "version": zonda.__version__,
            }
        )
    )
