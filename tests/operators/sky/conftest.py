"""A small observation about any point of the sky, made by hand: these tests need no pointing
operator.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from zonda.core.configuration.time import Instant
from zonda.core.data import Block, Data, Observation
from zonda.core.focalplane import Focalplane
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.site import Site

ARCSEC = np.pi / 648000
BAND = Band(name="test", low="78 GHz", high="108 GHz")
INSTRUMENT = Instrument(
    name="test",
    telescope=Telescope(name="dish", diameter="100 m"),
    band=BAND,
    detectors=1,
    field_of_view="0 deg",
    fwhm="9 arcsec",
    main_beam_efficiency=0.3,
    illumination_efficiency=0.8,
    net="0.1 mK s(1/2)",
    sample_rate="100 Hz",
)
SITE = Site(name="test", latitude="38 deg", longitude="-79 deg")


def quaternions(ra, dec, psi=0.0):
    """(n, 4) Rz(ra) Ry(pi/2 - dec) Rz(psi), from the rotation's half angles."""
    ra, dec, psi = np.broadcast_arrays(np.asarray(ra, float), dec, psi)

    def times(a, b):
        (ax, ay, az, aw), (bx, by, bz, bw) = a, b
        return (
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        )

    zero = np.zeros_like(ra)
    about_z = [(zero, zero, np.sin(a / 2), np.cos(a / 2)) for a in (ra, psi)]
    colatitude = np.pi / 2 - dec
    about_y = (zero, np.sin(colatitude / 2), zero, np.cos(colatitude / 2))
    return np.stack(times(times(about_z[0], about_y), about_z[1]), axis=-1).reshape(-1, 4)


def offset(ra0, dec0, east, north):
    """(ra, dec) at tangent-plane offsets (east, north) [tan rad] from (ra0, dec0): the inverse
    gnomonic projection.
    """
    east, north = np.asarray(east, float), np.asarray(north, float)
    e = np.array([-np.sin(ra0), np.cos(ra0), 0.0])
    n = np.array([-np.sin(dec0) * np.cos(ra0), -np.sin(dec0) * np.sin(ra0), np.cos(dec0)])
    c = np.array([np.cos(dec0) * np.cos(ra0), np.cos(dec0) * np.sin(ra0), np.sin(dec0)])
    d = c + east[..., None] * e + north[..., None] * n
    return np.arctan2(d[..., 1], d[..., 0]), np.arctan2(d[..., 2], np.hypot(d[..., 0], d[..., 1]))


def observation(ra, dec, *, xi=(0.0,), eta=(0.0,), psi=0.0, fwhm=9.0, centre=None):
    """A scan through (ra, dec) [rad arrays]; ``fwhm`` in arcsec, one or one per detector."""
    ra, dec = np.broadcast_arrays(np.atleast_1d(np.asarray(ra, float)), dec)
    n = len(xi)
    one = np.ones(n)
    plane = Focalplane(
        names=[f"d{k}" for k in range(n)],
        xi=np.asarray(xi, float),
        eta=np.asarray(eta, float),
        fwhm=fwhm * ARCSEC * one,
        main_beam_efficiency=one,
        illumination_efficiency=one,
        net=one,
    )
    boresight = quaternions(ra, dec, psi)
    return Observation(
        name="scan",
        index=0,
        site=SITE,
        instrument=INSTRUMENT,
        focalplane=plane,
        start=Instant.parse("2024-11-25T07:00:00Z"),
        seconds=np.arange(len(boresight)) / 100.0,
        sample_rate=100.0,
        boresight_azel=boresight,
        boresight_radec=boresight,
        centre=(float(ra[0]), float(dec[0])) if centre is None else centre,
        seed=0,
    )


def look(operator, scan, *, dtype=np.float64, cuts=None, state=None):
    """The sky stream (n_det, n_samp) of a scan; ``cuts`` (detectors, samples): where blocks
    begin.
    """
    detectors, samples = cuts or ([0], [0])
    state = operator.prepare(scan) if state is None else state
    out = np.empty((scan.n_detectors, scan.n_samples), dtype)
    for d0, d1 in zip(detectors, [*detectors[1:], scan.n_detectors], strict=True):
        for s0, s1 in zip(samples, [*samples[1:], scan.n_samples], strict=True):
            block = Block(scan, slice(d0, d1), slice(s0, s1), dtype=dtype)
            operator.exec(block, state)
            out[d0:d1, s0:s1] = block.detdata["sky"]
    operator.collect(Data(scene=None), scan, state)  # type: ignore[arg-type]
    return out


def tan_header(
    shape=(64, 64), *, ra=75.0, dec=20.0, crpix=None, cdelt=(-1.0, 1.0), unit="K_RJ", **more
):
    """Cards of a TAN map; ``cdelt`` in arcsec, ``ra`` and ``dec`` in degrees."""
    cards = fits.Header()
    cards["CTYPE1"], cards["CTYPE2"] = "RA---TAN", "DEC--TAN"
    cards["CRVAL1"], cards["CRVAL2"] = ra, dec
    cards["CRPIX1"], cards["CRPIX2"] = crpix or ((shape[1] + 1) / 2, (shape[0] + 1) / 2)
    cards["CDELT1"], cards["CDELT2"] = cdelt[0] / 3600, cdelt[1] / 3600
    cards["CUNIT1"] = cards["CUNIT2"] = "deg"
    cards["RADESYS"] = "ICRS"
    if unit is not None:
        cards["BUNIT"] = unit
    for key, value in more.items():
        cards[key] = value
    return cards


@pytest.fixture(scope="session")
def made():
    """This module's makers (`observation`, `look`, `tan_header` ...)."""
    return sys.modules[__name__]


@pytest.fixture
def save(tmp_path):
    """save(values, header) -> path of a FITS image."""

    def write(values, header, name="map.fits") -> Path:
        fits.PrimaryHDU(np.asarray(values), header).writeto(tmp_path / name, overwrite=True)
        return tmp_path / name

    return write
