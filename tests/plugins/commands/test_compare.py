"""`zonda compare`: what it prints, writes and refuses."""

from __future__ import annotations

import os
import re

import healpy
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from zonda.core import cli

SIDE = 48


def compare(*arguments):
    return cli.main(["compare", *map(str, arguments)])


def write(path, values, unit="K", beam=0.0, axes="TAN", centre=75.0, **cards):
    hdu = fits.PrimaryHDU(values)
    ny, nx = values.shape[-2:]
    hdu.header.update(
        {
            "CTYPE1": f"RA---{axes}",
            "CTYPE2": f"DEC--{axes}",
            "CUNIT1": "deg",
            "CUNIT2": "deg",
            "CRVAL1": centre,
            "CRVAL2": 20.0,
            "CRPIX1": (nx + 1) / 2,
            "CRPIX2": (ny + 1) / 2,
            "CDELT1": -2 / 3600,
            "CDELT2": 2 / 3600,
        }
    )
    if unit:
        hdu.header.update({"BUNIT": unit} | ({"TEMPSCAL": "K_RJ"} if unit.endswith("K") else {}))
    if beam:
        hdu.header.update({"BMAJ": beam / 3600, "BMIN": beam / 3600})
    hdu.header.update(cards)
    hdu.writeto(path, overwrite=True)
    return path


@pytest.fixture
def values():
    y, x = (np.indices((SIDE, SIDE)) - 23.5) * 2.0
    return 1e-3 * np.exp(-4 * np.log(2) * (x**2 + y**2) / 30.0**2)


def rows(text):
    """The printed table."""
    pairs = (line.split("  ", 1) for line in text.splitlines() if "  " in line)
    return {name.strip(): value.strip() for name, value in pairs}


def test_two_files(tmp_path, values, capsys):
    a = write(tmp_path / "a.fits", values)
    b = write(tmp_path / "b.fits", 900 * values + 0.02, unit="mK", axes="SIN")
    assert compare(a, b, "--output", tmp_path / "out", "--format", "png", "--format", "svg") == 0
    found = rows(capsys.readouterr().out)
    assert float(found["gain: map = gain x reference + offset"].split()[0]) == pytest.approx(
        0.9, abs=1e-4
    )
    assert found["offset"].startswith("20 ")
    assert found["offset"].endswith("uK_RJ")
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert {
        "comparison.fits",
        "comparison_spectra.ecsv",
        "comparison_profiles.ecsv",
        "comparison.png",
        "comparison.svg",
    } <= names
    assert not list((tmp_path / "out").glob("*.pdf"))


def test_units_are_converted_at_a_frequency(tmp_path, values, capsys):
    a = write(tmp_path / "a.fits", values)
    factor = 2 * 1.380649e-23 * (93e9 / 299792458) ** 2 * 1e20  # MJy/sr per K_RJ
    b = write(tmp_path / "b.fits", values * factor, unit="MJy/sr")
    assert compare(a, b, "--output", tmp_path) == 2
    error = capsys.readouterr().err
    assert "units differ" in error
    assert "--frequency" in error
    assert compare(a, b, "--output", tmp_path, "--frequency", "93 GHz") == 0
    assert rows(capsys.readouterr().out)["gain: map = gain x reference + offset"].split()[0] == "1"
    assert compare(a, b, "--output", tmp_path, "--frequency", "93 GHz", "--unit", "kJy/sr") == 0
    assert rows(capsys.readouterr().out)["peak of the reference"].endswith("kJy/sr")


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        (
            {"RESTFRQ": 93e9, "BAND": "f093"},
            {"RESTFRQ": 150e9, "BAND": "f150"},
            "a.fits of f093 93 GHz and b.fits of f150",
        ),
        (
            {"RESTFREQ": 93e9},
            {"RESTFRQ": 150e9, "BAND": "f150"},
            "a.fits of 93 GHz and b.fits of f150 150 GHz:",
        ),
        (
            {"BAND": "f093"},
            {"RESTFRQ": 150e9, "BAND": "f150"},
            "a.fits of f093 and b.fits of f150 150 GHz:",
        ),
        ({"RESTFRQ": 93e9, "BAND": "f090"}, {"RESTFRQ": 93.00001e9, "BAND": "f093"}, ""),
        ({"RESTFRQ": 93e9}, {"BAND": "f150"}, ""),
        ({}, {}, ""),
    ],
)
def test_maps_of_different_bands(tmp_path, values, capsys, first, second, words):
    a, b = write(tmp_path / "a.fits", values, **first), write(tmp_path / "b.fits", values, **second)
    assert compare(a, b, "--output", tmp_path / "out") == 0
    said = capsys.readouterr().err
    assert (
        (f"warning: the maps are of different bands, {words}" in said)
        if words
        else "different bands" not in said
    )


