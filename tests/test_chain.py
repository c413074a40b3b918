"""The whole chain: the paper's simulation in small."""

import math

import numpy as np
import pytest

import zonda

ARCSEC = np.radians(1 / 3600)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A map of one 5 mK_RJ pixel-wide source at the target, 1 arcsec pixels, 301 x 301."""
    from astropy.io import fits

    values = np.zeros((301, 301), np.float32)
    values[150, 150] = 5.0
    image = fits.PrimaryHDU(values)
    image.header.update(
        CTYPE1="RA---TAN",
        CTYPE2="DEC--TAN",
        CRPIX1=151,
        CRPIX2=151,
        CRVAL1=75,
        CRVAL2=20,
        CDELT1=-1 / 3600,
        CDELT2=1 / 3600,
    )
    image.header.update(CUNIT1="deg", CUNIT2="deg", RADESYS="ICRS", BUNIT="K", TEMPSCAL="K_RJ")
    path = tmp_path_factory.mktemp("maps") / "source.fits"
    image.writeto(path)
    return path


def scene(seed=1, **more):
    return zonda.Scene(
        **{
            "site": "green_bank",
            "instrument": "mustang2",
            "time": "2024-11-25T07:00",
            "target": "05h +20d",
            "seed": seed,
            **more,
        }
    )


def steps(source, scan_duration="20 s", modes=1, scans=1, highpass=True, **binning):
    chain = [
        zonda.PointingDaisy(
            radius="1.5 arcmin",
            speed="50 arcsec/s",
            scan_duration=scan_duration,
            scans=scans,
            sample_rate="100 Hz",
        ),
        zonda.SkyMap(file=source),
        zonda.AtmosphereLayers(pwv="7.7 mm", pwv_rms="0.5 %"),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
    ]
    if highpass:
        chain.append(zonda.HighpassFilter(frequency="0.08 Hz"))
    if modes:
        chain.append(zonda.CommonModeFilter(modes=modes))
    return [*chain, zonda.BinMap(**{"pixel": "2 arcsec", "width": "8 arcmin", **binning})]


def same(a, b):
    return all(
        np.array_equal(getattr(a, n), getattr(b, n), equal_nan=True)
        for n in ("signal", "hits", "weights", "noise")
    )


def test_same_bits_for_every_block_size_and_thread_count(source):
    pipeline = zonda.Pipeline(steps(source, "45 s"))
    one = pipeline.run(scene(), threads=1).products["map"]
    assert one.hits.sum() == 223 * 4500
    for threads, memory in ((2, None), (5, 40_000_000), (1, 12_000_000)):
        assert same(one, pipeline.run(scene(), threads=threads, memory=memory).products["map"])
    assert not same(one, pipeline.run(scene(seed=2)).products["map"])


def test_same_bits_where_nothing_needs_whole_scans(source):
    """Without filters blocks are cut in time as well."""
    pipeline = zonda.Pipeline(steps(source, "60 s", modes=0, highpass=False))
    one = pipeline.run(scene(), threads=1).products["map"]
    assert same(one, pipeline.run(scene(), threads=2, memory=6_000_000).products["map"])


def test_linear_in_the_sky_without_singular_modes(source):
    """signal(sky + rest) - signal(rest) = signal(sky): float32 streams of 0.3 K carry 2e-8 K each,
    30 hits a pixel.
    """
    runs = {"noiseless": {"only": ["sky"]}, "source_free": {"without": ["sky"]}}
    data = zonda.Pipeline(steps(source, modes=0), runs=runs).run(scene())
    whole, sky, rest = (
        data.products[n].signal for n in ("map", "noiseless/map", "source_free/map")
    )
    # e^-tau fluctuates by 4e-4 under the whole sky, not in the noiseless run: 4e-4 of the 70 mK
    # peak
    assert np.nanmax(np.abs(whole - rest - sky)) < 1e-3 * np.nanmax(np.abs(sky))


def test_a_point_source_keeps_place_and_flux(source):
    """Noiseless, no filters: the map is the beam at CRVAL. 5 K x 1 pixel spreads to 5 / (2 pi
    sigma^2) K.
    """
    data = zonda.Pipeline(
        steps(source, "60 s", modes=0, highpass=False), runs={"noiseless": {"only": ["sky"]}}
    ).run(scene())
    product = data.products["noiseless/map"]
    sigma = 8.5 / 2.3548
    peak = 5 / (2 * np.pi * sigma**2)
    signal = np.where(product.hits > 0, product.signal, 0)
    y, x = np.indices(signal.shape)
    centre_x, centre_y = (np.sum(signal * v) / np.sum(signal) for v in (x, y))
    from astropy.wcs import WCS

    ra, dec = WCS(product.header).celestial.pixel_to_world_values(centre_x, centre_y)
    assert abs((ra - 75) * np.cos(np.radians(20)) * 3600) < 0.1
    assert abs(dec - 20) * 3600 < 0.1
    # the centre is the corner of four 2 arcsec pixels: each averages the beam from 0 to 2 arcsec
    # along both axes
    average = (sigma * math.sqrt(math.pi / 2) * math.erf(2 / sigma / math.sqrt(2)) / 2) ** 2
    assert (
        abs(np.nanmax(signal) / (peak * average) - 1) < 0.02
    )  # pixels are not quite evenly filled
    assert abs(np.sum(signal) * 4 / 5 - 1) < 0.01


def test_white_noise_in_the_map_is_what_the_net_says(source):
    """White noise alone: the rms of map x sqrt(hits) is NET sqrt(f_s), chi-square with as many
    degrees as hit pixels.
    """
    chain = [
        s
        for s in steps(source, modes=0, highpass=False)
        if type(s).__name__ in ("PointingDaisy", "WhiteNoise", "Efficiency", "BinMap")
    ]
    product = zonda.Pipeline(chain).run(scene()).products["map"]
    hit = product.hits > 0
    scaled = product.signal[hit] * np.sqrt(product.hits[hit])
    assert abs(scaled.std() / (1.7e-3 * np.sqrt(100)) - 1) < 5 / np.sqrt(2 * hit.sum())


def test_half_difference_holds_no_sky(source):
    """Scans differ in noise, not in sky: the half-difference of a bright source is that of noise
    alone.
    """
    runs = {"source_free": {"without": ["sky"]}}
    data = zonda.Pipeline(
        steps(source, "40 s", scans=2, modes=0, half_difference=True), runs=runs
    ).run(scene())
    bright, free = (
        data.products["map"].half_difference,
        data.products["source_free/map"].half_difference,
    )
    peak = np.nanmax(np.abs(data.products["map"].signal))
    assert (
        np.nanmax(np.abs(bright - free)) < 0.2 * peak
    )  # what is left: different sampling of the steep beam inside a pixel
    assert abs(np.nanstd(bright) / np.nanstd(free) - 1) < 0.2


@pytest.mark.parametrize("duration", ["10 ms", "0.5 s"])
def test_very_short_runs(source, duration):
    """What the filters leave of one sample is nothing: it is flagged and counted, not averaged."""
    data = zonda.Pipeline(steps(source, duration)).run(scene())
    product = data.products["map"]
    assert (
        product.hits.sum() + data.log.get("BinMap", "samples dropped: flagged")
        == data.observations[0].n_samples * 223
    )
    assert (product.hits.sum() > 0) == (duration == "0.5 s")
    assert np.isfinite(product.signal[product.hits > 0]).all()


def test_one_detector_zero_wind_offline(source, monkeypatch):
    import socket

    def refuse(*args, **kwargs):
        raise AssertionError("zonda went to the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    camera = zonda.Instrument(
        name="one",
        telescope=zonda.Telescope(name="dish", diameter="100 m"),
        band="mustang2_90ghz",
        detectors=1,
        field_of_view="0 deg",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1.7 mK s(1/2)",
        knee="0.5 Hz",
        sample_rate="100 Hz",
    )
    chain = steps(source, "5 s")
    chain[2] = zonda.AtmosphereLayers(pwv="7.7 mm", wind={"speed": "0 m/s"})
    product = zonda.Pipeline(chain).run(scene(instrument=camera)).products["map"]
    assert product.hits.sum() == 500
    assert np.isfinite(product.signal[product.hits > 0]).all()
