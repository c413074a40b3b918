"""Maps on every kind of grid are compared as what they are on the sky: a point source, a Gaussian
and white noise, on each.

What is shown on one grid is computed from angles on the sky, not from pixels.
"""

from __future__ import annotations

from dataclasses import replace

import healpy
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from zonda.core.errors import InputError
from zonda.core.numerics.sphere import ARCSEC, FWHM_PER_SIGMA, separation, unit_vectors
from zonda.operators.diagnostics.comparison.files import in_unit, read_planes
from zonda.operators.diagnostics.comparison.planes import cell_of
from zonda.operators.diagnostics.comparison.statistics import compare

LON = 75.0
NSIDE = 32768
"""Pixels of 6.4 arcsec."""

GRIDS = {
    "TAN": ("TAN", (4.0, 4.0), 0.0, 20.0),
    "TAN oblong": ("TAN", (8.0, 4.0), 0.0, 20.0),
    "TAN turned": ("TAN", (4.0, 4.0), 30.0, 20.0),
    "TAN oblong and turned": ("TAN", (6.0, 3.0), 30.0, 60.0),
    "SIN oblong": ("SIN", (3.0, 6.0), 0.0, 20.0),
    "ZEA": ("ZEA", (4.0, 4.0), 0.0, -45.0),
    "CAR at 0": ("CAR", (4.0, 4.0), 0.0, 0.0),
    "CAR at 60": ("CAR", (4.0, 4.0), 0.0, 60.0),
    "CAR at 75": ("CAR", (8.0, 4.0), 0.0, 75.0),
    "CEA at 45": ("CEA", (4.0, 4.0), 0.0, 45.0),
    "HEALPix at 60": ("HEALPix", (6.44, 6.44), 0.0, 60.0),
}
"""Projection, steps (x, y) of the header [arcsec], angle [deg] by which the image is turned,
declination.
"""


def world(name, side=300.0):
    """A WCS and shape (ny, nx) of a field of about ``side`` arcsec, whose middle is 0.3, 0.4 pixels
    from a pixel's centre.
    """
    kind, (dx, dy), turn, dec = GRIDS[name]
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = [f"RA---{kind}", f"DEC--{kind}"]
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    wcs.wcs.cd = np.array([[c, -s], [s, c]]) @ np.diag([-dx, dy]) / 3600
    cylinder = kind in ("CAR", "CEA")
    across = dx * (np.cos(np.radians(dec)) if cylinder else 1.0)
    shape = round(side / dy), round(side / across)
    wcs.wcs.crval = [LON, 0.0 if cylinder else dec]
    wcs.wcs.crpix = [shape[1] // 2 + 1.3, shape[0] // 2 + 1.4]
    if cylinder:
        y = wcs.wcs_world2pix(LON, dec, 1)[1]
        wcs.wcs.crpix = [wcs.wcs.crpix[0], 2 * wcs.wcs.crpix[1] - y]
    return wcs, shape


def positions(name):
    """(longitude, latitude) [rad] of all pixels, their solid angles [sr] by finite differences, and
    what `put` needs.
    """
    if GRIDS[name][0] == "HEALPix":
        centre = healpy.ang2vec(LON, GRIDS[name][3], lonlat=True)
        pixels = np.sort(healpy.query_disc(NSIDE, centre, 160 * ARCSEC))
        lon, lat = np.radians(healpy.pix2ang(NSIDE, pixels, lonlat=True))
        return lon, lat, np.full(pixels.size, healpy.nside2pixarea(NSIDE)), pixels
    wcs, (ny, nx) = world(name)
    y, x = np.indices((ny, nx), np.float64)
    at = [
        unit_vectors(*np.radians(wcs.all_pix2world(x + i, y + j, 0)))
        for i, j in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))
    ]
    areas = np.linalg.norm(np.cross(at[0] - at[1], at[2] - at[3]), axis=-1)
    lon, lat = np.radians(wcs.all_pix2world(x, y, 0))
    return lon, lat, areas, wcs


def put(path, name, planes, unit="K", beam=0.0, **cards):
    """A file: an image for each plane, or a HEALPix table."""
    where = positions(name)[3]
    header = (
        {"TEMPSCAL": "K_RJ", "BUNIT": unit, **cards} if unit == "K" else {"BUNIT": unit, **cards}
    )
    header |= {"BMAJ": beam / 3600, "BMIN": beam / 3600} if beam else {}
    if GRIDS[name][0] == "HEALPix":
        columns = [fits.Column("PIXEL", "K", array=where)]
        columns += [fits.Column(key, "D", array=v, unit=unit) for key, v in planes.items()]
        table = fits.BinTableHDU.from_columns(columns)
        table.header.update(
            header | {"PIXTYPE": "HEALPIX", "NSIDE": NSIDE, "ORDERING": "RING", "COORDSYS": "C"}
        )
        table.writeto(path, overwrite=True)
        return path
    hdus = [
        (fits.ImageHDU if k else fits.PrimaryHDU)(v, where.to_header())
        for k, v in enumerate(planes.values())
    ]
    for hdu, key in zip(hdus, planes, strict=True):
        hdu.header.update(header | {"EXTNAME": key})
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