def test_a_sky_gets_the_beam(tmp_path, values, capsys):
    y, x = (np.indices((SIDE, SIDE)) - 23.5) * 2.0
    wide = np.hypot(30.0, 12.0)
    smooth = 1e-3 * (30.0 / wide) ** 2 * np.exp(-4 * np.log(2) * (x**2 + y**2) / wide**2)
    a, b = write(tmp_path / "a.fits", values), write(tmp_path / "b.fits", smooth, beam=12.0)
    assert compare(a, b, "--output", tmp_path / "o", "--sky") == 0
    assert float(rows(capsys.readouterr().out)["map / reference at that pixel"]) == pytest.approx(
        1.0, abs=2e-3
    )
    assert compare(a, b, "--output", tmp_path / "o") == 0
    text = capsys.readouterr().out
    assert "a.fits: its beam is not known" in text
    assert float(rows(text)["map / reference at that pixel"]) == pytest.approx(
        (30.0 / wide) ** 2, abs=2e-3
    )


def test_two_runs(tmp_path, values, capsys):
    for run, gain in (("one", 1.0), ("two", 0.5)):
        (tmp_path / run).mkdir()
        write(tmp_path / run / "map.fits", gain * values)
        write(tmp_path / run / "noiseless_map.fits", gain * values)
    assert compare(tmp_path / "one", tmp_path / "two", "--output", tmp_path / "out") == 0
    text = capsys.readouterr().out
    assert text.count("correlation") == 2
    assert "one/map.fits" in text
    assert (tmp_path / "out" / "noiseless_map" / "comparison.fits").is_file()


def test_healpix(tmp_path, values, capsys):
    """A HEALPix map of a smooth source against the image of it: the nearest pixel of 6.4 arcsec is
    what is compared.
    """
    a = write(tmp_path / "a.fits", values)
    nside = 32768
    world = WCS(fits.getheader(a))
    pixels = healpy.query_disc(
        nside, healpy.ang2vec(75.0, 20.0, lonlat=True), np.radians(60 / 3600)
    )
    x, y = world.wcs_world2pix(*healpy.pix2ang(nside, pixels, lonlat=True), 0)
    signal = 1e-3 * np.exp(-4 * np.log(2) * ((x - 23.5) ** 2 + (y - 23.5) ** 2) * 4 / 60.0**2)
    wide = write(
        tmp_path / "b.fits",
        1e-3
        * np.exp(-4 * np.log(2) * ((np.indices((SIDE, SIDE)) - 23.5) ** 2).sum(0) * 4 / 60.0**2),
    )
    columns = [
        fits.Column("PIXEL", "K", array=pixels),
        fits.Column("SIGNAL", "D", unit="K", array=signal),
    ]
    table = fits.BinTableHDU.from_columns(columns)
    table.header.update(
        {
            "PIXTYPE": "HEALPIX",
            "NSIDE": nside,
            "ORDERING": "RING",
            "COORDSYS": "C",
            "TEMPSCAL": "K_RJ",
        }
    )
    table.writeto(tmp_path / "h.fits")
    assert compare(wide, tmp_path / "h.fits", "--output", tmp_path) == 0
    found = rows(capsys.readouterr().out)
    # the nearest pixel is 2.4 arcsec (rms) away from a point, where a source of 60 arcsec changes
    # by up to 2.4 % of its peak per arcsec: an rms of at most 6 % of the peak, beside a scatter of
    # 20 % of it
    assert float(found["gain: map = gain x reference + offset"].split()[0]) == pytest.approx(
        1.0, abs=0.05
    )
    assert float(found["correlation"]) > 0.97


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p, v: write(p, v, centre=80.0), "no pixel in common"),
        (lambda p, v: write(p, np.full_like(v, np.nan)), "no pixel has a value"),
        (lambda p, v: write(p, v, unit=""), "has no unit"),
        (lambda p, v: write(p, v, unit="furlong"), "unknown unit 'furlong'"),
        (lambda p, v: write(p, np.stack([v, v])), "cube of 48 x 48 x 2"),
        (lambda p, v: write(p, v, beam=20.0), "smaller than the map's"),
        (lambda p, v: fits.PrimaryHDU(v).writeto(p), "no celestial coordinates"),
        (lambda p, v: fits.PrimaryHDU().writeto(p), "is not a map"),
        (lambda p, v: p.write_text("text"), "cannot be read as FITS"),
        (lambda p, v: None, "no such file"),
    ],
)
def test_refusals(tmp_path, values, capsys, make, words):
    a, b = write(tmp_path / "a.fits", values), tmp_path / "b.fits"
    make(b, values)
    assert compare(a, b, "--output", tmp_path / "out", "--beam", "15 arcsec") == 2
    error = capsys.readouterr().err
    assert words in error
    assert "  = " in error  # what to do about it
    assert "Traceback" not in error
    assert not (tmp_path / "out").exists()


