"""Maximum-likelihood maps of scans: recovery, noise, bits, and what is refused."""

import warnings
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from astropy.io import fits

import zonda
import zonda.pipelines
from zonda.core.data import Data
from zonda.core.errors import PipelineError
from zonda.core.numerics.projection import boresights
from zonda.core.polarization import PolarizationAngles
from zonda.core.registry import operators_that
from zonda.operators.diagnostics.plot_operators import draw_map
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.maps.grid import Looking
from zonda.operators.maps.maximum_likelihood import MaximumLikelihoodMap
from zonda.operators.maps.normal_equations import CompressedScans
from zonda.plugins.checks.scenes import run, scan, scene

SIGMA = 1e-3
"""White noise of a sample, K."""


def observation(polarized=False, plate=False):
    """Three turns of 4 arcmin, around a point that moves."""
    o = scan(37, 6000, radius=3.0)
    if polarized:
        o.focalplane.polarization_angle[:] = np.resize(np.radians([0, 90, 45, 135]), 37)
        o.focalplane.polarization_efficiency[:] = 0.9
    if plate:
        o.hwp_angle = 11.0 * o.seconds
    o.focalplane.net[:] = SIGMA / np.sqrt(o.sample_rate)
    return o


def drifts(o, rng):
    """Slow noise (n_det, n_samp): a random walk that all see, and one of each detector."""
    walk = np.cumsum(rng.normal(size=o.n_samples)) * 2 * SIGMA
    own = np.cumsum(rng.normal(size=(o.n_detectors, o.n_samples)), axis=1) * 0.003 * SIGMA
    gain = rng.uniform(0.8, 1.2, o.n_detectors)
    return np.outer(gain, walk) + own + 20.0  # and a load of 20 K


def grid_of(o, **how):
    maker = BinMap(**how)
    maker.observe(Data(scene(o.instrument), [o]))
    return maker.grid


def sky_of(o, how, rng, polarized=False):
    """A sky that is constant in pixels: maps (1 or 3, n_pixels), and samples."""
    grid = grid_of(o, **how)
    pixel = Looking.of(o, grid).pixels(np.arange(o.n_detectors), 0, o.n_samples)
    x = np.arange(grid.n_pixels) % grid.shape[-1] / 7
    y = np.arange(grid.n_pixels) // grid.shape[-1] / 5
    maps = np.stack([np.sin(x + k) * np.cos(y - k) for k in range(3 if polarized else 1)])
    signal = maps[0][pixel]
    if polarized:
        pole = np.array([0.0, 0.0, 1.0])
        c, s = np.empty((2, *pixel.shape))
        PolarizationAngles.of(o, o.boresight_radec, pole).fill(np.arange(37), 0, c, s)
        p = o.focalplane.polarization_efficiency[:, None]
        signal = signal + p * (c * maps[1][pixel] + s * maps[2][pixel])
    return maps, signal


def mapped(o, signal, **how):
    how = {"pixel": "15 arcsec", "half_difference": False, **how}
    return run([MaximumLikelihoodMap(**how)], o, signal).products["map"]


@pytest.mark.parametrize("taken", ["mean", "plane"])
def test_the_sky_comes_back(taken):
    """A sky ten times the noise of a pixel, below drifts a thousand times as strong."""
    rng, o, how = np.random.default_rng(1), observation(), {"pixel": "15 arcsec"}
    maps, signal = sky_of(o, how, rng)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=signal.shape)
    found = mapped(o, 1e-3 * signal + noise, undetermined=taken)
    ok = found.known & (found.hits > 0.3 * np.percentile(found.hits, 98))
    sky = 1e-3 * maps[0].reshape(found.hits.shape)
    rows, columns = np.indices(ok.shape)
    if taken == "plane":
        sides = rows - rows.mean(), columns - columns.mean()
        basis = np.stack([np.ones(ok.size), *(side.ravel() for side in sides)], axis=1)
        root = np.sqrt(found.weights.ravel())
        fit = np.linalg.lstsq(basis * root[:, None], sky.ravel() * root, rcond=None)[0]
        sky = sky - (basis @ fit).reshape(sky.shape)
    error = (found.signal - sky)[ok]
    error -= error.mean()
    centred = sky[ok] - sky[ok].mean()
    # white noise alone leaves an error of 1 sigma / sqrt(sum sky^2 / noise^2): 0.3 %; all noise is up
    # to 2.5 times as large
    assert (found.signal[ok] * centred).sum() / (centred**2).sum() == pytest.approx(1, abs=0.025)
    # of 37 detectors one mode and a line of each are lost, and slow noise adds less than half
    # to white noise; where a plane stays in the map, noise fills it
    assert 0.9 < (error / found.noise[ok]).std() < (1.5 if taken == "plane" else 2.5)


