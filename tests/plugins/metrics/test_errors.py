"""The built-in metrics against what their equations say, on products made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS

from zonda.core import registry
from zonda.core.accuracy import metrics
from zonda.core.errors import InputError
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.sphere import FWHM_PER_SIGMA
from zonda.operators.diagnostics.power_spectrum import Spectrum

ARCSEC = np.pi / 648000
PIXEL, FWHM = 4.0, 12.0  # arcsec
SIDE = 128


def wcs(side, pixel):
    made = WCS(naxis=2)
    made.wcs.ctype, made.wcs.crval, made.wcs.crpix = (
        ["RA---TAN", "DEC--TAN"],
        [75, 20],
        [side / 2 + 0.5] * 2,
    )
    made.wcs.cdelt, made.wcs.cunit = [-pixel / 3600, pixel / 3600], ["deg", "deg"]
    return made.to_header()


def product(signal, noise=0.1, weights=None, **other):
    values = np.asarray(signal, float)
    weights = np.ones(values.shape) if weights is None else weights
    return MapProduct(
        values,
        np.full(values.shape, 50),
        weights,
        np.full(values.shape, noise),
        None,
        wcs(len(values), PIXEL),
        np.radians((75, 20)),
        PIXEL * ARCSEC,
        fwhm=FWHM * ARCSEC,
        **other,
    )


def data(runs=None, observations=(), **products):
    named = {name.replace("__", "/"): p for name, p in products.items()}
    return SimpleNamespace(
        products=named, provenance={"runs": runs or {}}, observations=list(observations)
    )


def blob(size=20.0, amplitude=1.0):
    """A Gaussian of FWHM `size` arcsec."""
    y, x = (np.indices((SIDE, SIDE)) - (SIDE - 1) / 2) * PIXEL
    return amplitude * np.exp(-(x**2 + y**2) / 2 / (size / FWHM_PER_SIGMA) ** 2)


def test_all_are_registered():
    assert set(registry.metrics) >= {"map_rms", "peak", "transfer", "psd", "structure"}
    for name in ("map_rms", "peak", "transfer", "psd", "structure"):
        assert metrics.get(name).says


def test_map_rms_is_the_difference_in_units_of_the_noise():
    metric = metrics.get("map_rms")
    random = np.random.default_rng(1)
    signal, weights = random.standard_normal((16, 16)), random.uniform(1, 2, (16, 16))
    change = 0.01 * random.standard_normal((16, 16))
    signal[0, 0] = np.nan  # a pixel without hits
    reference = metric.measure(data(map=product(signal, 0.1, weights)))
    found = metric.measure(data(map=product(signal + change, 0.1, weights)))
    use = np.isfinite(signal)
    expected = np.sqrt((weights * change**2)[use].sum() / weights[use].sum()) / 0.1
    assert metric.error(found, reference) == pytest.approx(expected)
    assert metric.error(reference, reference) == 0
    assert metric.floor(reference) == 1
    bound = abs(metric.summary(found["I"]) - metric.summary(reference["I"]))[0]
    assert bound <= metric.error(found, reference)
    unknown = metric.measure(data(map=product(signal, np.nan, weights)))
    assert metric.floor(unknown) is None
    rms = np.sqrt((weights * signal**2)[use].sum() / weights[use].sum())
    assert metric.error(found, unknown) == pytest.approx(expected * 0.1 / rms)
    with pytest.raises(InputError, match="size depends"):
        metric.error(metric.measure(data(map=product(signal[:8, :8]))), reference)


def test_peak_of_the_sky_alone():
    """A Gaussian of 20 arcsec under a beam of 12: the peak falls by 20^2 / (20^2 + 12^2); no
    pixel's centre lies on it.
    """
    metric = metrics.get("peak")
    runs = {"noiseless": {"only": ["sky"]}, "free": {"without": ["sky"]}}
    noisy = product(np.random.default_rng(0).standard_normal((SIDE, SIDE)))

    def measured(amplitude):
        return metric.measure(
            data(runs, map=noisy, noiseless__map=product(blob(amplitude=amplitude)))
        )

    reference = measured(-2.0)  # a decrement
    beside = np.exp(-(2 * (PIXEL / 2) ** 2) / 2 / (np.sqrt(544) / FWHM_PER_SIGMA) ** 2)
    assert reference["I"][0] == pytest.approx(-2 * 400 / 544 * beside, rel=1e-3)
    assert metric.error(measured(-2.02), reference) == pytest.approx(0.01)
    # white noise of 0.1 per pixel under a beam of sigma pixels: 0.1 / sqrt(4 pi sigma^2)
    sigma = FWHM / FWHM_PER_SIGMA / PIXEL
    assert metric.floor(reference) == pytest.approx(
        0.1 / np.sqrt(4 * np.pi) / sigma / abs(reference["I"][0]), rel=0.01
    )


def test_transfer_of_a_map_that_lost_half():
    metric = metrics.get("transfer")
    runs = {"noiseless": {"only": ["sky"]}}
    image = Image(blob(16.0), wcs(SIDE, PIXEL))
    beam = np.hypot(16.0, FWHM)
    seen = blob(beam, (16.0 / beam) ** 2)

    def measured(factor):
        return metric.measure(
            data(runs, map=product(seen), noiseless__map=product(factor * seen), input=image)
        )

    half, whole = measured(0.5), measured(1.0)
    assert whole["I"][0] == pytest.approx(1, abs=0.01)
    assert half["I"][0] == pytest.approx(0.5, abs=0.01)
    assert metric.error(half, whole) == pytest.approx(0.5, abs=0.01)
    assert 0 < metric.floor(whole) < 1


def polarized(i, q, u, noise=0.1):
    """A map whose Q and U have noise and weights of their own."""
    variances = np.ones(i.shape) * [[[1]], [[2]], [[4]]]
    planes = {
        "signal": np.stack([i, q, u]),
        "noise": noise * np.sqrt(variances),
        "weights": 1 / variances,
    }
    return product(i, noise).with_planes(**planes)


def test_each_plane_of_a_map_has_its_error():
    """I alone would say that nothing is wrong: what is changed is in Q."""
    runs = {"noiseless": {"only": ["sky"]}}
    given = Image(
        blob(16.0),
        wcs(SIDE, PIXEL),
        polarization=np.stack([blob(16.0, 0.2), 0 * blob()]),
        axis=np.array([0, 0, 1.0]),
    )
    beam = np.hypot(16.0, FWHM)
    seen = blob(beam, (16.0 / beam) ** 2)

    def measured(name, factor):
        whole = polarized(seen, 0.2 * factor * seen, 1e-6 * factor * seen)
        return metrics.get(name).measure(data(runs, map=whole, noiseless__map=whole, input=given))

    rms = float(np.sqrt((seen**2).mean()))
    # of U there is next to nothing: no relative error; of the input no transfer function
    expected = {
        "map_rms": {
            "I": 0.0,
            "Q": 0.1 * 0.2 * rms / np.sqrt(2) / 0.1,
            "U": 0.1 * 1e-6 * rms / 2 / 0.1,
        },
        "peak": {"I": 0.0, "Q": 0.1},
        "transfer": {"I": 0.0, "Q": 0.1},
    }
    for name, parts in expected.items():
        metric = metrics.get(name)
        found, reference = measured(name, 0.9), measured(name, 1.0)
        assert metric.errors(found, reference) == pytest.approx(parts, rel=0.02, abs=1e-12), name
        assert metric.error(found, reference) == max(metric.errors(found, reference).values())
        assert metric.errors({"I": found["I"]}, {"I": reference["I"]}) == {}
        moved, error = metric.mean_error([found, found], [reference, reference])
        assert moved > 0.04, name  # of the summaries: Q fell by a tenth
        assert error == pytest.approx(0, abs=1e-12)
        assert metric.floor(reference) is not None


def galactic():
    """The header of `wcs` in galactic coordinates."""
    made, middle = WCS(naxis=2), SkyCoord(75, 20, unit="deg").galactic
    made.wcs.ctype, made.wcs.crval, made.wcs.crpix = (
        ["GLON-TAN", "GLAT-TAN"],
        [middle.l.deg, middle.b.deg],
        [SIDE / 2 + 0.5] * 2,
    )
    made.wcs.cdelt, made.wcs.cunit = [-PIXEL / 3600, PIXEL / 3600], ["deg", "deg"]
    return made.to_header()


def test_transfer_of_q_is_that_of_the_maps_meridians_whatever_the_frame_of_the_input():
    """Q about the ICRS pole in an image with galactic axes: of resampling it loses what I loses."""
    runs = {"noiseless": {"only": ["sky"]}}
    given = Image(
        blob(16.0),
        galactic(),
        polarization=np.stack([blob(16.0, 0.2), 0 * blob()]),
        axis=np.array([0, 0, 1.0]),
    )
    beam = np.hypot(16.0, FWHM)
    seen = blob(beam, (16.0 / beam) ** 2)
    reference, found = (
        metrics.get("transfer").measure(data(runs, map=whole, noiseless__map=whole, input=given))
        for whole in (polarized(seen, 0.2 * factor * seen, 0 * seen) for factor in (1.0, 0.9))
    )
    assert reference["Q"][0] == pytest.approx(reference["I"][0], abs=0.01)
    assert reference["Q"][0][:4] == pytest.approx(1, abs=0.01)
    assert metrics.get("transfer").errors(found, reference)["Q"] == pytest.approx(0.1, rel=0.06)


def test_a_plane_that_is_lost_altogether_has_an_error():
    runs = {"noiseless": {"only": ["sky"]}}
    metric, seen = metrics.get("peak"), blob()
    whole, lost = (polarized(seen, factor * seen, 0 * seen) for factor in (0.2, 0.0))
    reference, found = (
        metric.measure(data(runs, map=one, noiseless__map=one)) for one in (whole, lost)
    )
    assert metric.errors(found, reference) == pytest.approx({"I": 0.0, "Q": 1.0})
    assert metric.error(found, reference) == pytest.approx(1.0)
    assert metric.mean_error([found, found], [reference, reference])[0] == pytest.approx(1.0)


def test_there_is_no_transfer_function_of_an_empty_sky():
    nothing = product(0 * blob())
    image = Image(0 * blob(), wcs(SIDE, PIXEL))
    with pytest.raises(InputError, match="zero everywhere"):
        metrics.get("transfer").measure(
            data({"noiseless": {"only": ["sky"]}}, map=nothing, noiseless__map=nothing, input=image)
        )


def test_psd_is_relative_in_every_bin():
    metric = metrics.get("psd")
    f = np.arange(1, 2001) * 0.01

    def measured(psd):
        return metric.measure(
            data(spectrum=Spectrum(f, {"signal": psd}, 50.0, 1.0, "PowerSpectrum", 16))
        )

    law = 1 + 1 / f
    reference = measured(law)
    assert metric.error(measured(1.02 * law), reference) == pytest.approx(0.02)
    top = measured(law * np.where(f > 2, 1.1, 1.0))  # a third of the bins, as ln(20 / 2) / ln(2000)
    assert metric.error(top, reference) == pytest.approx(
        0.1 * np.sqrt(np.log(10) / np.log(2000)), rel=0.1
    )
    assert 0 < metric.floor(reference) < 1 / np.sqrt(50)
    with pytest.raises(InputError, match="streams include signal"):
        metric.measure(data())


def test_structure_function_of_white_noise():
    """Independent samples of variance v: every value is 2 v; the error of 2 % more amplitude is 4
    %.
    """
    metric = metrics.get("structure")
    random = np.random.default_rng(3)
    stream = np.sqrt(0.5) * random.standard_normal((12, 4096))
    names = [f"d{k}" for k in range(12)]
    efficiency = np.full(12, 0.8)
    plane = SimpleNamespace(
        names=names,
        xi=random.uniform(-1, 1, 12),
        eta=random.uniform(-1, 1, 12),
        illumination_efficiency=efficiency,
    )

    def measured(values, **more):
        trace = SimpleNamespace(streams={"atmosphere": values, **more}, names=names)
        return metric.measure(
            data(observations=[SimpleNamespace(focalplane=plane)], **{"accuracy-structure": trace})
        )

    found = measured(stream)
    # a mean over >= 12 x 3072 squares of variance 2 (2 v)^2, correlated over two lags: 1.5 %; five
    # sigma
    assert found[0] == pytest.approx(1.0, rel=0.08)
    assert metric.error(measured(1.02 * stream), found) == pytest.approx(1.02**2 - 1)
    assert metric.floor(found) is None


def test_the_uncertainty_of_structure_functions_through_noise():
    """Equation (6) against the scatter of D over draws of the noise, the air unchanged."""
    metric = metrics.get("structure")
    random = np.random.default_rng(4)
    n_det, n, noise, names = 8, 2048, 0.4, [f"d{k}" for k in range(8)]
    air = np.cumsum(random.standard_normal((n_det, n)), axis=1) / 30 + random.standard_normal(
        (n_det, 1)
    )
    xi, eta = random.uniform(-1, 1, (2, n_det))
    plane = SimpleNamespace(
        names=names, xi=xi, eta=eta, illumination_efficiency=np.full(n_det, 0.8)
    )

    def measured(values, white):
        trace = SimpleNamespace(streams={"atmosphere": values, "white": white}, names=names)
        return metric.measure(
            data(observations=[SimpleNamespace(focalplane=plane)], **{"accuracy-structure": trace})
        )

    white = [0.8 * noise * random.standard_normal((n_det, n)) for _ in range(60)]
    reference = measured(air, white[0])
    through = np.array([measured(air + w / 0.8, w)[0] for w in white])
    scatter = np.sqrt(np.mean((through.std(0, ddof=1) / reference[0]) ** 2))
    # 60 draws know each scatter to 9 %; half the increments, and at most n_det / 2 pairs, counted
    # as independent is safe by up to sqrt(2)
    assert 0.7 * metric.floor(reference) < scatter < 1.2 * metric.floor(reference)


def test_the_atmosphere_is_traced_behind_the_sum():
    import zonda

    steps = zonda.load("mustang2_cluster").operators
    more = metrics.get("structure").steps(steps)
    at = [type(o).__name__ for o in more].index("Efficiency") + 1
    assert more[at].streams == ["atmosphere", "white"]
    assert [*more[:at], *more[at + 1 :]] == steps


def test_a_plain_function():
    metric = metrics.OfFunction(lambda d: d.products["x"])
    assert metric.error(
        metric.measure(data(x=[3.0, 4.0])), metric.measure(data(x=[0.0, 5.0]))
    ) == pytest.approx(np.sqrt(10) / 5)
    assert metric.error(np.zeros(2), np.zeros(2)) == 0
    assert metric.floor(np.ones(1)) is None