def test_a_missing_file(tmp_path, values, capsys):
    a = write(tmp_path / "map_f090.fits", values)
    wanted = {
        tmp_path / "map_f09.fits": "did you mean 'map_f090.fits'?",
        tmp_path / "none" / "map.fits": f"check the path: there is no folder {tmp_path / 'none'}",
        tmp_path
        / "other.fits": "check the path; if it was there before, it has been moved or removed",
    }
    for path, cure in wanted.items():
        assert compare(path, a) == 2
        assert f"{path}: there is no such file\n  = {cure}\n" in capsys.readouterr().err


def test_folders_without_common_maps(tmp_path, capsys):
    for run in ("one", "two"):
        (tmp_path / run).mkdir()
    assert compare(tmp_path / "one", tmp_path / "two") == 2
    assert "no map has the same name in both" in capsys.readouterr().err


def test_bad_options(tmp_path, values, capsys):
    a = write(tmp_path / "a.fits", values)
    assert compare(a, a, "--contours", "a,b") == 2
    assert "not a list of numbers" in capsys.readouterr().err
    assert compare(a, a, "--beam", "5 km") == 2
    assert "--beam" in capsys.readouterr().err


def test_a_plane_of_a_cube(tmp_path, values, capsys):
    """Planes of frequency have to be chosen; one that is chosen once is that of the cube, whichever
    file it is.
    """
    cube = write(
        tmp_path / "cube.fits",
        np.stack([3 * values, values, 2 * values]),
        CTYPE3="FREQ",
        CRPIX3=1,
        CRVAL3=9e10,
        CDELT3=1e9,
    )
    a = write(tmp_path / "a.fits", values)
    assert compare(a, cube, "--output", tmp_path / "o") == 2
    error = capsys.readouterr().err
    assert "is a cube of 48 x 48 x 3 pixels, not a map" in error
    assert "1 to 3 along FREQ" in error
    assert "--plane 1 of zonda compare" in error
    for given, gain in ((["2"], 1.0), (["3"], 2.0)):
        arguments = [x for n in given for x in ("--plane", n)]
        assert compare(a, cube, "--output", tmp_path / "o", *arguments) == 0
        text = capsys.readouterr().out
        assert float(
            rows(text)["gain: map = gain x reference + offset"].split()[0]
        ) == pytest.approx(gain, abs=1e-6)
        assert f"cube.fits: plane: {given[0]} of 3 along FREQ" in text
    assert compare(cube, cube, "--output", tmp_path / "o", "--plane", "1", "--plane", "2") == 0
    assert float(
        rows(capsys.readouterr().out)["gain: map = gain x reference + offset"].split()[0]
    ) == pytest.approx(1 / 3, abs=1e-4)
    for wrong, words in (
        ("4", "there is no plane 4 of 3"),
        ("1,2", "plane has 2 numbers"),
        ("x", "'x' is not a number"),
    ):
        assert compare(a, cube, "--output", tmp_path / "o", "--plane", wrong) == 2
        assert words in capsys.readouterr().err
    for flag, what in (("plane", "a cube"), ("column", "a HEALPix"), ("coordsys", "a HEALPix")):
        assert compare(a, a, "--output", tmp_path / "o", f"--{flag}", "1") == 2
        assert f"--{flag}: neither of the maps is {what}" in capsys.readouterr().err
    bad = write(tmp_path / "bad.fits", values, unit="furlong")
    assert compare(cube, bad, "--output", tmp_path / "o", "--plane", "1") == 2
    assert "unknown unit 'furlong'" in capsys.readouterr().err  # not that it is no cube