@pytest.mark.parametrize("plate", [False, True])
def test_i_q_and_u_come_back(plate):
    """Maps of sky and noise minus those of the noise alone, with nearly the same noise model: both
    have the same common mode."""
    rng, o = np.random.default_rng(2), observation(True, plate)
    how = {"pixel": "20 arcsec", "stokes": "IQU"}
    maps, signal = sky_of(o, how, rng, polarized=True)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=signal.shape)
    more = {**how, "tolerance": 1e-8, "undetermined": "none"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few angles, without a plate
        full, alone = (mapped(o, values, **more) for values in (SIGMA * signal + noise, noise))
    assert full.polarization is not None
    ok = full.known & (full.polarization.condition < 20)
    assert ok.sum() > 50
    for k, name in enumerate("IQU"):
        one, other = full.stokes(name), alone.stokes(name)
        error = (one.signal - other.signal)[ok] - SIGMA * maps[k].reshape(ok.shape)[ok]
        if k == 0:  # the common mode takes a plane
            sides = np.stack([np.ones(ok.sum()), *np.nonzero(ok)])
            error -= np.linalg.lstsq(sides.T, error)[0] @ sides
        elif not plate:  # detectors' offsets take the mean
            error -= error.mean()
        # the noise models differ: what noise leaves differs by
        # less than itself; the sky is 15 times as large
        assert np.abs(error).max() < 2 * np.nanmax(one.noise[ok]), name
        assert error.std() < np.nanmedian(one.noise[ok]), name


def test_pixels_without_a_value_tilt_no_map_and_undetermined_patterns_stay_small():
    """Few angles: at the edge Q and I are not told apart. The means of Q and U are not determined, and
    a load of 20 K leaves a rounding there, which more iterations must not blow up."""
    rng, o = np.random.default_rng(3), observation(True)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(37, o.n_samples))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few angles, and 1e-5 is not reached
        found = mapped(o, noise, pixel="20 arcsec", stokes="IQU", tolerance=1e-5)
    assert found.polarization is not None
    ok = found.known & (found.polarization.condition < 20)
    for name in "IQU":
        one = found.stokes(name)
        # slow noise adds less than half to white noise, as in maps of I
        assert (one.signal / one.noise)[ok].std() < 1.5, name


def test_white_noise_alone_is_weighed_as_it_is():
    """Noise of the map over what it states: that of white noise, since there is no other."""
    rng, o = np.random.default_rng(3), observation()
    noise = SIGMA * rng.normal(size=(o.n_detectors, o.n_samples))
    found = mapped(o, noise, modes=0, free=0)
    ok = found.known & (found.hits > 50)
    ratio = (found.signal / found.noise)[ok]
    # a deviate for each pixel: its standard deviation to 1 / sqrt(2 n); three times that; slow
    # baselines weigh a little less than white noise does
    assert ratio.std() == pytest.approx(1, abs=3 / np.sqrt(2 * ok.sum()) + 0.05)
    assert np.nanmedian(found.noise * np.sqrt(found.hits)) == pytest.approx(SIGMA, rel=0.01)


SCENE = {
    "site": "green_bank",
    "instrument": {
        "name": "camera",
        "telescope": {"name": "GBT", "diameter": "100 m"},
        "band": {"name": "m2", "low": "75 GHz", "high": "105 GHz"},
        "net": "600 uK s(1/2)",
        "knee": "0.5 Hz",
        "detectors": 40,
        "field_of_view": "4 arcmin",
        "main_beam_efficiency": 0.8,
        "illumination_efficiency": 0.9,
        "sample_rate": "50 Hz",
    },
    "time": "2024-02-01T05:00",
    "target": "75 deg 20 deg",
    "seed": 5,
}


