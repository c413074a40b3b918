"""The same seed gives the same bits, two seeds have nothing in common: noise, atmosphere and maps
of a whole run.

Two bands, or two instruments, of one seed have noise of their own and see one atmosphere."""

import numpy as np
import pytest

import zonda

NOISE = ("white", "pink", "atmosphere")


def run(seed, scans=1, duration="82 s", camera=(), **more):
    scene = zonda.Scene(
        site="green_bank",
        instrument="mustang2",
        time="2024-11-25T07:00",
        target="05h +20d",
        seed=seed,
    )
    camera = scene.instrument.model_copy(update={"detectors": 37, **dict(camera)})
    steps = [
        zonda.PointingDaisy(
            scan_duration=duration, radius="1 arcmin", sample_rate="50 Hz", scans=scans
        ),
        zonda.AtmosphereLayers(pwv="7.7 mm"),
        zonda.WhiteNoise(scatter="5 %"),
        zonda.PinkNoise(**more),
        zonda.Efficiency(scatter="5 %", calibration_error="1 %"),
        zonda.HighpassFilter(frequency="0.08 Hz"),
        zonda.CommonModeFilter(),
        zonda.BinMap(pixel="4 arcsec", width="6 arcmin"),
    ]
    return zonda.Pipeline(steps).run(
        scene.model_copy(update={"instrument": camera}), keep=[*NOISE, "signal"]
    )


@pytest.fixture(scope="module")
def runs():
    return {seed: run(seed, scans=2) for seed in (1, 2, 2**62)}


def whitened(stream):
    """Second differences: what is slow, and so the same by chance, is gone."""
    d = np.diff(stream, 2, axis=1)
    return (d - d.mean(axis=1, keepdims=True)) / d.std(axis=1, keepdims=True)


def correlation(a, b):
    """Correlation of two series of n samples, in its standard error. Second differences of white
    noise have, over lags, a sum of squared autocorrelations of 1 + 2 (4/9 + 1/36) = 35/18, so r^2 =
    35/18 / n."""
    return np.abs((a * b).mean()) / np.sqrt(35 / 18 / a.size)


@pytest.mark.parametrize("stream", ["white", "pink"])
def test_noise_of_two_seeds_scans_and_detectors_is_incoherent(runs, stream):
    made = {
        (seed, o.index): whitened(o.detdata[stream])
        for seed, data in runs.items()
        for o in data.observations
    }
    keys = list(made)
    for k, one in enumerate(keys):
        for other in keys[k + 1 :]:
            for lag in (0, 1):  # the same detector, and its neighbour
                assert correlation(made[one], np.roll(made[other], lag, axis=0)) < 5, (one, other)
        assert correlation(made[one], np.roll(made[one], 1, axis=0)) < 5


def test_air_of_two_seeds_is_incoherent(runs):
    """The air is smooth: its part above 0.2 Hz, about 82 s x 0.5 Hz independent values, all
    detectors alike.
    """
    from scipy.signal import butter, sosfiltfilt

    fast = {}
    for seed, data in runs.items():
        mean = data.observations[0].detdata["atmosphere"].mean(axis=0)
        x = sosfiltfilt(butter(4, 0.2, "high", fs=50, output="sos"), mean - mean.mean())[200:-200]
        fast[seed] = x / x.std()
    seeds = list(fast)
    for k, a in enumerate(seeds):
        for b in seeds[k + 1 :]:
            spectra = [np.abs(np.fft.rfft(fast[s])) ** 2 for s in (a, b)]
            error = np.sqrt(
                (spectra[0] * spectra[1]).sum() / (spectra[0].sum() * spectra[1].sum())
            )  # Bartlett
            assert abs((fast[a] * fast[b]).mean()) < 4.5 * error
            assert error < 0.4


def test_maps_of_two_seeds_are_incoherent_and_of_one_the_same(runs):
    again = run(1, scans=2)
    for name in ("signal", "weights", "noise", "half_difference", "hits"):
        assert np.array_equal(
            getattr(again.products["map"], name),
            getattr(runs[1].products["map"], name),
            equal_nan=True,
        )
    for name in (*NOISE, "signal"):
        for a, b in zip(again.observations, runs[1].observations, strict=True):
            assert np.array_equal(a.detdata[name], b.detdata[name])
    one, other = (runs[s].products["map"] for s in (1, 2))
    use = (one.hits > 20) & (other.hits > 20)
    a, b = (p.signal[use] * np.sqrt(p.hits[use]) for p in (one, other))
    assert abs(np.corrcoef(a, b)[0, 1]) < 6 / np.sqrt(use.sum())  # pixels are nearly independent
    halves = [p.half_difference[use] * np.sqrt(p.hits[use]) for p in (one, other)]
    both = np.isfinite(halves).all(axis=0)
    assert abs(np.corrcoef(halves[0][both], halves[1][both])[0, 1]) < 6 / np.sqrt(both.sum())


BAND = zonda.Band(name="mustang2_90ghz", low="75 GHz", high="105 GHz")
OTHERS = {
    "band": {"band": BAND.model_copy(update={"name": "other"})},
    "passband": {"band": zonda.Band(name=BAND.name, low="75 GHz", high="106 GHz")},
    "instrument": {"name": "other", "band": BAND},
}


@pytest.fixture(scope="module")
def one_band():
    return run(1, camera={"band": BAND}, shared=0.8).observations[0]


@pytest.mark.parametrize("other", OTHERS)
def test_two_bands_have_noise_of_their_own_and_one_atmosphere(one_band, other):
    two = run(1, camera=OTHERS[other], shared=0.8).observations[0]
    whole = [{name: o.detdata[name] for name in ("white", "pink")} for o in (one_band, two)]
    common = [streams["pink"].mean(axis=0, keepdims=True) for streams in whole]
    assert correlation(*(whitened(streams["white"]) for streams in whole)) < 5
    assert correlation(*(whitened(mean) for mean in common)) < 5  # mostly what detectors share
    assert (
        correlation(
            *(whitened(streams["pink"] - mean) for streams, mean in zip(whole, common, strict=True))
        )
        < 5
    )
    n = one_band.n_detectors
    for drawn in (
        "net",
        "main_beam_efficiency",
    ):  # scattered: correlations of n pairs have a standard error of n^-1/2
        assert abs(
            np.corrcoef(getattr(one_band.focalplane, drawn), getattr(two.focalplane, drawn))[0, 1]
        ) < 4 / np.sqrt(n)
    air = [o.detdata["atmosphere"].astype(np.float64) for o in (one_band, two)]
    # one turbulence, seen through opacities that differ by the passband alone
    assert np.corrcoef(*(a.ravel() - a.mean() for a in air))[0, 1] > 0.9999


def test_a_band_has_its_noise_whatever_else_is_changed(one_band):
    """Where one setting is compared with another, the random numbers stay: detectors, NET and beams
    do not draw anew.
    """
    changed = run(
        1, camera={"band": BAND, "detectors": 20, "fwhm": 1e-4, "description": "other"}, shared=0.8
    ).observations[0]
    for stream in ("white", "pink"):
        a, b = (whitened(o.detdata[stream]) for o in (one_band, changed))
        assert np.corrcoef(a[:20].ravel(), b.ravel())[0, 1] > 0.9999