def test_an_extension_and_a_coordinate_system(tmp_path, values, capsys):
    a = write(tmp_path / "a.fits", values)
    header = fits.getheader(a)
    hdus = [fits.PrimaryHDU(values, header), fits.ImageHDU(0.5 * values, header, name="OTHER")]
    fits.HDUList(hdus).writeto(tmp_path / "two.fits")
    for hdu, gain in (("0", 1.0), ("other", 0.5), ("1", 0.5)):
        assert (
            compare(
                a, tmp_path / "two.fits", "--output", tmp_path / "o", "--hdu", "0", "--hdu", hdu
            )
            == 0
        )
        assert float(
            rows(capsys.readouterr().out)["gain: map = gain x reference + offset"].split()[0]
        ) == pytest.approx(gain)
    assert (
        compare(a, tmp_path / "two.fits", "--output", tmp_path / "o", "--hdu", "0", "--hdu", "5")
        == 2
    )
    assert (
        "set hdu to one of these: 0 PRIMARY: image of 48 x 48; 1 OTHER" in capsys.readouterr().err
    )
    pixels = healpy.query_disc(
        16384, healpy.ang2vec(75.0, 20.0, lonlat=True), np.radians(40 / 3600)
    )
    columns = [
        fits.Column("PIXEL", "K", array=pixels),
        fits.Column("HITS", "J", array=np.full(pixels.size, 7)),
    ]
    columns += [fits.Column("TEMPERATURE", "D", unit="K", array=np.linspace(1, 2, pixels.size))]
    table = fits.BinTableHDU.from_columns(columns)
    table.header.update(
        {
            "PIXTYPE": "HEALPIX",
            "NSIDE": 16384,
            "ORDERING": "RING",
            "TEMPSCAL": "K_RJ",
            "BAD_DATA": 1.0,
        }
    )
    table.writeto(tmp_path / "h.fits")
    assert compare(tmp_path / "h.fits", tmp_path / "h.fits", "--output", tmp_path / "o") == 2
    assert "--coordsys C, G or E to zonda compare" in capsys.readouterr().err
    assert (
        compare(
            tmp_path / "h.fits", tmp_path / "h.fits", "--output", tmp_path / "o", "--coordsys", "C"
        )
        == 0
    )
    found = rows(capsys.readouterr().out)
    assert found["pixels with both"].startswith(f"{pixels.size - 1} of")  # the first is BAD_DATA
    assert 1 < float(found["rms of the reference"].split()[0]) < 2  # not the hits


def test_jansky_per_pixel_and_per_beam_are_brightness(tmp_path, values, capsys):
    """A point source of 1 Jy: its flux is in both files, whatever their pixels and beams are."""
    y, x = (np.indices((SIDE, SIDE)) - 23.5) * 2.0

    def source(fwhm):
        return np.exp(-4 * np.log(2) * (x**2 + y**2) / fwhm**2)

    area = np.pi / (4 * np.log(2))
    a = write(tmp_path / "a.fits", source(12.0), unit="Jy/beam", beam=12.0)
    b = write(tmp_path / "b.fits", source(20.0), unit="Jy/beam", beam=20.0)
    c = write(tmp_path / "c.fits", source(20.0) * 4 / (area * 20.0**2), unit="Jy/pixel", beam=20.0)
    for one, other in ((a, b), (b, a), (a, c), (c, b)):
        assert compare(one, other, "--output", tmp_path / "o") == 0
        found = rows(capsys.readouterr().out)
        assert float(found["gain: map = gain x reference + offset"].split()[0]) == pytest.approx(
            1.0, abs=2e-3
        )
        if one != c:
            peak, unit = found["peak of the reference"].split()
            assert (float(peak), unit) == (
                pytest.approx(1.0, abs=0.02),
                "Jy/beam",
            )  # of the pixel nearest to the source
    assert compare(a, c, "--output", tmp_path / "o", "--unit", "Jy/pixel") == 2
    assert "Jy/pixel depends on the pixel" in capsys.readouterr().err