def simulated(threads=1, runs=None, **how):
    """The complete signal's map, and all products."""
    steps = [
        zonda.PointingDaisy(
            radius="3 arcmin", speed="50 arcsec/s", scan_duration="50 s", scans=2, gap="10 s"
        ),
        zonda.AtmosphereLayers(pwv="5 mm"),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
        MaximumLikelihoodMap(pixel="10 arcsec", **how),
    ]
    pipeline = zonda.Pipeline(steps, runs=runs or {})
    return pipeline.run(zonda.Scene(**SCENE), threads=threads)


class Keeps(MaximumLikelihoodMap):
    """Keeps what it solves in ``kept``."""

    kept: ClassVar[list[CompressedScans]] = []

    def finalize(self, data):
        self.kept[:] = [data.partial[f"{self.label} scans"]]
        super().finalize(data)


def of_detectors(noise, shared=0.5, **how):
    """Map, noise model and NET on the sky of detectors that differ."""
    steps = [
        zonda.PointingDaisy(radius="3 arcmin", speed="50 arcsec/s", scan_duration="60 s"),
        zonda.AtmosphereLayers(pwv="5 mm"),
        zonda.WhiteNoise(scatter="50 %"),
        zonda.PinkNoise(shared=shared),
        zonda.Efficiency(),
        Keeps(pixel="10 arcsec", half_difference=False, noise=noise, **how),
    ]
    data = zonda.Pipeline(steps).run(zonda.Scene(**SCENE), threads=1)
    ((one,),) = (scans.scans for scans in Keeps.kept)
    return data, one.noise, data.observations[0].focalplane


def test_simulated_noise_is_that_of_the_scene():
    (data, noise, plane), (other, found, _) = (of_detectors(n) for n in ("simulated", "estimated"))
    # weights are rounded to 2^-24 and less of the largest
    np.testing.assert_allclose(noise.white, plane.net**2 * 50, rtol=1e-4)
    assert np.ptp(plane.net) > 0.5 * np.median(plane.net)
    use = noise.frequency > 0.1
    # half of the pink noise is each detector's own; the atmosphere adds little beside three modes
    expected = 1 + 0.5 * 0.5 / noise.frequency[use]
    np.testing.assert_allclose(noise.own[use], expected, rtol=0.15)
    assert abs(noise.modes[0] @ found.modes[0]) > 0.999
    # what is found of powers of 40 detectors in a few frequencies: 1 / sqrt(38 n)
    freedom = noise.freedom[use]
    np.testing.assert_array_less(np.abs(found.own / noise.own - 1)[use], 0.2 + 5 / np.sqrt(freedom))
    one, two = data["map"], other["map"]
    ok = one.hits > 0.3 * np.percentile(one.hits, 98)
    assert one.signal[ok].std() == pytest.approx(two.signal[ok].std(), rel=0.1)
    for made, text, source in (
        (data, "closed forms of the scene", "net"),
        (other, "from the streams", "streams"),
    ):
        assert ("Keeps", "noise model", text) in made.observations[0].log.figures()
        assert made["noise_model"].noise == text
        assert made["map"].noise_from == source


def test_noise_of_a_table(tmp_path):
    """White levels and spectra are those of the table, of which a wrong one is refused."""
    plane = of_detectors("estimated")[2]
    knee = np.linspace(0.2, 1, 40)
    table = tmp_path / "t.ecsv"
    rows = [
        f"{n} {1.5 * net} {k} 1.5" for n, net, k in zip(plane.names, plane.net, knee, strict=True)
    ]
    table.write_text("\n".join([HEAD, *rows]) + "\n")
    data, noise, plane = of_detectors(table)
    np.testing.assert_allclose(noise.white, 2.25 * plane.net**2 * 50, rtol=1e-4)
    f = noise.frequency[5]
    assert noise.own[5] == pytest.approx(1 + np.mean((knee / f) ** 1.5), rel=1e-6)
    assert np.nanmedian(data["map"].noise) > 0
    data["map"].write(tmp_path / "map.fits")
    assert data["map"].noise_from == zonda.read_map(tmp_path / "map.fits").noise_from == "table"
    assert "white levels and spectra of t.ecsv" in data["noise_model"].noise
    table.write_text("\n".join([HEAD, *rows[1:]]) + "\n")
    with pytest.raises(zonda.ZondaError, match="not in") as caught:
        of_detectors(table)
    assert "zonda noise" in caught.value.cure