def gaussian(name, fwhm, peak=1.0, offset=(0.0, 0.0)):
    lon, lat, _, _ = positions(name)
    r = separation(lon, lat, (np.radians(LON), np.radians(GRIDS[name][3])))
    return peak * np.exp(-4 * np.log(2) * (r / ARCSEC / fwhm) ** 2)


@pytest.mark.parametrize("name", GRIDS)
def test_a_gaussian_is_smoothed_to_what_it_is_on_the_sky(tmp_path, name):
    """A sky of 24 arcsec (three of the widest pixels) behind a beam of 30, against a map with it:
    gain and peak ratio 1.

    Both are brought to one beam on their own pixels, and to one grid by splines; truth is written
    from angles. A sum over points of a Gaussian of s pixels sigma is its integral to 2 exp(-2 pi^2
    s^2) (s = 1.27: 3e-14); of HEALPix, whose pixels have no rows, to 1 / (pixels under the
    kernel)^(3/2) or so; interpolation of 38 arcsec at 8 is right to (pi / 12)^4 / 4 = 0.1 %.
    """
    wide = np.hypot(24.0, 30.0)
    dec = GRIDS[name][3]
    GRIDS["control"] = ("TAN", (3.0, 3.0), 0.0, dec)
    try:
        a = read_planes(put(tmp_path / "a.fits", name, {"I": gaussian(name, 24.0)}))
        b = read_planes(
            put(
                tmp_path / "b.fits",
                "control",
                {"I": gaussian("control", wide, (24.0 / wide) ** 2)},
                beam=30.0,
            )
        )
    finally:
        del GRIDS["control"]
    sky = replace(a.planes["I"], fwhm=0.0)
    for reference, other in ((sky, b.planes["I"]), (b.planes["I"], sky)):
        found = compare(reference, other, bins=8)
        assert found.values["gain"] == pytest.approx(1.0, abs=4e-3)
        assert found.values["peak ratio"] == pytest.approx(1.0, abs=4e-3)
        assert found.values["rms difference"] < 4e-3 * found.values["rms reference"]
        # a profile in rings of 15 arcsec: the mean of the Gaussian over a ring's solid angle
        edges, p = np.arange(5) * 15.0, found.profiles
        cumulative = 1 - np.exp(-4 * np.log(2) * (edges / wide) ** 2)
        ring = (
            (24.0 / wide) ** 2
            * np.diff(cumulative)
            * np.pi
            * wide**2
            / (4 * np.log(2))
            / (np.pi * np.diff(edges**2))
        )
        # a ring of n pixels holds them to some sqrt(edge pixels) / n; the outer ones have little
        # brightness
        for key in ("reference", "map"):
            np.testing.assert_allclose(p.mean[key][:4], ring, atol=0.05 * ring[0])
        # two alike to 1 % in amplitude
        s = found.spectra
        use = (s.scale > 60 * ARCSEC) & (s.modes > 1)
        assert use.any()
        np.testing.assert_allclose(s.power["map"][use], s.power["reference"][use], rtol=0.02)


def spectrum_width(found):
    s = found.spectra
    use = (s.scale < 200 * ARCSEC) & (s.scale > 60 * ARCSEC) & np.isfinite(s.power["map"])
    slope = np.polyfit(s.wavenumber[use] ** 2, np.log(s.power["map"][use]), 1)[0]
    return np.sqrt(-slope / (4 * np.pi**2)) * FWHM_PER_SIGMA / ARCSEC


@pytest.mark.parametrize(
    "name",
    ["TAN oblong", "TAN turned", "TAN oblong and turned", "SIN oblong", "CAR at 60", "CAR at 75"],
)
def test_scales_of_spectra_are_those_of_the_sky(tmp_path, name):
    """The width of a Gaussian from the slope of its spectrum is that on square pixels of the same
    field to 1.5 %: rings are a few modes wide, and the window of another grid differs by a
    pixel."""
    dec = GRIDS[name][3]
    a = read_planes(put(tmp_path / "a.fits", name, {"I": gaussian(name, 36.0)})).planes["I"]
    GRIDS["control"] = ("TAN", (4.0, 4.0), GRIDS[name][2], dec)
    try:
        b = read_planes(
            put(tmp_path / "b.fits", "control", {"I": gaussian("control", 36.0)})
        ).planes["I"]
    finally:
        del GRIDS["control"]
    assert spectrum_width(compare(a, a)) == pytest.approx(spectrum_width(compare(b, b)), rel=0.015)


