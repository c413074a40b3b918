"""Modes that the detectors of all bands share (`group: all`): maps of two bands are found together."""

import warnings
from typing import ClassVar

import numpy as np
import pytest

import zonda
from zonda.core.errors import PipelineError
from zonda.core.flags import OPAQUE
from zonda.core.run import streams
from zonda.core.run.streams import Files
from zonda.operators.maps.grid import Looking
from zonda.operators.maps.maximum_likelihood import MaximumLikelihoodMap

from .test_normal_equations import circulant, without

BANDS = (
    {"name": "f090", "low": "77 GHz", "high": "106 GHz", "net": "300 uK s(1/2)", "knee": "0.5 Hz"},
    {"name": "f150", "low": "130 GHz", "high": "170 GHz", "net": "900 uK s(1/2)", "knee": "1 Hz"},
)
SIZE = 4


def scene(count=2, detectors=SIZE):
    settings = {
        "name": "camera",
        "telescope": {"name": "dish", "diameter": "6 m"},
        "detectors": detectors,
        "field_of_view": "8 arcmin",
        "main_beam_efficiency": 0.8,
        "illumination_efficiency": 0.9,
        "sample_rate": "25 Hz",
    }
    one = {"band": dict(list(BANDS[0].items())[:3]), "net": BANDS[0]["net"], "knee": "0.5 Hz"}
    bands = {"bands": [dict(band) for band in BANDS]} if count > 1 else one
    return zonda.Scene(
        site="llano_de_chajnantor",
        instrument=zonda.Instrument(**settings, **bands),
        time="2022-08-01T23:00",
        target="260d -10d",
        seed=3,
    )


class Drift(zonda.Operator):
    """A walk that all detectors of both bands see, four times as strong in the second band; gaps
    and flags of one band alone."""

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})
    gaps: bool = False

    def prepare(self, observation):
        rng = np.random.default_rng(observation.index)
        if self.gaps and observation.instrument.band.name == "f150":
            observation.flags[53:66] |= OPAQUE
        return 0.0007 * np.cumsum(rng.normal(size=observation.n_samples))

    def exec(self, block, walk):
        second = block.observation.instrument.band.name == "f150"
        signal = block.detdata["signal"]
        signal += (4 if second else 1) * walk[block.samples]
        row, samples = 2 - block.detectors.start, np.arange(block.samples.start, block.samples.stop)
        if self.gaps and not second and 0 <= row < len(signal):
            signal[row, (samples >= 100) & (samples < 131)] = np.nan


def pipeline(*, seconds=8, scans=1, gaps=False, runs=None, precision="float64", maker=None, **how):
    values = np.zeros((64, 64))
    values[30, 34] = values[29, 33] = 1.0
    how = {"pixel": "3 arcmin", "baseline": "0.4 s", "modes": 2, "group": "all", **how}
    steps = [
        zonda.PointingDaisy(
            radius="8 arcmin", speed="10 arcmin/s", scan_duration=f"{seconds} s", scans=scans
        ),
        zonda.SkyMap(map=values, unit="K_CMB", pixel_size="30 arcsec", centre="target"),
        zonda.WhiteNoise(scatter="10 %"),
        zonda.PinkNoise(),
        zonda.Efficiency(),
        Drift(gaps=gaps),
        (maker or MaximumLikelihoodMap)(**how),
    ]
    return zonda.Pipeline(steps, runs=runs or {}, precision=precision)


def run(pipeline, scene, **how):
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # pixels larger than the beam; tolerances that are not reached
        return pipeline.run(scene, **{"threads": 1, **how})


class Keeps(MaximumLikelihoodMap):
    kept: ClassVar[list] = []

    def maps(self, every):
        self.kept[:] = super().maps(every)
        return list(self.kept)