HEAD = """# %ECSV 1.0
# ---
# datatype:
# - {name: name, datatype: string}
# - {name: net, unit: K s(1/2), datatype: float64}
# - {name: knee, unit: Hz, datatype: float64}
# - {name: slope, datatype: float64}
name net knee slope"""


def test_simulated_noise_needs_a_scene_that_states_it():
    o, rng = observation(), np.random.default_rng(16)
    with pytest.raises(PipelineError, match="closed form of white noise") as caught:
        mapped(o, SIGMA * rng.normal(size=(37, o.n_samples)), noise="simulated")
    assert "estimated" in caught.value.cure


def test_bits_depend_neither_on_threads_nor_on_other_signals():
    one, two = simulated(), simulated(threads=2, runs={"quiet": {"only": ["white", "pink"]}})
    for plane in ("signal", "half_difference", "noise", "hits"):
        np.testing.assert_array_equal(getattr(one["map"], plane), getattr(two["map"], plane))
    assert "quiet/map" in two


def test_the_map_without_filters_is_a_mean():
    """Transfer functions divide by a plain mean, not by a maximum-likelihood map: pixels as wide as
    the beam, in which the sky is no constant, tell the two apart."""
    runs = {"seen": {"only": ["sky"]}, "true": {"only": ["sky"], "filters": "none"}}
    cluster = Path(zonda.pipelines.__path__[0]) / "data" / "merging_cluster.fits"
    maps = {}
    for maker in (MaximumLikelihoodMap, BinMap):
        steps = [
            zonda.PointingDaisy(radius="3 arcmin", speed="50 arcsec/s", scan_duration="50 s"),
            zonda.SkyMap(file=cluster, centre="target"),
            zonda.AtmosphereLayers(pwv="5 mm"),
            zonda.WhiteNoise(),
            zonda.Efficiency(),
            maker(pixel="8 arcsec", half_difference=False),
        ]
        made = zonda.Pipeline(steps, runs=runs).run(zonda.Scene(**SCENE), threads=1)
        maps[maker] = [made[f"{name}/map"] for name in runs]
    (seen, true), (_, mean) = maps[MaximumLikelihoodMap], maps[BinMap]
    ok = mean.hits > 20
    one, two = true.signal[ok], mean.signal[ok]
    # a mean too, with other weights of detectors (some percent), and a plane less
    y, x = np.indices(ok.shape)
    basis = np.stack([np.ones(ok.sum()), x[ok], y[ok]], axis=1)
    rest = one - two
    rest -= basis @ np.linalg.lstsq(basis, rest, rcond=None)[0]
    assert rest.std() < 0.02 * two.std()
    assert 0.002 < (seen.signal[ok] - one).std() / one.std() < 0.3


def test_a_compressed_scan_crosses_processes():
    """Its arrays make the same scan: maps of campaigns have the bits of one run."""
    o, rng = observation(), np.random.default_rng(4)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(o.n_detectors, o.n_samples))
    run([Keeps(pixel="15 arcsec", half_difference=False)], o, noise)
    (scans,) = Keeps.kept
    again = CompressedScans.of(scans.arrays())
    for one, other in zip(scans.scans, again.scans, strict=True):
        assert vars(one.scan).keys() == vars(other.scan).keys()
        for key, value in (*vars(one.scan).items(), *vars(one.noise).items()):
            np.testing.assert_array_equal(value, {**vars(other.scan), **vars(other.noise)}[key])
    assert (again.scans[0].scan.nbytes) < 8 * o.n_detectors * o.n_samples


@pytest.mark.parametrize(
    ("how", "taken"),
    [
        ({"pixel": "15 arcsec"}, "plane"),
        ({"pixel": "15 arcsec", "undetermined": "none"}, ""),
        ({"nside": 8192}, "mean"),
    ],
)
def test_files_say_what_was_taken_off(how, taken, tmp_path):
    o, rng = observation(), np.random.default_rng(9)
    noise = SIGMA * rng.normal(size=(o.n_detectors, o.n_samples))
    found = run([MaximumLikelihoodMap(**how, half_difference=False)], o, noise).products["map"]
    found.write(tmp_path / "m.fits")
    assert zonda.read_map(tmp_path / "m.fits").taken_off == found.taken_off == taken
    keys = fits.getheader(tmp_path / "m.fits", 0)
    assert keys.get("TAKENOFF", "") == taken
    text = draw_map("map", "", "map", found, zonda.Plots())[0].caption
    assert (f"Its {taken} is taken off" in text) == bool(taken)


