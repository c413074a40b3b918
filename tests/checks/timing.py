"""Samples that do not come like clockwork: jitter, gaps and spoilt rows of a recorded scan."""

from __future__ import annotations

import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from zonda.core.checks import Family, Measured
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.pipeline import Pipeline
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.noise.white import WhiteNoise
from zonda.operators.optics.efficiency import Efficiency
from zonda.operators.pointing.base import PointingStare
from zonda.operators.pointing.recorded import PointingRecorded
from zonda.plugins.checks.numerics import ERROR, SITES, angle, erfa_horizontal
from zonda.plugins.checks.scenes import TARGET, camera, scene

from .cases import TIME
from .pointing import WHEN

checks = Family("timing")


@checks.add(TIME, reference="ERFA eraAtco13 at each sample's own time", limit=ERROR, unit="rad")
def jittered_pointing() -> Measured:
    """pointing error of a star tracked with samples that are 1 ms rms early or late"""
    where = scene(camera(7), site=SITES[0], time=WHEN)
    data = Pipeline([PointingStare(scan_duration="60 s", jitter="1 ms")]).run(where, threads=1)
    (o,) = data.observations
    some = slice(None, None, 20)
    sky = np.tile(unit_vectors(*np.radians(TARGET)), (o.n_samples, 1))[some]
    looking = unit_vectors(-o.azimuth, o.elevation)[some]
    moved = 7.3e-5 * float(abs(o.departures).max())
    return angle(
        looking, erfa_horizontal(sky, o.start, o.seconds[some], SITES[0])
    ), f"a comb would be wrong by {moved:.0e} rad"


@checks.add(TIME, reference="the same air 8 times as often, on a comb", limit=0.05)
def jittered_atmosphere() -> Measured:
    """error of the atmosphere at samples 1 ms rms early or late, over what these delays change: a
    stare, wind 30 m/s
    """
    where = scene(camera(1, field="0 deg"), target="az 150 deg el 50 deg")
    air = AtmosphereLayers(
        pwv="5 mm", layers=1, lowest="500 m", wind={"speed": "30 m/s"}, tolerance="0.01 %"
    )

    def seen(**pointing: str) -> tuple[np.ndarray, np.ndarray]:
        steps = [PointingStare(scan_duration="4 s", **pointing), air]
        (o,) = (
            Pipeline(steps, precision="float64")
            .run(where, keep=("atmosphere",), threads=1)
            .observations
        )
        return o.seconds, np.asarray(o.detdata["atmosphere"][0])

    from scipy.interpolate import CubicSpline

    truth, (t, jittered), (_, comb) = (
        CubicSpline(*seen(sample_rate="800 Hz")),
        seen(jitter="1 ms"),
        seen(),
    )
    inside = slice(20, -20)
    wrong = np.sqrt(np.mean((jittered - truth(t))[inside] ** 2))
    change = np.sqrt(np.mean((comb - truth(t))[inside] ** 2))
    return float(
        wrong / change
    ), f"the delays change {change * 1e6:.2g} uK of {comb.std() * 1e6:.2g} uK"


@checks.add(TIME, reference="flags, counts and hits of what was recorded", limit=0, unit="samples")
def recorded_gaps_and_nan() -> Measured:
    """samples of a recorded scan with a gap, NaN rows and times out of order that are used, lost or
    not counted
    """
    t = np.arange(6000) / 100.0
    az, el = 150 + 0.05 * np.sin(t), 50 + 0.03 * np.cos(0.9 * t)
    az[1000:1010], el[2000], time = np.nan, np.nan, 1732518000 + t
    time[3000], time[3500], time[5000] = np.nan, time[3400], time[5000] + 3600
    rows = np.r_[0:4000, 4200:6000]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scan.csv"
        table = np.transpose([time, az, el])[rows]
        np.savetxt(path, table, fmt="%.9f", delimiter=",", header="time [s], az [deg], el [deg]")
        steps = [
            PointingRecorded(file=path),
            WhiteNoise(),
            Efficiency(),
            HighpassFilter(frequency="0.5 Hz"),
            BinMap(pixel="10 arcsec"),
        ]
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # what is out of order is said, and that is counted below
            data = Pipeline(steps).run(scene(camera(7), target="az 150 deg el 50 deg"), threads=1)
    (o,) = data.observations
    expected = np.isin(
        np.arange(6000), [*range(1000, 1010), 2000, 3000, 3500, 5000, *range(4000, 4200)]
    )
    wrong = abs(o.n_samples - 6000) + int(np.count_nonzero((o.flags != 0) != expected))
    wrong += abs(int(np.nansum(data.products["map"].hits)) - 7 * int((~expected).sum()))
    wrong += int(np.count_nonzero(abs(o.seconds - t) > 1e-6))
    counts = {
        "rows without a time, dropped": 1,
        "rows out of order, dropped": 2,
        "samples in gaps, flagged": 203,
        "samples whose row is not a number, flagged": 11,
    }
    wrong += sum(
        abs(o.log.get("PointingRecorded", what) - number) for what, number in counts.items()
    )
    bridged = o.log.get("HighpassFilter", "flagged samples bridged before filtering")
    return wrong + abs(bridged - 214), f"{bridged} flagged, bridged by the filter, without hits"
