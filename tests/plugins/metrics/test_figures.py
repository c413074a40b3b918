"""Figures against known answers: analytic maps and spectra, and where a default would be wrong."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS

import zonda
from zonda.core import registry
from zonda.core.accuracy import metrics
from zonda.core.errors import ZondaError
from zonda.core.figures import Choice, Figures, measure
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.smooth import SmoothField
from zonda.core.numerics.sphere import FWHM_PER_SIGMA, separation
from zonda.operators.diagnostics.power_spectrum import Spectrum, Welch
from zonda.plugins.checks import scenes
from zonda.plugins.metrics.common import as_seen
from zonda.plugins.metrics.maps import central_rms
from zonda.plugins.metrics.streams import slope

ARCSEC = np.pi / 648000
PIXEL, FWHM, SIDE = 4.0, 12.0, 128
SIGMA = FWHM / FWHM_PER_SIGMA / PIXEL
NAMES = (
    "central_rms",
    "peak_ratio",
    "peak_snr",
    "coverage",
    "transfer_at",
    "psd_slope",
    "crossing",
    "first_component",
    "mean_t_scan",
)


CENTRE = float(np.radians(75)), float(np.radians(20))


def header(side, pixel):
    made = WCS(naxis=2)
    made.wcs.ctype, made.wcs.crval, made.wcs.crpix = (
        ["RA---TAN", "DEC--TAN"],
        [75, 20],
        [side / 2 + 0.5] * 2,
    )
    made.wcs.cdelt, made.wcs.cunit = [-pixel / 3600, pixel / 3600], ["deg", "deg"]
    return made.to_header()


def product(signal, noise=0.1, pixel=PIXEL, fwhm=FWHM, hits=50, **other):
    values = np.asarray(signal, float)
    return MapProduct(
        values,
        np.broadcast_to(hits, values.shape).copy(),
        np.ones(values.shape),
        np.full(values.shape, noise),
        None,
        header(len(values), pixel),
        CENTRE,
        pixel * ARCSEC,
        fwhm=fwhm * ARCSEC,
        sample_rate=100.0,
        **other,
    )


def data(runs=None, observations=(), **products):
    named = {name.replace("__", "/"): p for name, p in products.items()}
    return SimpleNamespace(
        products=named, provenance={"runs": runs or {}}, observations=list(observations)
    )


def radius(pixel=PIXEL, side=SIDE):
    y, x = (np.indices((side, side)) - (side - 1) / 2) * pixel
    return np.hypot(x, y)


def blob(fwhm, amplitude=1.0):
    return amplitude * np.exp(-(radius() ** 2) / 2 / (fwhm / FWHM_PER_SIGMA) ** 2)


def white(seed, amplitude=1.0):
    return amplitude * np.random.default_rng(seed).standard_normal((SIDE, SIDE))


SKY = {"sky": {"only": ["sky"]}, "bare": {"only": ["sky"], "filters": "none"}}


def test_all_are_registered_and_described():
    assert set(registry.metrics) >= set(NAMES)
    for name in NAMES:
        assert isinstance(metrics.get(name), zonda.FigureMetric)
        assert Choice.parse(name).name == name == metrics.get(name).own_name()


@pytest.mark.parametrize("galactic", ["input", "map"])
def test_an_input_map_is_seen_where_it_is_whatever_its_frame(galactic):
    """A blob 40 arcsec from the middle. Cubic splines err by less than 1e-3 at 15 pixels per
    FWHM.
    """
    middle = SkyCoord(*CENTRE, unit="rad")
    source = middle.directional_offset_by(60 * u.deg, 40 * u.arcsec)
    turned, plain = dict(header(SIDE, PIXEL)), header(SIDE, PIXEL)
    turned |= {
        "CTYPE1": "GLON-TAN",
        "CTYPE2": "GLAT-TAN",
        "CRVAL1": middle.galactic.l.deg,
        "CRVAL2": middle.galactic.b.deg,
    }
    for key in ("RADESYS", "LONPOLE", "LATPOLE"):
        turned.pop(key, None)

    def of(cards):
        y, x = np.indices((SIDE, SIDE))
        away = WCS(cards).pixel_to_world(x, y).separation(source).arcsec
        return np.exp(-(away**2) / 2 / (60 / FWHM_PER_SIGMA) ** 2)

    before, after = (turned, plain) if galactic == "input" else (plain, turned)
    seen = as_seen(
        Image(of(before), before), replace(product(of(after)), header=after), fwhm=1e-3 * ARCSEC
    )
    np.testing.assert_allclose(seen[16:-16, 16:-16], of(after)[16:-16, 16:-16], atol=1e-3)


# ---- central_rms


def test_central_rms_counts_what_is_within_the_radius():
    """1 K within 40 arcsec, 3 K beyond: sqrt((40^2 + 9 (60^2 - 40^2)) / 60^2) within an
    arcminute.
    """
    steps = data(map=product(np.where(radius() < 40, 1.0, 3.0)))
    assert measure(steps, "central_rms", smooth="none", radius="36 arcsec").value == pytest.approx(
        1
    )
    expected = np.sqrt((1600 + 9 * 2000) / 3600)
    # pixels of 4 arcsec: the rim of either circle is known to 1 % of its area
    assert measure(steps, "central_rms", smooth="none").value == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("fwhm", [12.0, 24.0])
def test_central_rms_of_white_noise_behind_the_beam(fwhm):
    """White noise of 1 K per pixel behind a Gaussian of s pixels: 1 / (2 sqrt(pi) s), within its
    standard error.
    """
    found = measure(data(map=product(white(1), fwhm=fwhm)), "central_rms", radius="3 arcmin")
    expected = 1 / (2 * np.sqrt(np.pi) * fwhm / FWHM_PER_SIGMA / PIXEL)
    assert found.unit == "K_RJ"
    assert 0 < found.error < 0.1 * expected
    assert abs(found.value - expected) < 3 * found.error
    other = measure(
        data(map=product(white(1), fwhm=fwhm)), "central_rms", radius="3 arcmin", smooth="18 arcsec"
    ).value
    assert other == pytest.approx(1 / (2 * np.sqrt(np.pi) * 18 / FWHM_PER_SIGMA / PIXEL), rel=0.1)


def test_standard_error_of_the_central_rms():
    """Its square is the variance over realizations: 200 of them know that to 10 %; three sigma."""
    found = np.array(
        [
            central_rms(product(white(seed)).smoothed(FWHM * ARCSEC), 60 * ARCSEC)
            for seed in range(200)
        ]
    )
    assert found[:, 0].std() == pytest.approx(found[:, 1].mean(), rel=3 * 0.05)


def test_central_rms_of_another_signal():
    two = data(map=product(white(1)), source_free__map=product(white(1, 0.5)))
    assert measure(two, "central_rms", signal="source_free").value == pytest.approx(
        measure(two, "central_rms").value / 2
    )
    with pytest.raises(ZondaError, match="there is no map 'noiseless/map'"):
        measure(two, "central_rms", signal="noiseless")


# ---- peaks


def test_peak_ratio_is_that_of_the_smoothed_maps():
    """Filters that leave 0.6 of a source and make it narrower, 30 to 20 arcsec, behind 12 arcsec:
    0.6 x 400/544 / (900/1044).
    """
    found = data(SKY, sky__map=product(blob(20, -0.6)), bare__map=product(blob(30, -1)))
    middle = measure(found, "peak_ratio")
    expected = 0.6 * (400 / 544) / (900 / 1044)
    # no pixel's centre is on the peak: 8 arcsec2 off it, a factor exp(-8 / 2 s^2) in either map
    off = np.exp(-4 * FWHM_PER_SIGMA**2 * (1 / 544 - 1 / 1044))
    assert middle.value == pytest.approx(expected * off, rel=2e-3)
    off = np.exp(-4 * FWHM_PER_SIGMA**2 * (1 / 400 - 1 / 900))
    assert measure(found, "peak_ratio", smooth="none").value == pytest.approx(0.6 * off)


def test_peak_ratio_takes_the_same_sign():
    """What filters leave of a decrement is not the larger hump beside it."""
    after = blob(20, -0.3) + 2 * np.roll(blob(20), 40, axis=0)
    assert measure(
        data(SKY, sky__map=product(after), bare__map=product(blob(20, -1))), "peak_ratio"
    ).value == pytest.approx(0.3, rel=1e-3)


def test_peak_ratio_against_the_input_behind_the_beam():
    """A map of the beam-convolved input has the ratio 1, though the input's own peak is 544 / 400
    higher.
    """
    seen = product(blob(np.sqrt(544), 400 / 544))
    image = Image(blob(20), header(SIDE, PIXEL))
    found = measure(
        data({"sky": {"only": ["sky"]}}, sky__map=seen, input=image), "peak_ratio", against="input"
    )
    assert found.value == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("step", [(2, 2), (4, 2), (2, 4), "CAR"])
def test_peak_ratio_against_an_input_of_any_pixels_in_a_map_of_uneven_depth(step):
    """Deep in the middle, so that smoothing by weight lifts a source there, in the map and in the
    input alike: 1, to 0.5 %.

    It was 1.029 for square pixels, as the input was smoothed without weights, and 1.057 for 4 x 2
    arcsec.
    """
    seen = product(blob(np.sqrt(544), 400 / 544))
    seen.weights = np.exp(-((radius() / 15) ** 2)) + 0.05
    cards = dict(header(256, 2.0))
    if step == "CAR":
        cards |= {
            "CTYPE1": "RA---CAR",
            "CTYPE2": "DEC--CAR",
            "CRVAL2": 0.0,
            "CRPIX2": 128.5 - 20 * 1800,
        }
    else:
        cards |= {"CDELT1": -step[0] / 3600, "CDELT2": step[1] / 3600}
    y, x = np.indices((256, 256))
    away = WCS(cards).pixel_to_world(x, y).separation(SkyCoord(*CENTRE, unit="rad")).arcsec
    image = Image(np.exp(-(away**2) / 2 / (20 / FWHM_PER_SIGMA) ** 2), cards)
    found = measure(
        data({"sky": {"only": ["sky"]}}, sky__map=seen, input=image), "peak_ratio", against="input"
    )
    assert found.value == pytest.approx(1, abs=0.005)


def on_the_sky(world, shape, fwhm, peak=1.0):
    """A Gaussian about `CENTRE` at the pixels of an image, by angles on the sky."""
    y, x = np.indices(shape)
    lon, lat = np.radians(world.all_pix2world(x, y, 0))
    return peak * np.exp(-4 * np.log(2) * (separation(lon, lat, CENTRE) / ARCSEC / fwhm) ** 2)


def car(pixel, shape):
    """A CAR image about `CENTRE`, square on the sky at declination 20 to 6 %."""
    world = WCS(naxis=2)
    world.wcs.ctype, world.wcs.crval, world.wcs.cdelt = (
        ["RA---CAR", "DEC--CAR"],
        [75, 0],
        [-pixel / 3600, pixel / 3600],
    )
    world.wcs.crpix = [(shape[1] + 1) / 2, (shape[0] + 1) / 2 - 20 * 3600 / pixel]
    return world


def test_peak_ratio_of_a_car_map():
    world = car(2.0, (161, 161))
    seen = replace(
        product(on_the_sky(world, (161, 161), np.sqrt(544), 400 / 544)), header=world.to_header()
    )
    image = Image(blob(20), header(SIDE, PIXEL))
    found = measure(
        data({"sky": {"only": ["sky"]}}, sky__map=seen, input=image), "peak_ratio", against="input"
    )
    assert found.value == pytest.approx(1, abs=3e-3)


def test_the_error_of_an_rms_on_a_car_map():
    """The scatter of the rms of 200 maps of white noise, smoothed: known to 1 / sqrt(400) = 5 %,
    tested at 3.5 sigma.
    """
    world = car(2.0, (121, 121))
    noise = replace(product(np.zeros((121, 121)), pixel=2.0), header=world.to_header())
    rng, values = np.random.default_rng(3), []
    for _ in range(200):
        one = replace(noise, signal=rng.standard_normal((121, 121))).smoothed(FWHM * ARCSEC)
        values.append(central_rms(one, 100 * ARCSEC))
    value, error = np.array(values).T
    assert np.std(value) == pytest.approx(error.mean(), rel=0.18)


def test_peak_snr():
    """A peak of 2 K behind the beam, white noise of 0.1 K per pixel; noise maps twice as loud halve
    the ratio.
    """
    both = blob(np.sqrt(2) * FWHM, 4)  # what smoothing leaves of a source of FWHM 12: half its peak
    peak = both.max() / 2
    maps = data(
        {"free": {"without": ["sky"], "modes": "full"}},
        map=product(blob(FWHM, 4)),
        free__map=product(white(3, 0.2)),
    )
    alone = measure(maps, "peak_snr", noise="white").value
    assert alone == pytest.approx(peak / (0.1 / (2 * np.sqrt(np.pi) * SIGMA)), rel=0.02)
    real = measure(maps, "peak_snr", radius="3 arcmin")
    assert real.value == pytest.approx(alone / 2, abs=3 * real.error)
    noise = measure(maps, "central_rms", signal="free", radius="3 arcmin")
    assert real.error == pytest.approx(np.hypot(1, real.value * noise.error / noise.value))
    with pytest.raises(ZondaError, match="no signal"):
        measure(data(map=product(blob(12))), "peak_snr")
    with pytest.raises(ZondaError, match="the noise map is zero"):
        measure(
            data(map=replace(product(blob(12)), half_difference=np.zeros((SIDE, SIDE)))),
            "peak_snr",
            noise="half_difference",
        )


def test_the_noise_of_peak_snr_is_measured_in_five_beams():
    """Beams of 4 arcmin: a circle of 1 arcmin about the centre holds one value, which may be near
    zero. White noise alone has the ratio that NET and samples give, to the rms of some 11 values:
    (2 x 11)^-1/2 = 0.21."""
    for seed in range(6):
        noise = product(white(seed), noise=1.0, pixel=60.0, fwhm=240.0)
        maps = data({"free": {"without": ["sky"], "modes": "full"}}, map=noise, free__map=noise)
        alone = measure(maps, "peak_snr", noise="white").value
        assert measure(maps, "peak_snr").value / alone == pytest.approx(
            1, abs=0.6
        )  # 3 sigma of 0.21
        assert (
            measure(maps, "peak_snr").value == measure(maps, "peak_snr", radius="10 arcmin").value
        )


# ---- coverage


@pytest.mark.parametrize(("pixel", "fwhm"), [(4.0, 12.0), (2.0, 9.0)])
def test_coverage(pixel, fwhm):
    """50 samples at 100 Hz in each pixel; half as many to the west, where an area of more than half
    the time ends.
    """
    hits = np.full((SIDE, SIDE), 50)
    hits[:, : SIDE // 4] = 20
    found = data(map=product(white(1), pixel=pixel, fwhm=fwhm, hits=hits))
    per_beam = 0.5 * np.pi * fwhm**2 / (4 * np.log(2)) / pixel**2
    time = measure(found, "coverage")
    assert time.value == pytest.approx(per_beam)
    assert time.unit == "s"
    area = measure(found, "coverage", of="area")
    assert area.value == pytest.approx(0.75 * (SIDE * pixel / 60) ** 2, rel=1e-4)
    assert area.unit == "arcmin2"
    assert measure(found, "coverage", of="area", least="30 %").value == pytest.approx(
        area.value * 4 / 3, rel=1e-4
    )


# ---- scales


@pytest.mark.parametrize("scale", [40, 120])
def test_transfer_at_a_scale(scale):
    """A filter H(k) = 1 / (1 + (k L)^-2) with L = 60 arcsec: T at 40 and at 120 arcsec; the ring is
    narrow.
    """
    before = white(5)
    k = np.hypot(*np.meshgrid(*[np.fft.fftfreq(SIDE, PIXEL)] * 2, indexing="ij"))
    k[0, 0] = 1e-9
    after = np.fft.ifft2(np.fft.fft2(before) / (1 + (k * 60) ** -2)).real
    found = measure(
        data(SKY, sky__map=product(after), bare__map=product(before)),
        "transfer_at",
        scale=f"{scale} arcsec",
        width=0.3,
    )
    # the ring and the window's width blur H by a few per cent of its change over a factor 1.35 in k
    assert found.value == pytest.approx(1 / (1 + (scale / 60) ** 2), abs=0.02 + 3 * found.error)
    kept = measure(
        data(SKY, sky__map=product(0.4 * before), bare__map=product(before)),
        "transfer_at",
        kind="amplitude",
    )
    assert kept.value == pytest.approx(0.4)
    narrow = f"{scale} arcsec"
    inside = measure(
        data(SKY, sky__map=product(np.where(radius() < 150, before, 0)), bare__map=product(before)),
        "transfer_at",
        scale=narrow,
        radius="140 arcsec",
    )
    assert inside.value == pytest.approx(1)  # the window excludes what was cut off
    assert "window within 2.33′" in inside.description


# ---- spectra


def spectrum(psd, f):
    return data(spectrum=Spectrum(f, psd, 50.0, 1.0, "PowerSpectrum", 16))


def test_slope_and_crossing_of_power_laws():
    f = np.arange(1, 4001) * 0.005
    laws = spectrum(
        {
            "atmosphere": 3e-6 * f**-3.0,
            "white": np.full(f.size, 2e-6),
            "signal": 3e-6 * f**-3.0 + 2e-6,
        },
        f,
    )
    assert measure(
        laws, "psd_slope", stream="atmosphere", low="0.1 Hz", high="1 Hz"
    ).value == pytest.approx(-3)
    assert measure(laws, "psd_slope", low="10 Hz", high="20 Hz").value == pytest.approx(0, abs=2e-3)
    assert measure(laws, "crossing").value == pytest.approx(1.5 ** (1 / 3), rel=0.02)
    level = measure(laws, "crossing", net="2 mK s(1/2)")  # 2 NET^2 = 8e-6
    assert level.value == pytest.approx((3 / 8) ** (1 / 3), rel=0.02)
    assert level.unit == "Hz"
    with pytest.raises(ZondaError, match="exceeds everywhere"):
        measure(laws, "crossing", net="1 nK s(1/2)")
    with pytest.raises(ZondaError, match=r"no stream .dust.\n.*choose from: atmosphere"):
        measure(laws, "crossing", stream="dust")


def test_standard_error_of_the_slope():
    """White noise through Welch's method: slopes scatter about 0 as they say; 150 series know that
    to 6 %, three sigma.
    """
    welch, random = Welch(4096, 100.0, 512), np.random.default_rng(8)
    use = (welch.frequency > 2) & (welch.frequency < 40)
    rows = [
        slope(np.log(welch.frequency[use]), np.log(welch(random.standard_normal(4096))[use]))
        for _ in range(150)
    ]
    values, errors = np.array(rows).T
    assert abs(values.mean()) < 3 * values.std() / np.sqrt(150)
    assert values.std() / errors.mean() == pytest.approx(1, abs=3 * 0.06)


# ---- levels


def test_mean_t_scan_of_the_levels_that_were_resolved():
    """epsilon T / (zeta t), with another efficiency for each detector; a flagged one does not
    count.
    """
    scan = scenes.scan(4, 500)
    scan.focalplane.main_beam_efficiency = np.array([0.3, 0.2, 0.3, 0.3])
    scan.focalplane.illumination_efficiency = np.array([0.8, 0.8, 0.7, 0.8])
    scan.smooth["atmosphere"] = SmoothField.constant([20.0, 20.0, 20.0, 99.0], 500)
    scan.smooth["transmission"] = SmoothField.constant([0.9, 0.9, 0.8, 0.9], 500)
    scan.detector_flags[3] = 1
    one = data(observations=[scan])
    expected = np.mean([0.8 * 20 / 0.27, 0.8 * 20 / 0.18, 0.7 * 20 / 0.24])
    assert measure(one, "mean_t_scan").value == pytest.approx(expected)
    assert measure(one, "mean_t_scan", of="atmosphere").value == pytest.approx(20)
    with pytest.raises(ZondaError, match="levels of the atmosphere are not known"):
        measure(data(observations=[scenes.scan(4, 500)]), "mean_t_scan")


# ---- how they are named


def test_names_and_parameters():
    asked = Choice.parse({"central_rms": {"radius": "30 arcsec", "signal": "source_free"}})
    assert asked.name == "central_rms(radius=30 arcsec, signal=source_free)"
    assert Choice.parse(asked.name) == asked
    assert asked.metric.radius == pytest.approx(30 * ARCSEC)
    assert metrics.get("peak_snr(noise=white, within=2 arcmin)").within == pytest.approx(
        120 * ARCSEC
    )
    maps = data(map=product(white(1)))
    rms = metrics.get("central_rms(radius=2 arcmin)")
    one, two = rms.measure(maps), rms.measure(data(map=product(white(1, 1.02))))
    assert rms.error(two, one) == pytest.approx(0.02)
    assert rms.floor(one) == pytest.approx(one[1] / one[0])


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("central_rmss", "did you mean 'central_rms'"),
        ({"central_rms": {"radius": "30 Hz"}}, "angle"),
        ({"central_rms": {"radios": "30 arcsec"}}, "radios"),
        ("central_rms(radius)", "parameter=value"),
        ("central_rms(radius=1 arcmin", "name\\(parameter=value"),
        ("map_rms(radius=1 arcmin)", "no parameters"),
        (["central_rms"], "as a metric"),
    ],
)
def test_mistakes_in_names(wrong, says):
    with pytest.raises(ZondaError, match=says):
        zonda.MeasureFigures(metrics=[wrong])


def test_figures_by_name():
    figures = Figures([zonda.Figure("a", 1.0, "s", 0.1, "text"), zonda.Figure("b", 2.0)])
    assert [str(f) for f in figures] == ["a = 1 +- 0.1 s", "b = 2"]
    assert figures["a"].error == 0.1
    with pytest.raises(KeyError, match="there are a, b"):
        figures["c"]


def source(fwhm, side=SIDE):
    y, x = np.indices((side, side)) - (side - 1) / 2
    return np.exp(-4 * np.log(2) * (x**2 + y**2) * (PIXEL / fwhm) ** 2)


def test_fluxes_in_apertures_and_what_is_left_of_them():
    """The filters leave 0.7 of the sky within 20 arcsec, and less further out; noise is known."""
    band, rng = scenes.camera().band, np.random.default_rng(5)
    sky = source(24.0)
    left = 0.7 * sky - 0.02
    noise, half = (rng.normal(0, 0.01, sky.shape) for _ in range(2))
    runs = {
        "plain": {"only": ["sky"], "filters": "none"},
        "filtered": {"only": ["sky"]},
    }
    made = data(
        runs,
        map=product(left + noise, noise=0.01, band=band),
        plain__map=product(sky, band=band),
        filtered__map=product(left, band=band),
    )
    made.products["map"].half_difference = half
    area = np.pi * (20 * ARCSEC) ** 2
    jansky = 1e6 * product([[1.0]], band=band).to("MJy/sr").signal[0, 0]
    flux = jansky * np.pi / (4 * np.log(2)) * (24 * ARCSEC) ** 2 * (1 - 2 ** (-4 * (20 / 24) ** 2))
    found = measure(made, "aperture_flux", radius="20 arcsec", signal="plain")
    # pixels of a sixth of the FWHM: 2 % (core.maps.apertures)
    assert found.value == pytest.approx(flux, rel=0.02)
    assert found.error == 0  # of a signal without noise
    assert found.unit == "Jy"
    ratio = measure(made, "aperture_ratio", radius="20 arcsec", of="sky")
    wanted = 0.7 - 0.02 * jansky * area / flux
    assert ratio.value == pytest.approx(wanted, rel=0.01)
    noisy = measure(made, "aperture_ratio", radius="20 arcsec")
    white = 0.01 * jansky * PIXEL * ARCSEC * np.sqrt(area) / flux
    # the factor of 30 apertures scatters by 1 / sqrt(60) = 13 %
    assert noisy.error == pytest.approx(white, rel=0.4)
    assert abs(noisy.value - ratio.value) < 4 * white
    assert "9 apertures on half the difference" in measure(made, "aperture_flux").description
    # what the filters took of the ring comes back, all of the constant
    parted = measure(
        made, "aperture_ratio", radius="20 arcsec", inner="60 arcsec", outer="90 arcsec", of="sky"
    )
    assert parted.value == pytest.approx(0.7, rel=0.001)


def test_the_aperture_is_where_it_is_asked_for(tmp_path):
    """A run: two sources, of which the fainter is away from the centre, without filters."""
    sky = source(24.0, 64) + 0.5 * np.roll(source(24.0, 64), 15, axis=0)  # 60 arcsec north
    steps = [
        zonda.PointingDaisy(radius="2 arcmin", scan_duration="60 s"),
        zonda.SkyMap(map=1e-3 * sky, pixel_size="4 arcsec", centre="05h +20d", unit="K_RJ"),
        zonda.Efficiency(),
        zonda.BinMap(pixel="6 arcsec"),
        zonda.MeasureFigures(
            metrics=[
                {"aperture_flux": {"radius": "24 arcsec"}},
                {"aperture_flux": {"radius": "24 arcsec", "centre": "75 deg 20.016666667 deg"}},
                {"aperture_ratio": {"radius": "24 arcsec"}},
            ]
        ),
    ]
    where = scenes.scene(scenes.camera(61), target="05h +20d")
    bright, faint, ratio = zonda.Pipeline(steps).run(where, threads=1)["figures"]
    assert faint.value == pytest.approx(0.5 * bright.value, rel=0.05)
    assert ratio.value == 1  # the map is that without filters
    assert "20.016666667" in faint.description
    with pytest.raises(ZondaError, match="radius <= inner < outer"):
        measure(None, "aperture_flux", radius="1 arcmin", inner="30 arcsec", outer="2 arcmin")