def test_what_was_taken_off_is_that_of_i():
    o, rng = observation(polarized=True, plate=True), np.random.default_rng(9)
    noise = SIGMA * rng.normal(size=(o.n_detectors, o.n_samples))
    how = {"stokes": "IQU", "pixel": "30 arcsec", "refine": 0, "tolerance": 0.09}
    found = mapped(o, noise, **how)
    assert [found.stokes(k).taken_off for k in "IQUP"] == ["plane", "", "", ""]


@pytest.mark.parametrize(
    ("how", "place"),
    [
        ({"free": 2, "modes": 1}, "free"),
        ({"weights": "uniform"}, "BinMap"),
        ({"noise": "scatter"}, "BinMap"),
        ({"noise": "simulated", "refine": 2}, "refine"),
        ({"noise": "simulated", "group": "all"}, "group: all"),
        ({"noise": "no_such_table.ecsv"}, "no_such_table"),
        ({"contents": "hits"}, "BinMap"),
        ({"mask": {"radius": "1 arcmin"}}, "belongs to filters"),
        ({"half_difference": "detectors"}, "half_difference"),
        ({"nside": 1024, "undetermined": "plane"}, "undetermined"),
    ],
)
def test_parameters_that_do_not_go_together(how, place):
    with pytest.raises(zonda.ZondaError, match=place):
        MaximumLikelihoodMap(**how)


def test_without_modes_none_is_free():
    assert MaximumLikelihoodMap(modes=0).free == 0
    assert MaximumLikelihoodMap(modes=2).free == 1


POINTED = [zonda.PointingDaisy(radius="3 arcmin", speed="50 arcsec/s", scan_duration="50 s")]
FORMED = [*POINTED, zonda.WhiteNoise(), zonda.Efficiency()]
SHIPPED = [
    zonda.CommonModeFilter(),
    zonda.Despline(),
    zonda.Detrend(),
    zonda.GroundFilter(),
    zonda.HighpassFilter(),
    zonda.PolynomialFilter(),
    zonda.Taper(),
    zonda.operator(lambda block: None, couples="time"),
]
EFFECTS = [
    zonda.Crosstalk(),
    zonda.GainDrift(),
    zonda.TimeConstant(tau="10 ms"),
    zonda.operator(lambda block: None),
]


@pytest.mark.parametrize("step", SHIPPED, ids=lambda step: type(step).__name__)
def test_what_removes_a_part_of_the_signal_is_refused_before_the_map(step):
    maker = MaximumLikelihoodMap(pixel="10 arcsec")
    with pytest.raises(PipelineError, match=f"behind {type(step).__name__}") as caught:
        zonda.Pipeline([*FORMED, step, maker])
    assert "leave" in caught.value.cure
    assert zonda.Pipeline([*FORMED, maker, step, BinMap(pixel="10 arcsec")])


def test_no_filter_is_missing_above():
    """Every shipped step that reads and changes the signal is a filter or an effect above."""
    every = {type(step).__name__ for step in (*SHIPPED, *EFFECTS)}
    # refused too, but it needs TOAST
    assert set(operators_that(changes)) - every == {"ToastOperator"}


def changes(cls):
    """Tell whether a class of zonda's own says that it changes signals."""
    streams = cls.requires, cls.provides
    own = cls.__module__.startswith("zonda.")
    return own and all(isinstance(names, frozenset) and "signal" in names for names in streams)


@pytest.mark.parametrize("step", EFFECTS, ids=lambda step: type(step).__name__)
def test_effects_of_the_instrument_stand_before_the_map(step):
    assert zonda.Pipeline([*FORMED, step, MaximumLikelihoodMap(pixel="10 arcsec")])


def test_recorded_streams_that_lack_slow_noise_are_refused():
    """A step tells of its filter; streams of others do not."""
    o, rng = observation(), np.random.default_rng(5)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(o.n_detectors, o.n_samples))
    powers = np.fft.rfft(noise)
    powers[:, : int(0.5 * o.duration)] = 0
    with pytest.raises(PipelineError, match="filter") as caught:
        mapped(o, np.fft.irfft(powers, o.n_samples))
    assert "MaximumLikelihoodMap" in str(caught.value)


