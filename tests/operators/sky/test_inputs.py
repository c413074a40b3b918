"""What files of other programs lack or have more of, and the parameters that mend it."""

import warnings

import healpy
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from zonda.core.errors import InputError
from zonda.core.maps.map_reading import STOKES
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.operators.sky.read import read_map
from zonda.operators.sky.skymap import SkyMap

ARCSEC = np.pi / 648000


def refused(path, *words, **options):
    with pytest.raises(InputError) as caught:
        read_map(path, **options)
    for word in (str(path), *words):
        assert word in str(caught.value), str(caught.value)
    return str(caught.value)


# --------------------------------------------------------------------------------------------------
# Jy/beam


def test_jansky_per_beam_without_its_beam(made, save):
    path = save(np.full((40, 40), 2.0), made.tan_header((40, 40), unit="Jy/beam"))
    refused(path, "BMAJ", "input_beam: 18 arcsec", "not fwhm")
    omega = np.pi / (4 * np.log(2)) * (18 * ARCSEC) ** 2
    assert read_map(path, input_beam=18 * ARCSEC).beam_solid_angle == pytest.approx(omega)
    scan = made.observation([np.radians(75.0)], np.radians(20.0))
    got = made.look(SkyMap(file=path, input_beam="18 arcsec"), scan)[0, 0]
    assert got == pytest.approx(
        2 * to_kelvin_rj("Jy/beam", made.BAND, beam_solid_angle=omega), rel=1e-3
    )  # 40" of map, 9" of beam


def test_input_beam_replaces_the_headers_and_serves_no_other_unit(made, save):
    path = save(np.zeros((4, 4)), made.tan_header((4, 4), unit="Jy/beam", BMAJ=10 / 3600))
    assert "overridden" in read_map(path, input_beam=18 * ARCSEC).notes["input beam"]
    refused(
        save(np.zeros((4, 4)), made.tan_header((4, 4)), "k.fits"),
        "input_beam is for maps in Jy/beam",
        input_beam=1e-5,
    )


def test_healpix_in_jansky_per_beam(tmp_path):
    path = tmp_path / "h.fits"
    healpy.write_map(path, np.ones(192), coord="C", column_units="Jy/beam", dtype=np.float64)
    refused(path, "BMAJ", "input_beam")
    assert read_map(path, input_beam=1e-3).beam_solid_angle == pytest.approx(
        np.pi / (4 * np.log(2)) * 1e-6
    )


def test_counts_that_are_called_jansky_are_doubted(made, save):
    scan = made.observation([np.radians(75.0)], np.radians(20.0))
    counts = save(np.full((40, 40), 1500.0), made.tan_header((40, 40), unit="Jy/pixel"))
    with pytest.warns(UserWarning, match=r"map.fits: .* K_RJ per Jy/pixel.* counts") as told:
        SkyMap(file=counts).prepare(scan)
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        SkyMap(file=save(np.full((40, 40), 1500.0), made.tan_header((40, 40)), "k.fits")).prepare(
            scan
        )


# --------------------------------------------------------------------------------------------------
# HEALPix


def healpix(path, values, **cards):
    """A map as WMAP writes it: no COORDSYS, no TUNIT."""
    healpy.write_map(
        path, values, dtype=np.float64, overwrite=True, extra_header=list(cards.items())
    )
    return path


@pytest.mark.parametrize(("given", "letter"), [("icrs", "C"), ("galactic", "G"), ("ecliptic", "E")])
def test_coordinates_of_healpix_as_given(tmp_path, given, letter):
    bare = healpix(tmp_path / "bare.fits", np.arange(192.0))
    refused(bare, "coordinate system", "missing", "COORDSYS", "coordsys", unit="mK_CMB")
    healpy.write_map(tmp_path / "h.fits", np.arange(192.0), coord=letter, dtype=np.float64)
    known = read_map(tmp_path / "h.fits", unit="mK_CMB")
    assert read_map(bare, unit="mK_CMB", coordsys=given).frame == known.frame
    other = read_map(tmp_path / "h.fits", unit="mK_CMB", coordsys="galactic")
    assert other.frame == "galactic"
    assert ("coordinates" in other.notes) == (letter != "G")


def test_healpix_of_unknown_coordinates_or_many_resolutions(tmp_path):
    refused(
        healpix(tmp_path / "x.fits", np.zeros(192), COORDSYS="unknown"),
        "UNKNOWN",
        "coordsys",
        unit="K_RJ",
    )
    with fits.open(healpix(tmp_path / "n.fits", np.zeros(192), COORDSYS="G")) as hdus:
        hdus[1].header["ORDERING"] = "NUNIQ"
        hdus.writeto(tmp_path / "u.fits")
    refused(tmp_path / "u.fits", "multi-order", "flatten", unit="K_RJ")


