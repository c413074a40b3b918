"""A case as maria's objects."""

from __future__ import annotations

import logging
import warnings
from typing import Any

from maria.band import Band
from maria.instrument import Instrument
from maria.plan import Plan
from maria.site import Site


def quiet() -> None:
    warnings.simplefilter("ignore")
    logging.getLogger("maria").setLevel(logging.ERROR)


def site(c: dict[str, Any]) -> Site:
    import numpy as np

    return Site(
        region="chajnantor",
        latitude=np.degrees(c["latitude"]),
        longitude=np.degrees(c["longitude"]),
        altitude=c["altitude"],
    )


def instrument(c: dict[str, Any]) -> Instrument:
    band = Band(
        name="b", center=c["band_centre"], width=c["band_width"], efficiency=1.0, NET_RJ=1e-3
    )
    array = {
        "xi": c["xi"],
        "eta": c["eta"],
        "degrees": False,
        "primary_size": c["diameter"],
        "bands": [band],
        "name": "a",
    }
    return Instrument(arrays=[array])


def plan(c: dict[str, Any], where: Site) -> Plan:
    return Plan(
        time=c["start"] + c["seconds"],
        phi=c["azimuth"],
        theta=c["elevation"],
        frame="az/el",
        site=where,
    )


def atmosphere_options(c: dict[str, Any]) -> dict[str, Any]:
    return {
        "weather": {"pwv": c["pwv"] * 1e3},
        "pwv_rms_frac": c["pwv_rms"],
        "disable_progress_bars": True,
    }