def covariance(noise, n):
    """N / sigma^2 (n_det n, n_det n), and the directions of infinite variance, of equation (1) of
    `baseline_noise`."""
    n_det, length = len(noise.white), noise.length
    n_base = n // length
    of = np.repeat(np.arange(len(noise.own)), np.diff(noise.edges))
    slow = np.kron(np.eye(n_det), circulant(noise.own[of] - 1, n_base))
    for mode, power in zip(noise.modes[noise.free :], noise.shared.T[noise.free :], strict=True):
        slow += np.kron(np.outer(mode, mode), circulant(power[of], n_base))
    spread = np.kron(np.eye(n_det * n_base), np.ones((length, 1))) / np.sqrt(length)
    infinite = [np.kron(mode[:, None], np.eye(n)) for mode in noise.modes[: noise.free]]
    lines = [np.kron(np.eye(n_det), np.repeat(row, length)[:, None]) for row in noise.lines]
    return np.eye(n_det * n) + spread @ slow @ spread.T, np.hstack([*infinite, *lines])


@pytest.mark.parametrize("gaps", [False, True])
def test_maps_of_two_bands_are_those_of_generalized_least_squares(gaps):
    """All samples of both bands as one dense system; the weights of a template are those of a map
    beside an unknown one of the other band. A mean is even at all frequencies, other trends are not."""
    how = {"tolerance": 1e-9, "undetermined": "none", "half_difference": False, "trend": 0}
    steps = pipeline(gaps=gaps, maker=Keeps, runs={"model": {"only": ["sky"]}}, **how)
    data = run(steps, scene(), keep=["signal"])
    system, n = Keeps.kept[0].system, 200
    ((_, noise),) = system.equations.scans
    observations = [data.bands[band["name"]].observations[0] for band in BANDS]
    p = np.zeros((2 * SIZE * n, system.equations.n_pixels))
    for k, (o, own) in enumerate(zip(observations, system.pixels, strict=True)):
        pixel = Looking.of(o, system.parts[k][0]).pixels(np.arange(SIZE), 0, n)
        pixel[:, ~o.good_samples] = -1
        at = np.flatnonzero(pixel.ravel() >= 0)
        p[SIZE * n * k + at, own.start + pixel.ravel()[at]] = 1
    d = np.concatenate([data.tod(scan=o.name).ravel() for o in observations])
    p[~np.isfinite(d)] = 0
    counts = p.any(axis=1)
    assert counts.sum() == 2 * SIZE * n - gaps * (SIZE * 13 + 31)
    whole, infinite = covariance(noise, n)
    at, sigma = np.ix_(counts, counts), np.repeat(np.sqrt(noise.white), n)[counts]
    q = without(np.linalg.inv(whole[at]), infinite[counts]) / np.outer(sigma, sigma)
    a, b = p[counts].T @ q @ p[counts], p[counts].T @ q @ d[counts]
    m = system.solved("signal").values[0]
    # values of gaps are found to 1e-10
    np.testing.assert_allclose(a @ m, b, atol=1e-8 * np.abs(b).max())
    maps = [data[f"map_{band['name']}"] for band in BANDS]
    best = np.linalg.lstsq(a, b, rcond=1e-11)[0]
    for k, (own, found) in enumerate(zip(system.pixels, maps, strict=True)):
        ok = found.known.ravel()
        values = found.signal.ravel()[ok]
        # the common mode leaves the mean of each map to what detectors' offsets are not
        error = values - best[own][ok]
        error -= error.mean()
        np.testing.assert_allclose(error, 0, atol=1e-6 * np.abs(values).max())
        t = np.nan_to_num(data[f"model/map_{BANDS[k]['name']}"].signal.ravel())
        rest = np.r_[: own.start, own.stop : len(a)]
        other = a[np.ix_(rest, rest)]
        schur = a[own, own] - a[own][:, rest] @ np.linalg.pinv(other, rcond=1e-11) @ a[rest][:, own]
        template = data[f"model/map_{BANDS[k]['name']}"].planes["template"].values.ravel()
        np.testing.assert_allclose(
            np.nan_to_num(template), np.where(ok, schur @ t, 0), atol=1e-6 * np.abs(schur @ t).max()
        )


