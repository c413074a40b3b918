"""zonda's `AtmosphereLayers` for one case: python zonda_atmosphere.py CASE.npz"""

from __future__ import annotations

import numpy as np
from common import case, cpu, twice

import zonda
from zonda.core.configuration.time import Instant
from zonda.core.data import Block, Observation
from zonda.core.focalplane import Focalplane
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.site import Site
from zonda.operators.atmosphere.layers import AtmosphereLayers

BLOCK = 16, 16384
"""Detectors and samples that a block holds."""


def chajnantor(c: dict) -> Site:
    place = {
        "latitude": f"{c['latitude']} rad",
        "longitude": f"{c['longitude']} rad",
        "altitude": f"{c['altitude']} m",
    }
    return Site(name="here", **place, climatology="chajnantor")


def observation(c: dict) -> Observation:
    edges = [f"{c['band_centre'] + side * c['band_width'] / 2} Hz" for side in (-1, 1)]
    n, one = len(c["xi"]), np.ones(len(c["xi"]))
    camera = Instrument(
        name="camera",
        telescope=Telescope(name="dish", diameter=f"{c['diameter']} m"),
        band=Band(name="b", low=edges[0], high=edges[1]),
        detectors=n,
        field_of_view="0 deg",
        main_beam_efficiency=1.0,
        illumination_efficiency=1.0,
        net="1 mK s(1/2)",
        sample_rate=f"{c['rate']} Hz",
    )
    plane = Focalplane(
        [str(k) for k in range(n)], c["xi"], c["eta"], one * camera.beam_fwhm, one, one, one * 1e-3
    )
    a, b = c["azimuth"] / 2, (np.pi / 2 - c["elevation"]) / 2
    q = np.stack(
        [
            np.sin(a) * np.sin(b),
            np.cos(a) * np.sin(b),
            -np.sin(a) * np.cos(b),
            np.cos(a) * np.cos(b),
        ],
        axis=1,
    )
    start, seconds = Instant.parse(c["date"]), c["seconds"]
    return Observation(
        "case", 0, chajnantor(c), camera, plane, start, seconds, c["rate"], q, q, (0.0, 0.0), 1
    )


def run(c: dict) -> dict[str, float]:
    rms = f"{100 * c['pwv_rms']} %"
    o, operator = (
        observation(c),
        AtmosphereLayers(pwv=f"{c['pwv']} m", pwv_rms=rms, layer_response="column"),
    )
    start = cpu()
    state = operator.prepare(o)
    setup = cpu() - start
    start = cpu()
    buffers: dict = {}
    for first in range(0, o.n_detectors, BLOCK[0]):
        for begin in range(0, o.n_samples, BLOCK[1]):
            detectors, part = (
                slice(first, min(first + BLOCK[0], o.n_detectors)),
                slice(begin, min(begin + BLOCK[1], o.n_samples)),
            )
            operator.exec(Block(o, detectors, part, buffers=buffers), state)
    return {"setup": setup, "evaluation": cpu() - start}


if __name__ == "__main__":
    given = case()
    twice(lambda: run(given), version=zonda.__version__)