def test_streams_without_noise_are_refused():
    o = observation()
    with pytest.raises(PipelineError, match="no noise"):
        run([MaximumLikelihoodMap(pixel="15 arcsec")], o, np.zeros((o.n_detectors, o.n_samples)))


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_noise_that_is_not_that_of_the_net_is_refused(scale):
    """A scene without white noise has that of rounding; a stream may be in another unit."""
    o, rng = observation(), np.random.default_rng(6)
    with pytest.raises(PipelineError, match="by the NET") as caught:
        mapped(o, scale * SIGMA * rng.normal(size=(o.n_detectors, o.n_samples)))
    assert "unit" in caught.value.cure


def test_flagged_samples_and_detectors_have_no_part():
    """Their values change no bit of the map."""
    o, rng = observation(), np.random.default_rng(7)
    o.flags[1000:1100] = 2
    o.detector_flags[3] = 2
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(o.n_detectors, o.n_samples))
    spoilt = noise.copy()
    spoilt[:, 1000:1100] = rng.choice([1e3, -1e3, np.nan], size=(o.n_detectors, 100))
    spoilt[3] = 5.0
    one, two = mapped(o, noise), mapped(o, spoilt)
    np.testing.assert_array_equal(one.signal, two.signal)
    np.testing.assert_array_equal(one.hits, two.hits)


def test_gaps_of_all_detectors_change_neither_weights_nor_noise():
    """Half of each 10 s is flagged: white noise and a load of 20 K."""
    o, rng = observation(), np.random.default_rng(11)
    o.flags[np.arange(o.n_samples) % 1000 < 500] = 2
    found = mapped(o, SIGMA * rng.normal(size=(37, o.n_samples)) + 20.0)
    ok = found.known & (found.hits > 30)
    # 37 variances of 3000 samples: 0.4 % of their mean; a line and three modes take little
    assert np.nanmedian(found.noise * np.sqrt(found.hits)) == pytest.approx(SIGMA, rel=0.02)
    error = (found.signal / found.noise)[ok]
    assert error.std() == pytest.approx(1, abs=3 / np.sqrt(2 * ok.sum()) + 0.08)


def excess(found):
    """Rms of a map over the white noise of its samples, without its plane."""
    ok = found.known & (found.hits > 0.3 * np.percentile(found.hits, 98))
    y, x = np.indices(ok.shape)
    one = SIGMA / np.sqrt(found.hits[ok])
    basis = np.stack([np.ones(one.size), x[ok], y[ok]], axis=1) / one[:, None]
    values = found.signal[ok] / one
    return (values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]).std()


GAPS = {
    "third": lambda d, t: (d % 2 == 0) & (t >= 2000) & (t < 4000),
    "end": lambda d, t: (d % 2 == 0) & (t >= 4000),
    "each": lambda d, t: (t - 150 * d) % 6000 < 1500,
    "single": lambda d, t: ((t * 2654435761 + d * 40503 * t) >> 9) % 10 < 3,
    "outside": lambda d, t: (d < 0) & (t < 0),
}


@pytest.mark.parametrize("gaps", GAPS)
def test_gaps_of_some_detectors_leave_the_noise_as_it_is(gaps):
    """A common walk of 2 sigma a sample, seen with gains of 0.8 to 1.2: without gaps maps have 1.07
    times their white noise. With the samples of gaps as zeros they had 2 and 5 times."""
    o, rng = observation(), np.random.default_rng(17)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(37, o.n_samples))
    lacking = GAPS[gaps](np.arange(37)[:, None], np.arange(o.n_samples))
    how = {"width": "9 arcmin"} if gaps == "outside" else {}
    whole, found = mapped(o, noise), mapped(o, np.where(lacking, np.nan, noise), **how)
    assert found.hits.sum() < 0.98 * whole.hits.sum()
    # some 500 pixels: 3 % each, and weights that are a little off
    assert excess(found) == pytest.approx(excess(whole), rel=0.1)
    # white levels are known to 2 %; if the walk were left in means of the samples that are there,
    # they would be 2.9 times too high with single gaps, and chi^2 0.1
    assert np.nanmedian(found.noise * np.sqrt(found.hits)) == pytest.approx(SIGMA, rel=0.02)
    assert found.chi2[0] == pytest.approx(1, abs=0.1)