def planes(data, names=("signal", "hits", "noise", "half_difference")):
    maps = [f"{run}map_{band['name']}" for run in ("", "quiet/") for band in BANDS]
    return [getattr(data[name], plane) for name in maps for plane in names]


def test_bits_are_the_same_however_maps_are_made(tmp_path, monkeypatch):
    """Threads, streams made again, files, and a campaign whose tasks have a scan each."""
    how = {"scans": 3, "gaps": True, "precision": "float32"}
    steps = pipeline(**how, seconds=16, runs={"quiet": {"only": ["white", "pink"]}})
    camera = scene(detectors=40)
    once = run(steps, camera, threads=2)
    first = planes(once)
    # streams of two signals take 2 x 80 x 400 x 4 bytes = 256 kB, more than half
    tight = run(steps, camera, memory=470_000)
    assert any("made again" in what for _, what, _ in tight.log)
    monkeypatch.setattr("zonda.core.pipeline.files_of", lambda budget: Files(0))
    monkeypatch.setattr(streams, "LEAST_FILE", 1)
    files = run(steps, camera)
    assert any("temporary files" in text for _, _, text in files.log.figures())
    for other in (tight, files):
        for one, two in zip(first, planes(other), strict=True):
            np.testing.assert_array_equal(one, two)
    own = [step for step in steps.operators if not isinstance(step, Drift)]
    steps = zonda.Pipeline([*own, zonda.SaveMap()])
    once = run(steps, camera, output=tmp_path / "once")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        zonda.campaign(steps, camera, output=tmp_path / "c", realizations=1, engine="serial")
    for name in ("map_f090", "map_f150"):
        one, two = (zonda.read_map(tmp_path / k / f"{name}.fits") for k in ("once", "c"))
        np.testing.assert_array_equal(one.signal, two.signal)
        np.testing.assert_array_equal(one.half_difference, two.half_difference)


def test_each_band_has_its_own_levels_and_one_fit():
    data = run(pipeline(seconds=60, patterns=2), scene())
    one, two = (data[f"noise_model_{band['name']}"] for band in BANDS)
    assert [len(r.models[0].white) for r in (one, two)] == [SIZE, SIZE]
    # NETs of 300 and 900 uK, of a tenth of scatter
    assert 2.5 < np.sqrt(two.models[0].white.mean() / one.models[0].white.mean()) < 3.5
    np.testing.assert_array_equal(one.models[0].own, two.models[0].own)
    assert one.chi2 == two.chi2 == data["map_f150"].chi2
    levels = [np.sqrt(r.models[0].white.mean()) for r in (one, two)]
    ratio = 4 * levels[0] / levels[1]
    # shares of the walk, in units of white noise
    modes = np.concatenate([r.models[0].modes for r in (one, two)], axis=1)
    assert (modes[0] ** 2).sum() == pytest.approx(1)
    assert np.mean(modes[0, SIZE:]) / np.mean(modes[0, :SIZE]) == pytest.approx(ratio, rel=0.1)
    assert {"undetermined_1", "undetermined_2"} <= data["map_f090"].planes.keys()
    # hits are those of a band's own flags
    both, apart = (run(pipeline(gaps=True, group=group), scene()) for group in ("all", "band"))
    for band in BANDS:
        name = f"map_{band['name']}"
        np.testing.assert_array_equal(both[name].hits, apart[name].hits)


def test_a_camera_of_one_band_is_that_band():
    found = [run(pipeline(group=group), scene(1))["map"].signal for group in ("all", "band")]
    np.testing.assert_array_equal(*found)


def test_what_is_of_one_band_is_refused():
    data = run(pipeline(group="band"), scene(), keep=["signal"])
    maker = MaximumLikelihoodMap(pixel="3 arcmin", baseline="0.4 s", group="all")
    with pytest.raises(PipelineError, match="all bands") as caught:
        zonda.linear.compressed(data, maker, band="f150")
    assert "band or wafer" in caught.value.cure
