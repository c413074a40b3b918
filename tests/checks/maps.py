"""Maps: empty pixels, spoilt pixels of the input, sizes that make no sense."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from zonda.core.checks import Family, Measured
from zonda.core.data import Data
from zonda.core.numerics.quaternions import from_angles
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.types import Floats
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.sky.skymap import SkyMap
from zonda.plugins.checks.scenes import TARGET, camera, differing, largest, run, scan, sky_file

from .cases import DECADES, PIXELS, SIZES
from .scenes import unrefused

checks = Family("maps")


def _sampled(
    values: Floats, samples: int = 2000, radius: float = 1.0, **options: Any
) -> tuple[Floats, Data]:
    """The stream ``sky`` of a map, 19 detectors on circles of ``radius`` arcmin."""
    with sky_file(values) as path:
        data = run([SkyMap(file=path, **options)], scan(19, samples, radius=radius), keep=("sky",))
    return np.asarray(data.observations[0].detdata["sky"]), data


def _hills(n: int = 801) -> Floats:
    y, x = np.indices((n, n))
    return np.asarray(1e-3 * np.cos(x / 40.0) * np.cos(y / 70.0))


@checks.add(PIXELS, reference="NaN and no hits, exactly there", limit=0, unit="pixels")
def empty_pixels() -> int:
    """pixels without samples that are not NaN, and pixels with samples that are not finite"""
    a = np.random.default_rng(1).standard_normal((7, 3000))
    product = run([BinMap(width="20 arcmin", pixel="5 arcsec")], scan(7, 3000), a).products["map"]
    empty = product.hits == 0
    wrong = int((~np.isnan(product.signal[empty])).sum() + (~np.isnan(product.noise[empty])).sum())
    return wrong + int(
        (~np.isfinite(product.signal[~empty])).sum() + (product.weights[empty] != 0).sum()
    )


@checks.add(PIXELS, reference="the map without these samples", limit=0, unit="pixels")
def nan_in_the_signal() -> Measured:
    """pixels changed elsewhere by NaN and inf in 21 samples, which are dropped and counted"""
    a = np.random.default_rng(2).standard_normal((7, 3000))
    spoilt, o = a.copy(), scan(7, 3000)
    spoilt[2, 300:320], spoilt[3, 50] = np.nan, -np.inf
    data = run([BinMap(pixel="5 arcsec")], o, spoilt)
    whole = run([BinMap(pixel="5 arcsec")], scan(7, 3000), a).products["map"]
    product, counted = data.products["map"], data.log.get("BinMap", "samples dropped: not finite")
    same = whole.hits == product.hits
    wrong = differing(product.signal[same], whole.signal[same]) + abs(
        int((whole.hits - product.hits).sum()) - 21
    )
    return wrong + abs(counted - 21), f"{counted} counted, {int((~same).sum())} pixels lack some"


@checks.add(PIXELS, reference="the same map with 0 there", limit=1e-7)
def nan_in_the_input_map() -> Measured:
    """largest change, over the peak, by 9 NaN and inf pixels taken as zero, and where they are no
    neighbours of a sample
    """
    values = _hills()
    spoilt, zeroed, far = values.copy(), values.copy(), values.copy()
    for y, x, bad in ((400, 400, np.nan), (401, 460, np.inf), (350, 390, -np.inf)):
        spoilt[y, x : x + 2], zeroed[y, x : x + 2] = bad, 0.0
    spoilt[30:33, 40] = zeroed[30:33, 40] = far[30:33, 40] = 0.0
    spoilt[30:33, 40] = np.nan
    found, data = _sampled(spoilt, missing="zero")
    expected, _ = _sampled(zeroed)
    counted = data.log.get(
        "SkyMap", "pixels of the input map that are NaN or infinite, taken as zero"
    )
    corner, clean = _sampled(far)[0], _sampled(values)[0]
    error = largest(float(abs(found - expected).max()), float(abs(corner - clean).max())) / 1e-3
    return error if counted == 9 else np.inf, f"{counted} pixels counted"


@checks.add(PIXELS, reference="an error that names the cure", limit=0, unit="not refused")
def refusals() -> Measured:
    """NaN in the input map where nothing is said about it, a map of 4e12 pixels"""
    values, o = _hills(101), scan(1, 100)
    values[50, 50] = np.nan
    huge = BinMap(pixel="0.01 arcsec", width="5.6 deg")
    return unrefused(
        [
            (lambda: _sampled(values), "missing"),
            (lambda: run([huge], o, np.ones((1, 100))), "too large"),
        ]
    )


@checks.add(PIXELS, reference="the stated value outside", limit=1e-12, unit="K")
def beyond_the_map() -> Measured:
    """error of samples far outside a map of 21 x 21 pixels, and count of all outside, outside:
    3 mK
    """
    found, data = _sampled(np.full((21, 21), 1e-3), outside="3 mK")
    counted = data.log.get("SkyMap", "samples outside the input map")
    o = data.observations[0]
    plane = o.focalplane
    with_reach = np.hypot(plane.xi, plane.eta) < np.radians(
        10 / 3600
    )  # circles of 60 arcsec: 50 from a map of 10
    return float(abs(found[with_reach] - 3e-3).max()), f"{counted} of {found.size} samples counted"


@checks.add(PIXELS, reference="finite, counted", limit=0, unit="samples")
def tiny_maps() -> int:
    """samples not finite, or outside and not counted, of input maps of 1 x 1, 1 x 5 and 2 x 2
    pixels; output of 1 x 1
    """
    wrong = 0
    for shape in ((1, 1), (1, 5), (2, 2)):
        found, data = _sampled(np.full(shape, 1e-3), 500, radius=0.005)
        wrong += int(
            (~np.isfinite(found)).sum()
            + (data.log.get("SkyMap", "samples outside the input map") == 0)
        )
    a = np.ones((7, 3000))
    data = run([BinMap(pixel="10 arcmin", width="10 arcmin")], scan(7, 3000), a)
    product, outside = (
        data.products["map"],
        data.log.get("BinMap", "samples dropped: outside the map"),
    )
    return (
        wrong
        + abs(int(product.hits.sum()) + outside - a.size)
        + int(product.signal.shape != (1, 1))
    )


@checks.add(DECADES, reference="the value itself", limit=1e-10, unit="K")
def fixed_point_sums() -> float:
    """error of a map of 65.500001 K, summed in fixed point"""
    product = run(
        [BinMap(pixel="5 arcsec")], scan(7, 3000), np.full((7, 3000), 65.500001)
    ).products["map"]
    return float(abs(product.signal[product.hits > 0] - 65.500001).max())


@checks.add(PIXELS, reference="a x map 1 + b x map 2", limit=1e-9)
def linearity() -> float:
    """largest departure from linearity of a high-passed map, over its rms"""
    one, two = np.random.default_rng(3).standard_normal((2, 7, 3000))

    def mapped(signal: Floats) -> Floats:
        return np.asarray(
            run([HighpassFilter(), BinMap(pixel="5 arcsec")], scan(7, 3000), signal)
            .products["map"]
            .signal
        )

    a, b, both = mapped(one), mapped(two), mapped(1.7 * one - 0.3 * two)
    hit = ~np.isnan(a)
    return float(abs(both - 1.7 * a + 0.3 * b)[hit].max() / both[hit].std())


SIDE, BEAM = 200.0, 480.0
"""Of the pixels and FWHM, arcsec: 2.4 pixels."""


def _seen_of_one_pixel(path: Path, pixel: Floats, area: float, dec: float) -> float:
    """Largest error of the stream of a map in which one pixel has 1 K, over its peak: every offset
    within 1.5 beams.

    The beam is a Gaussian, so the stream is the pixel's solid angle times the Gaussian at its
    distance.
    """
    beam = camera(1, field="0 deg").model_copy(update={"fwhm": np.radians(BEAM / 3600)})
    observation = scan(1, 2000, radius=0.0, instrument=beam)
    step = np.linspace(0.0, 1.0, 2000)
    reach = 1.5 * np.radians(BEAM / 3600) * np.sqrt(step)
    x, y = reach * np.cos(80 * step), reach * np.sin(80 * step)
    ra, lat = np.radians(TARGET[0]) + x / np.cos(np.radians(dec)), np.radians(dec) + y
    observation.boresight_radec = from_angles(ra, lat)
    observation.centre = (float(np.radians(TARGET[0])), float(np.radians(dec)))
    found = run([SkyMap(file=path)], observation, keep=("sky",)).observations[0].detdata["sky"][0]
    sigma = np.radians(BEAM / 3600) / np.sqrt(8 * np.log(2))
    angle = 2 * np.arcsin(np.linalg.norm(unit_vectors(ra, lat) - pixel, axis=-1) / 2)
    peak = area / (2 * np.pi * sigma**2)
    return largest(*abs(np.asarray(found) / peak - np.exp(-(angle**2) / (2 * sigma**2))))


@checks.add(SIZES, reference="solid angle x Gaussian at the pixel's centre", limit=5e-3)
def one_bright_pixel() -> Measured:
    """error of one pixel's stream over its peak: 2.4 pixels per FWHM and 0.4 as wide, six
    projections, Dec 0, 30, 60, 80
    """
    from astropy.io import fits
    from astropy.wcs import WCS

    worst = {}
    for kind in ("TAN", "CAR", "SIN", "ZEA", "CEA", "MER"):
        for dec in (0.0, 30.0, -60.0, 80.0):
            for wide in (1.0, 0.4):
                cylinder = kind in ("CAR", "CEA", "MER")
                wcs = WCS(naxis=2)
                wcs.wcs.ctype = [f"RA---{kind}", f"DEC--{kind}"]
                rows = (
                    np.cos(np.radians(dec)) if kind == "CEA" else 1.0
                )  # whose rows are 1 / cos as high on the sky
                wcs.wcs.cdelt = [-wide * SIDE / 3600, rows * SIDE / 3600]
                wcs.wcs.crval = [TARGET[0], 0.0 if cylinder else dec]
                wcs.wcs.crpix = [101.0, 31.0]
                if cylinder:
                    wcs.wcs.crpix = [
                        101.0,
                        31.0 - float(wcs.wcs_world2pix(TARGET[0], dec, 0)[1]) + 30.0,
                    ]
                values = np.zeros((61, 201))
                values[30, 100] = 1.0
                corners = np.radians(
                    wcs.wcs_pix2world(
                        [100.25, 99.75, 100.0, 100.0, 100.0], [30.0, 30.0, 30.25, 29.75, 30.0], 0
                    )
                )
                east, west, north, south, pixel = unit_vectors(*corners)
                area = 4 * float(np.linalg.norm(np.cross(east - west, north - south)))
                with TemporaryDirectory(prefix="zonda-check-") as folder:
                    path = Path(folder) / "one.fits"
                    header = wcs.to_header()
                    header["BUNIT"], header["TEMPSCAL"], header["RADESYS"] = "K", "K_RJ", "ICRS"
                    fits.PrimaryHDU(values, header).writeto(path)
                    worst[f"{kind} at {dec:g} deg"] = _seen_of_one_pixel(path, pixel, area, dec)
    where = max(worst, key=lambda name: worst[name])
    return largest(*worst.values()), f"largest: {where}"


@checks.add(SIZES, reference="solid angle x Gaussian at the pixel's centre", limit=5e-3)
def one_bright_healpix_pixel() -> float:
    """error of one HEALPix pixel's stream over its peak, nside 1024 at 2.3 pixels per FWHM, Dec 0,
    41.8, -60, 80
    """
    import healpy

    nside, found = 1024, []
    for dec in (0.3, 41.8, -60.0, 80.0):
        number = healpy.ang2pix(nside, TARGET[0], dec, lonlat=True)
        lon, lat = healpy.pix2ang(nside, number, lonlat=True)
        values = np.full(12 * nside**2, healpy.UNSEEN, np.float32)
        values[healpy.query_disc(nside, healpy.pix2vec(nside, number), np.radians(1.0))] = 0.0
        values[number] = 1.0
        with TemporaryDirectory(prefix="zonda-check-") as folder:
            path = Path(folder) / "one.fits"
            healpy.write_map(
                path, values, coord="C", column_units="K_RJ", partial=True, dtype=values.dtype
            )
            pixel = unit_vectors(*np.radians([lon, lat]))
            found.append(_seen_of_one_pixel(path, pixel, healpy.nside2pixarea(nside), lat))
    return largest(*found)