def test_a_mask_of_the_source_leaves_the_noise_as_it_is():
    """Samples within 2 arcmin of the middle are missing: 16 %, at other times of each detector. The
    noise is that of the map without a mask."""
    o, rng = observation(), np.random.default_rng(17)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(37, o.n_samples))
    grid = grid_of(o, pixel="15 arcsec")
    at = np.divmod(Looking.of(o, grid).pixels(np.arange(37), 0, o.n_samples), grid.shape[1])
    r = np.hypot(*(x - (n - 1) / 2 for x, n in zip(at, grid.shape, strict=True))) * 15 / 60
    inside = r < 2
    assert 0.1 < inside.mean() < 0.2
    seen = mapped(o, np.where(inside, np.nan, noise))
    whole = mapped(o, noise)
    assert excess(seen) == pytest.approx(excess(whole), rel=0.1)
    assert seen.chi2[0] == pytest.approx(whole.chi2[0], abs=0.03)
    # levels as those of gaps above
    level = np.nanmedian(seen.noise * np.sqrt(seen.hits))
    assert level == pytest.approx(np.nanmedian(whole.noise * np.sqrt(whole.hits)), rel=0.03)


@pytest.mark.parametrize("gaps", [False, True])
def test_wafers_have_modes_of_their_own(gaps):
    """Three wafers with a walk each: one free mode of each takes it, one of all does not."""
    o, rng = observation(), np.random.default_rng(18)
    o.focalplane.wafer[:] = np.arange(37) % 3
    walks = np.cumsum(rng.normal(size=(3, o.n_samples)), axis=1) * 2 * SIGMA
    noise = walks[o.focalplane.wafer] + SIGMA * rng.normal(size=(37, o.n_samples))
    if gaps:
        noise[::2, 2000:4000] = np.nan
    how = {"modes": 1, "free": 1}
    wafers, band = mapped(o, noise, group="wafer", **how), mapped(o, noise, **how)
    # as without wafers: a third of what detectors have in common is lost, three times
    assert excess(wafers) < 1.25
    assert excess(band) > 1.5 * excess(wafers)


def test_a_wafer_of_one_detector_fills_no_gap_of_others():
    """Gaps are filled by the first mode of each wafer, of norm 1; that detector shares none."""
    states = []

    class Measured(MaximumLikelihoodMap):
        def measure(self, stream, model=None):
            states.append(super().measure(stream, model))
            return states[-1]

    o, rng = observation(), np.random.default_rng(19)
    o.focalplane.wafer[:] = np.arange(37) % 2 + 1
    o.focalplane.wafer[36] = 0
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(37, o.n_samples))
    noise[::3, 2000:4000] = np.nan
    run([Measured(pixel="30 arcsec", half_difference=False, group="wafer")], o, noise)
    groups = o.focalplane.wafer
    squares = [(states[0].scan.filler[groups == k] ** 2).sum() for k in range(3)]
    np.testing.assert_allclose(squares, [0, 1, 1], atol=1e-12)


def test_a_load_of_each_detector_leaves_the_map_as_it_is():
    """The line of a detector is one over its gaps too: here most have some."""
    o, rng = observation(), np.random.default_rng(12)
    noise = SIGMA * rng.normal(size=(37, o.n_samples))
    for k in range(37):
        noise[k, 100 * k : 150 * k] = np.nan
    load = np.arange(37)[:, None] * 0.1
    how = {"modes": 0, "free": 0, "refine": 0, "tolerance": 1e-7}
    one, two = mapped(o, noise, **how), mapped(o, noise + load, **how)
    # noise is found from the same baselines to rounding, of 1e-16 of 3.6 K over 1e-3 K and of
    # fixed-point weights, 2^-30
    assert np.nanmax(np.abs(one.signal - two.signal)) < 1e-5 * np.nanmedian(one.noise)


