"""pysanepic (GPL-3) as a map maker of an outside plugin, beside `MaximumLikelihoodMap`.

zonda neither needs nor ships it. `.ci/sanepic` runs this in an environment of its own.
"""

import numpy as np
import pytest

import zonda
from zonda.operators.maps.grid import Looking

from ..scenes import skip_without

pytestmark = pytest.mark.sanepic
skip_without("pysanepic")

from pysanepic import GLS

BINS = 30


class SanepicMap(zonda.BinMap):
    """Generalized least squares at the full rate with pysanepic, of independent detectors.

    Streams stay in memory. The noise of all detectors of a scan has one spectrum, found from their
    streams in bins of frequency.
    """

    unfiltered = True
    linear = False

    tolerance: float = zonda.quantity(1e-4, gt=0, lt=1)
    """Norm of the residual at which the iteration ends, over that of the right side."""

    def prepare(self, observation):
        good, n = np.flatnonzero(observation.good_detectors), observation.n_samples
        pixels = Looking.of(observation, self.grid).pixels(good, 0, n)
        pixels[:, ~observation.good_samples] = -1  # as the pixel of a flagged sample
        streams = {name: np.zeros((observation.n_detectors, n)) for name in observation.signals}
        return super().prepare(observation), pixels, streams

    def exec(self, block, state):
        super().exec(block, state[0])
        for name in block.signals:
            state[2][name][block.detectors, block.samples] = block.total(name)

    def collect(self, data, observation, state):
        super().collect(data, observation, state[0])
        good = observation.good_detectors
        streams = {name: np.nan_to_num(rows[good]) for name, rows in state[2].items()}
        scans = data.partial.setdefault(f"{self.label} streams", [])
        scans.append((state[1], streams))

    def finalize(self, data):
        super().finalize(data)
        scans = data.partial.pop(f"{self.label} streams")
        pixels = [row for found, _ in scans for row in found]
        weights = []
        for found, streams in scans:
            weights += [1 / np.mean([power(row) for row in streams["signal"]], axis=0)] * len(found)
        system = GLS(pixels, None, weights)
        for stream in scans[0][1]:
            rows = [row - row.mean() for _, streams in scans for row in streams[stream]]
            values = system.solve(rows, tol=self.tolerance**2)[0][0]
            name = zonda.product_name(stream, self.product)
            product = data.products[name]
            signal = np.pad(values, (0, self.grid.n_pixels - len(values)))
            signal = np.where(product.known, signal.reshape(product.hits.shape), np.nan)
            data.products[name] = product.with_planes(signal=signal)


def power(row):
    """Power of a stream [K^2] at the frequencies of its real transform."""
    t = np.linspace(-1, 1, row.size)
    row = row - np.polyval(np.polyfit(t, row, 1), t)
    found = np.abs(np.fft.rfft(row)) ** 2 / row.size
    bins = np.unique(np.geomspace(1, found.size, BINS).astype(int))  # 0 belongs to the first
    index = np.clip(np.digitize(np.arange(found.size), bins), 1, None)
    total, number = np.bincount(index, found), np.bincount(index)
    return (total / np.maximum(number, 1))[index]


def test_a_map_at_the_full_rate_has_hardly_less_noise():
    scene = zonda.Scene(
        site="green_bank",
        instrument="mustang2",
        time="2024-11-25T02:00-05:00",
        target="05h +20d",
        seed=1,
    )
    steps = [
        zonda.PointingDaisy(radius="4 arcmin", speed="50 arcsec/s", scan_duration="60 s"),
        zonda.WhiteNoise(),
        zonda.PinkNoise(knee="1 Hz", shared=0),
        zonda.Efficiency(),
    ]
    how = {"pixel": "6 arcsec", "half_difference": False}
    makers = [
        zonda.BinMap(**how),
        zonda.MaximumLikelihoodMap(modes=0, free=0, **how),
        SanepicMap(**how),
    ]
    maps = [zonda.Pipeline([*steps, maker]).run(scene)["map"] for maker in makers]
    hits = maps[0].hits
    y, x = np.indices(hits.shape)
    well = hits > np.median(hits[hits > 0])
    basis = np.stack([np.ones(well.sum()), x[well], y[well]], axis=1)
    weight = np.sqrt(hits[well])[:, None]
    left = []
    for m in maps:
        value = m.signal[well][:, None]
        plane = basis @ np.linalg.lstsq(basis * weight, value * weight)[0]
        left.append(((value - plane) * weight).ravel())
    binned, ours, theirs = (np.std(rest) for rest in left)
    # bins and baselines of 0.2 s cost 1 % here
    print(f"\nnoise: binned {binned / theirs:.2f}, ours {ours / theirs:.3f} times pysanepic's")
    assert binned > 1.3 * theirs
    assert ours < 1.02 * theirs
    assert np.std(left[1] - left[2]) < 0.3 * theirs
