"""TOAST's `SimAtmosphere` with its defaults for one case: python toast_atmosphere.py CASE.npz"""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np
import toast
import toast.ops
from astropy import units as u
from astropy.table import QTable
from common import Stopwatch, case, cpu, twice
from toast import qarray
from toast.instrument import Focalplane, GroundSite, Session, Telescope
from toast.instrument_coords import xieta_to_quat
from toast.ops.sim_tod_atm_generate import GenerateAtmosphere
from toast.weather import SimWeather

GENERATION = Stopwatch()


def observation(c: dict[str, Any]) -> toast.Data:
    n = len(c["xi"])
    gamma = np.zeros(n)
    detectors = QTable(
        {
            "name": [f"d{k:04d}" for k in range(n)],
            "quat": xieta_to_quat(np.arctan(c["xi"]), np.arctan(c["eta"]), gamma),
            "gamma": gamma * u.rad,
            "bandcenter": np.full(n, c["band_centre"]) * u.Hz,
            "bandwidth": np.full(n, c["band_width"]) * u.Hz,
        }
    )
    start = datetime.datetime.fromtimestamp(c["start"], datetime.UTC)
    weather = SimWeather(time=start, name="atacama", median_weather=True)
    latitude, longitude = c["latitude"] * u.rad, c["longitude"] * u.rad
    site = GroundSite("chajnantor", latitude, longitude, c["altitude"] * u.m, weather=weather)
    plane = Focalplane(detector_data=detectors, sample_rate=c["rate"] * u.Hz)
    end = start + datetime.timedelta(seconds=float(c["seconds"][-1]))
    comm = toast.Comm(world=None)
    o = toast.Observation(
        comm,
        Telescope("dish", focalplane=plane, site=site),
        len(c["seconds"]),
        name="one",
        session=Session("one", start=start, end=end),
    )
    o.shared.create_column("times", (o.n_local_samples,), dtype=np.float64)
    o.shared["times"].set(c["start"] + c["seconds"])
    o.shared.create_column("boresight_azel", (o.n_local_samples, 4), dtype=np.float64)
    o.shared["boresight_azel"].set(
        qarray.from_lonlat_angles(-c["azimuth"], c["elevation"], np.zeros(len(c["seconds"])))
    )
    o.detdata.create("flags", dtype=np.uint8)
    data = toast.Data(comm)
    data.obs.append(o)
    return data


def run(c: dict[str, Any]) -> dict[str, Any]:
    """Set-up: the slabs of turbulence. Evaluation: pointing, integrals along the lines of sight,
    loading of the band.
    """
    data = observation(c)
    pointing = toast.ops.PointingDetectorSimple(
        boresight="boresight_azel", quats="quats_azel", shared_flags=None
    )
    generated, start = GENERATION.total, cpu()
    toast.ops.SimAtmosphere(
        detector_pointing=pointing,
        det_data="atmosphere",
        det_data_units=u.K,
        shared_flags=None,
        turnaround_interval=None,
    ).apply(data)
    total, generated = cpu() - start, GENERATION.total - generated
    signal = np.asarray(data.obs[0].detdata["atmosphere"].data)
    rms = float(np.std(signal, axis=1).mean())
    return {
        "setup": generated,
        "evaluation": total - generated,
        "rms": rms,
        "finite": bool(np.isfinite(signal).all()),
    }


if __name__ == "__main__":
    given = case()
    with GENERATION.of(GenerateAtmosphere, "apply"):
        twice(lambda: run(given), version=toast.__version__)