def test_baselines_follow_from_the_scan():
    """Waves across the field pass while it is crossed: 0.15 of that time, from 0.05 to 0.2 s."""
    step, o = MaximumLikelihoodMap(), observation()
    turn = np.linalg.norm(np.diff(boresights(o.boresight_radec), axis=1), axis=0)
    speed = np.median(turn) * o.sample_rate
    for field in (0.3, 1.0, 3.0):  # times a speed of one second
        o.focalplane.xi[:] = np.linspace(-0.5, 0.5, 37) * (field * speed - o.instrument.beam_fwhm)
        o.focalplane.eta[:] = 0.0
        expected = min(max(0.15 * field, 0.05), 0.2)
        # speeds of 1000 instants of 6000
        assert step.baseline_of(o) == pytest.approx(expected, rel=0.01)
    assert MaximumLikelihoodMap(baseline="0.3 s").baseline_of(o) == 0.3


def test_few_detectors_and_many_modes_keep_the_level_of_white_noise():
    for n_det, modes in ((1, 3), (2, 2), (7, 20), (37, 20)):
        o = scan(n_det, 6000, radius=3.0)
        noise = SIGMA * np.random.default_rng(13).normal(size=(n_det, o.n_samples))
        found = mapped(o, noise, modes=modes, free=0)
        # a variance of 5700 degrees of freedom or more: 1 % of sigma; levels that modes tell: 5 %
        level = np.nanmedian(found.noise * np.sqrt(found.hits))
        assert level == pytest.approx(SIGMA, rel=0.05), n_det


def test_a_detector_without_samples_has_no_part():
    o, rng = observation(), np.random.default_rng(14)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(37, o.n_samples))
    noise[5] = np.nan
    found = mapped(o, noise)
    ok = found.known & (found.hits > 50)
    assert (found.signal / found.noise)[ok].std() < 1.5
    with pytest.raises(PipelineError, match="no sample counts"):
        mapped(o, np.full_like(noise, np.nan))
    with pytest.raises(PipelineError, match="beyond the map") as caught:
        mapped(o, noise, width="1 arcmin", centre="12h -30d")
    assert "centre" in caught.value.cure


@pytest.mark.parametrize(
    ("n", "how", "cause", "cure"),
    [
        (10, {}, "in 1 of the 17 baselines", "make the map with BinMap"),
        (33, {"baseline": "0.02 s"}, "in 17 of the 18 baselines", "make the map with BinMap"),
        (300, {}, "in 15 of the 17 baselines", "set a shorter baseline, of which a scan has 17"),
        (6000, {"baseline": "5 ms"}, "one sample", "set baseline: 0.04 s"),
    ],
)
def test_scans_that_tell_too_little_are_refused(n, how, cause, cure):
    o = scan(5, n, radius=3.0)
    noise = SIGMA * np.random.default_rng(15).normal(size=(5, n))
    with pytest.raises(PipelineError, match=cause) as caught:
        mapped(o, noise, trend=2 if n == 33 else 1, **how)
    assert caught.value.cure.startswith(cure)


def test_a_scan_of_which_little_counts_is_refused():
    o = scan(5, 6000, radius=3.0)
    o.flags[100:] = 2
    with pytest.raises(PipelineError, match="in 5 of the 17 baselines"):
        mapped(o, SIGMA * np.random.default_rng(15).normal(size=(5, 6000)))


def test_the_noise_of_few_detectors_is_estimated_again_and_again():
    """White noise of ten detectors: the largest of 40 bins is 2.3 times white noise at first (14
    degrees of freedom), and estimates from the map do not drive it, or modes, up.
    """
    o = scan(10, 6000, radius=3.0)
    o.focalplane.net[:] = SIGMA / np.sqrt(o.sample_rate)
    noise = SIGMA * np.random.default_rng(4).normal(size=(10, o.n_samples))
    maker = MaximumLikelihoodMap(pixel="15 arcsec", half_difference=False, refine=3)
    (model,) = run([maker], o, noise).products["noise_model"].models
    assert model.own.max() < 3
    assert model.shared[:, 1:].max() < 4


def test_chi_square_where_most_samples_are_gaps():
    """A free mode has one value at each instant, of gaps, too, which 63 % of 20 detectors' samples
    are: chi^2 would be 0.9 if it had less."""
    o = scan(20, 6000, radius=3.0)
    o.focalplane.net[:] = SIGMA / np.sqrt(o.sample_rate)
    noise = SIGMA * np.random.default_rng(1).normal(size=(20, o.n_samples))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # samples beyond the map
        value, error = mapped(o, noise, width="5 arcmin").chi2
    assert value == pytest.approx(1, abs=4 * error)