@pytest.mark.parametrize("cards", [{"CDELT1": 1e-300}, {"CD1_1": -1e-12, "CD2_1": 0.0}])
def test_pixels_without_width(tmp_path, values, capsys, cards):
    a, b = write(tmp_path / "a.fits", values), write(tmp_path / "b.fits", values, **cards)
    for first, second in ((a, b), (b, a)):
        assert compare(first, second, "--output", tmp_path / "o") == 2
        assert next(iter(cards)) in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("suffix", [".fits", ".csv", ".h5"])
def test_a_pipe_is_not_waited_for(tmp_path, values, capsys, suffix):
    pipe = tmp_path / f"pipe{suffix}"
    os.mkfifo(pipe)
    a = write(tmp_path / "a.fits", values)
    assert compare(pipe, a, "--output", tmp_path / "o") == 2
    assert str(pipe) in capsys.readouterr().err


def test_fluxes_in_apertures_of_two_files(tmp_path, capsys):
    """A Gaussian and 0.6 of it, in two units."""
    y, x = np.indices((61, 61)) - 30
    wide = {"CDELT1": -4 / 3600, "CDELT2": 4 / 3600}
    shape = np.exp(-4 * np.log(2) * (x**2 + y**2) * (4 / 30) ** 2)
    write(tmp_path / "a.fits", shape, "MJy/sr", BMAJ=9 / 3600, RESTFRQ=93e9, **wide)
    write(tmp_path / "b.fits", 0.6e9 * shape, "mJy/sr", BMAJ=9 / 3600, RESTFRQ=93e9, **wide)
    given = ["--aperture", "30 arcsec", "--aperture", "5 arcmin", "--output", tmp_path / "out"]
    assert compare(tmp_path / "a.fits", tmp_path / "b.fits", *given) == 0
    row, far = (x for x in capsys.readouterr().out.splitlines() if "flux of map" in x)
    numbers = [float(n) for n in re.findall(r"\d\.\d+(?:e-\d+)?", row)]
    flux = 1e6 * np.pi / (4 * np.log(2)) * (30 * np.pi / 648000) ** 2 * (1 - 2**-4)
    assert numbers == pytest.approx([0.6, 0.6 * flux, flux], rel=0.01)
    assert "less than 95 %" in far


def test_the_columns_and_the_unit_of_healpix_files_are_chosen(tmp_path, capsys):
    values = np.arange(12.0 * 16**2)
    columns = [("A", values, "K"), ("B", 3 * values, "K"), ("C", values, "furlong")]
    table = fits.BinTableHDU.from_columns(
        [fits.Column(name, "D", unit=unit, array=v) for name, v, unit in columns]
    )
    cards = {"PIXTYPE": "HEALPIX", "NSIDE": 16, "ORDERING": "RING", "COORDSYS": "C"}
    table.header.update(cards | {"TEMPSCAL": "K_RJ"})
    path = tmp_path / "h.fits"
    table.writeto(path)
    more = path, "--output", tmp_path / "o"
    assert compare(path, *more) == 2
    assert "--column of zonda compare" in capsys.readouterr().err
    assert compare(path, *more, "--column", "A", "--column", "2") == 0
    gain = rows(capsys.readouterr().out)["gain: map = gain x reference + offset"]
    assert float(gain.split()[0]) == pytest.approx(3)
    assert compare(path, *more, "--column", "C") == 2
    told = capsys.readouterr().err
    assert "unknown unit 'furlong'" in told
    assert "set TUNIT of the column to" in told
    assert "parameter" not in told