@pytest.mark.parametrize("name", GRIDS)
def test_one_pixel_keeps_its_flux(tmp_path, name):
    """A pixel of 1 Jy, behind a beam of 30 arcsec: 1 Jy over the beam's solid angle in MJy/sr,
    whatever the pixel's size is.
    """
    lon, _, areas, _ = positions(name)
    values = np.zeros(lon.shape)
    centre = separation(*positions(name)[:2], (np.radians(LON), np.radians(GRIDS[name][3])))
    one = np.unravel_index(np.argmin(centre), lon.shape)
    values[one] = 1.0
    plane = in_unit(
        read_planes(put(tmp_path / "a.fits", name, {"I": values}, unit="Jy/pixel")).planes["I"],
        "MJy/sr",
        None,
    )
    assert plane.values[one] * areas[one] == pytest.approx(1e-6, rel=1e-4)
    found = replace(plane, fwhm=0.0).smoothed(30 * ARCSEC)
    beam = np.pi / (4 * np.log(2)) * (30 * ARCSEC) ** 2
    # pixels of 8 arcsec sample the kernel of 12.7 arcsec sigma; HEALPix: its harmonics to 3 nside
    assert found.values[one] * beam * 1e6 == pytest.approx(1.0, abs=5e-3)


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("smooth", [False, True])
def test_white_noise_has_a_chi2_of_one(tmp_path, name, smooth):
    """A map with white noise of known standard errors against its truth, of a finer grid or of the
    same pixels.

    The map's pixels are kept or interpolated, as they are or smoothed; chi^2 / pixels is 1 to
    sqrt(2 / independent values), which the figure states; tested at 3.5 of them, on two
    realizations.
    """
    rng = np.random.default_rng(8)
    sky = gaussian(name, 40.0)
    lon, lat = positions(name)[:2]
    noise = 0.08 + 0.03 * np.sin((lon + lat) / (100 * ARCSEC))
    dec = GRIDS[name][3]
    GRIDS["finer"] = ("TAN", (2.5, 2.5), 0.0, dec)
    try:
        truth = read_planes(
            put(tmp_path / "t.fits", "finer", {"I": gaussian("finer", 40.0)}, beam=20.0)
        ).planes["I"]
    finally:
        del GRIDS["finer"]
    same = read_planes(put(tmp_path / "s.fits", name, {"I": sky}, beam=20.0)).planes["I"]
    wide = 25 * ARCSEC if smooth else None
    for reference in (truth, same):
        values = sky + noise * rng.standard_normal(sky.shape)
        seen = read_planes(
            put(tmp_path / "m.fits", name, {"I": values, "NOISE": noise}, beam=20.0)
        ).planes["I"]
        found = compare(reference, seen, wide, bins=8)
        f = found.values
        ratio, error = f["chi2"] / f["chi2 pixels"], np.sqrt(2 / f["chi2 values"])
        assert abs(ratio - 1) < 3.5 * error, (ratio, error)
        assert error < 0.2
        # of the least-squares gain of white noise: the source stands on a few parts of the
        # jackknife alone
        assert abs(f["gain"] - 1) < 4 * 0.08 / np.sqrt((sky**2).sum())
        assert f["chi2 values"] <= f["chi2 pixels"]
        assert "noise of the map: white noise only" in found.notes


@pytest.mark.parametrize("name", ["CAR at 60", "CAR at 75", "TAN oblong", "TAN oblong and turned"])
def test_the_spectrum_of_white_noise_is_its_level(tmp_path, name):
    """P = n^2 A, A the pixel's solid angle; rings of 12 realizations, each known to 1 / sqrt(12
    modes).
    """
    rng = np.random.default_rng(4)
    areas = positions(name)[2]
    drawn = []
    for _ in range(12):
        plane = read_planes(
            put(tmp_path / "m.fits", name, {"I": rng.standard_normal(areas.shape)})
        ).planes["I"]
        drawn.append(compare(plane, plane, bins=6).spectra)
    middle = areas[areas.shape[0] // 2, areas.shape[1] // 2]
    ratio, modes = np.mean([s.power["map"] for s in drawn], axis=0) / middle, drawn[0].modes
    good = modes > 2
    assert np.abs((ratio - 1) * np.sqrt(12 * modes))[good].max() < 4


def test_a_cell_holds_the_steps_on_the_sky(tmp_path):
    for name in ("TAN oblong and turned", "CAR at 60", "SIN oblong"):
        kind, (dx, dy), turn, dec = GRIDS[name]
        plane = read_planes(
            put(tmp_path / "m.fits", name, {"I": np.ones(positions(name)[2].shape)})
        ).planes["I"]
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        steps = np.array([[c, -s], [s, c]]) @ np.diag(
            [-dx * (np.cos(np.radians(dec)) if kind == "CAR" else 1.0), dy]
        )
        np.testing.assert_allclose(cell_of(plane.grid), steps * ARCSEC, atol=0.02 * ARCSEC)


def test_a_beam_in_arcsec_is_refused(tmp_path):
    """BMAJ = 24 deg in a map of arcminutes; `SkyMap` refuses it by the same rule."""
    path = put(tmp_path / "a.fits", "TAN", {"I": gaussian("TAN", 24.0)}, beam=24.0)
    fits.setval(path, "BMAJ", value=24.0)
    fits.setval(path, "BMIN", value=24.0)
    with pytest.raises(InputError, match="beam of the map is 24 deg wide, and the whole map"):
        read_planes(path)