@pytest.mark.parametrize("option", [{"plane": (1,)}, {"centred": True}, {"pixel_size": 1e-3}])
def test_what_does_not_apply_to_healpix(tmp_path, option):
    refused(
        healpix(tmp_path / "x.fits", np.zeros(192), COORDSYS="G"),
        "does not apply to a HEALPix map",
        unit="K_RJ",
        **option,
    )


# --------------------------------------------------------------------------------------------------
# cubes


def cube(made, save, lengths, *ctypes, name="cube.fits"):
    """An image of 6 x 5 pixels and further axes; plane k (in FITS's order) is all k."""
    n = int(np.prod(lengths))
    values = np.broadcast_to(
        np.arange(n, dtype=float).reshape(*lengths[::-1], 1, 1), (*lengths[::-1], 5, 6)
    )
    header = made.tan_header((5, 6))
    for k, ctype in enumerate(ctypes, 3):
        header[f"CTYPE{k}"], header[f"CRVAL{k}"], header[f"CDELT{k}"], header[f"CRPIX{k}"] = (
            ctype,
            1.0,
            1.0,
            1.0,
        )
    return save(values, header, name)


def test_a_plane_of_a_cube(made, save):
    path = cube(made, save, (3,), "FREQ")
    refused(path, "6 x 5 x 3", "plane: 1", "1 to 3 along FREQ")
    found = read_map(path, plane=(3,))
    np.testing.assert_array_equal(found.values, np.full((5, 6), 2.0))
    assert found.notes["plane"] == "3 of 3 along FREQ, at 3"
    refused(path, "no plane 4 of 3 along FREQ", "counted from 1", plane=(4,))
    refused(path, "no plane 0", plane=(0,))
    refused(path, "plane has 2 numbers", plane=(1, 1))
    np.testing.assert_array_equal(SkyMap(file=path, plane=3).read_input().values, found.values)


def test_planes_along_two_axes_and_stokes(made, save):
    two = cube(made, save, (3, 4), "FREQ", "TIME")
    refused(two, "plane: [1, 1]", "1 to 3 along FREQ", "1 to 4 along TIME")
    assert read_map(two, plane=(2, 3)).values[0, 0] == 1 + 3 * 2
    polarized = cube(made, save, (3, 4), "FREQ", "STOKES", name="s.fits")
    refused(polarized, "plane: 1 ", "FREQ")
    intensity = read_map(polarized, plane=(2,))
    assert intensity.values[0, 0] == 1
    assert intensity.notes[STOKES].startswith("plane 1 of 4 is read, I; ")
    assert (
        read_map(polarized, plane=(2, 3)).notes[STOKES].startswith("plane 3 of 4 is read, U as I; ")
    )


def test_a_plane_of_a_flat_image(made, save):
    assert read_map(cube(made, save, (1,), "FREQ"), plane=(1,)).values.shape == (5, 6)
    refused(save(np.zeros((5, 6)), made.tan_header((5, 6))), "plane", "remove plane", plane=(1,))


def test_a_cube_that_begins_with_its_spectra(made, save):
    header = made.tan_header((5, 6))
    for key in ("CTYPE", "CRVAL", "CDELT", "CRPIX", "CUNIT"):
        header[f"{key}3"], header[f"{key}1"] = (
            header[f"{key}1"],
            {"CTYPE": "FREQ", "CUNIT": "Hz"}.get(key, 1.0),
        )
    refused(
        save(np.zeros((4, 5, 6)), header),
        "not the first two",
        "3 (RA---TAN)",
        "transpose",
        plane=(1,),
    )


# --------------------------------------------------------------------------------------------------
# extensions


def test_extensions_by_number_and_name(made, tmp_path):
    header = made.tan_header((5, 6))
    images = [
        fits.ImageHDU(np.full((5, 6), float(k)), header, name=name)
        for k, name in enumerate(["SCI", "ERR"], 1)
    ]
    table = fits.BinTableHDU.from_columns([fits.Column("a", "E", array=np.zeros(3))], name="CAT")
    path = tmp_path / "many.fits"
    fits.HDUList(
        [fits.PrimaryHDU(), *images, table, fits.ImageHDU(np.zeros(9), name="SPEC")]
    ).writeto(path)
    first = read_map(path)
    assert first.values[0, 0] == 1
    assert "2 ERR: image of 6 x 5" in first.notes["extension"]
    for hdu in (2, "ERR", "err", "2"):
        assert read_map(path, hdu=hdu).values[0, 0] == 2
    refused(path, "no extension 7", "1 SCI: image of 6 x 5", "3 CAT: table of 3 rows", hdu=7)
    refused(path, "extension CAT is neither", hdu="CAT")
    refused(path, "extension 0 is neither", "0 PRIMARY: empty", hdu=0)
    refused(path, "extension SPEC is neither", hdu="SPEC")
    assert SkyMap(file=path, hdu="ERR").read_input().values[0, 0] == 2


def test_a_spectrum_before_the_image_is_passed_over(made, tmp_path):
    image = fits.ImageHDU(np.ones((5, 6)), made.tan_header((5, 6)))
    fits.HDUList([fits.PrimaryHDU(np.zeros(7)), image]).writeto(tmp_path / "x.fits")
    assert read_map(tmp_path / "x.fits").values.shape == (5, 6)


# --------------------------------------------------------------------------------------------------
# projections

PARAMETERS = {
    "AZP": {"PV2_1": 2.0},
    "SZP": {"PV2_1": 2.0, "PV2_2": 180.0, "PV2_3": 60.0},
    "ZPN": {"PV2_1": 1.0, "PV2_3": -0.05},
    "CYP": {"PV2_1": 1.0, "PV2_2": 0.8},
    "COP": {"PV2_1": 45.0},
    "COE": {"PV2_1": 45.0},
    "COD": {"PV2_1": 45.0},
    "COO": {"PV2_1": 45.0},
    "BON": {"PV2_1": 45.0},
}
CODES = [
    "AZP",
    "SZP",
    "STG",
    "SIN",
    "ARC",
    "ZPN",
    "ZEA",
    "AIR",
    "CYP",
    "CEA",
    "CAR",
    "MER",
    "SFL",
    "PAR",
    "MOL",
    "AIT",
    "COP",
    "COE",
    "COD",
    "COO",
    "BON",
    "PCO",
    "TSC",
    "CSC",
    "QSC",
    "HPX",
    "XPH",
]


@pytest.mark.parametrize("axes", ["RA", "GLON"])
@pytest.mark.parametrize("code", CODES)
def test_centre_moves_every_projection(made, save, code, axes):
    """A smooth blob beside the map's centre is found at the same distance and position angle (of
    ICRS) from the target: by astropy's spherical trigonometry, of which the operator knows
    nothing."""
    shape, blob, width = (61, 51), (38, 21), np.radians(0.4)  # 4 pixels of 0.1 deg
    header = made.tan_header(shape, ra=40.0, dec=30.0, crpix=(20.3, 33.2), cdelt=(-360.0, 360.0))
    names = ("RA--", "DEC-") if axes == "RA" else ("GLON", "GLAT")
    header["CTYPE1"], header["CTYPE2"] = f"{names[0]}-{code}", f"{names[1]}-{code}"
    if axes == "GLON":
        del header["RADESYS"]
    header.update(PARAMETERS.get(code, {}))
    wcs = WCS(header)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    where = SkyCoord(
        *wcs.wcs_pix2world(columns, rows, 0),
        unit="deg",
        frame="icrs" if axes == "RA" else "galactic",
    ).icrs
    source = where[blob]
    path = save(np.exp(-4 * np.log(2) * (where.separation(source).rad / width) ** 2), header)
    middle, target = where[shape[0] // 2, shape[1] // 2], SkyCoord(260.0, -10.0, unit="deg")
    there = target.directional_offset_by(middle.position_angle(source), middle.separation(source))
    around = there.directional_offset_by(np.linspace(0, 330, 12) * u.deg, 0.15 * u.deg)
    ra, dec = np.append(around.ra.rad, there.ra.rad), np.append(around.dec.rad, there.dec.rad)
    scan = made.observation(ra, dec, centre=(target.ra.rad, target.dec.rad), fwhm=60.0)
    got = made.look(SkyMap(file=path, centre="target", beam="none"), scan)[0]
    # splines on 4 pixels per FWHM: 0.3 % of the peak, twice (the map's pixels and the grid's); XPH
    # has creases
    np.testing.assert_allclose(
        got,
        [*[np.exp(-4 * np.log(2) * (np.radians(0.15) / width) ** 2)] * 12, 1.0],
        atol=2e-2 if code == "XPH" else 6e-3,
    )
