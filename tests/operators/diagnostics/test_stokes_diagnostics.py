"""Comparisons and transfer functions of maps of I, Q and U, in a run and by `zonda compare`."""

from pathlib import Path

import healpy
import numpy as np
import pytest
from astropy.io import fits

import zonda
from zonda.core import cli
from zonda.core.numerics.projection import frame_rotation
from zonda.core.polarization import between_meridians, turned_by
from zonda.operators.diagnostics.comparison.files import read_planes

SIDE = 96
PIXEL = 15.0
"""Of the input, arcsec."""


def camera(**changes):
    given = {
        "name": "pairs",
        "telescope": {"name": "dish", "diameter": "6 m"},
        "detectors": 74,
        "field_of_view": "8 arcmin",
        "band": {"name": "b", "low": "130 GHz", "high": "170 GHz"},
        "fwhm": "1.4 arcmin",
        "polarization": "pairs",
        "net": "1 mK s(1/2)",
        "main_beam_efficiency": 0.7,
        "illumination_efficiency": 0.9,
        "sample_rate": "20 Hz",
    }
    return zonda.Instrument(**(given | changes))


def scene(**changes):
    return zonda.Scene(
        site="green_bank",
        instrument=camera(**changes),
        time="2024-11-25T07:00",
        target="75 deg +20 deg",
        seed=3,
    )


def sky():
    """(3, SIDE, SIDE) blobs of other places, widths and signs in I, Q and U, K_RJ."""
    y, x = (np.indices((SIDE, SIDE)) - (SIDE - 1) / 2) * PIXEL
    blobs = ((1e-3, 0, 0, 150), (4e-4, 90, -60, 180), (-3e-4, -120, 60, 210))
    return np.array(
        [a * np.exp(-4 * np.log(2) * ((x - p) ** 2 + (y - q) ** 2) / w**2) for a, p, q, w in blobs]
    )


def source(**more):
    given = {
        "unit": "K_RJ",
        "pixel_size": f"{PIXEL} arcsec",
        "centre": "target",
        "polarization_convention": "cosmo",
    }
    return zonda.SkyMap(map=sky(), **(given | more))


def pipeline(*more, stokes="IQU", noise=(), frame="icrs"):
    steps = [
        zonda.PointingDaisy(radius="6 arcmin", speed="60 arcsec/s", scan_duration="60 s", scans=2),
        source(),
        *noise,
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="0.05 Hz"),
        zonda.BinMap(pixel="30 arcsec", stokes=stokes, frame=frame),
        *more,
    ]
    return zonda.Pipeline(steps, runs={"given": {"only": ["sky"], "filters": "none"}})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("iqu")
    steps = [
        zonda.CompareMaps(map="given/map"),
        zonda.TransferFunction(bins=4),
        zonda.SaveMap(),
        zonda.Plots(),
        zonda.Report(),
    ]
    return pipeline(*steps).run(scene(), output=folder, threads=1), folder


def test_input_of_a_run_has_its_planes(made):
    """To 1e-6: the field's few arcmin turn the meridians of the plane by 1e-3, and back."""
    image = made[0]["input"]
    for which, true in zip("IQU", sky(), strict=True):
        assert image.stokes(which).values == pytest.approx(true, abs=1e-6 * np.abs(true).max())
    with pytest.raises(zonda.ZondaError, match="none of I, Q and U"):
        image.stokes("V")


def test_each_plane_is_compared_with_its_own(made):
    """Without filters the map is the sky in the beam: gain 1 within 2 % (pixels of a third of the
    beam, 37 pairs).
    """
    data, folder = made
    for which in ("", "_Q", "_U"):
        found = data[f"comparison{which}"]
        assert found.names == (f"input{which}", f"given/map{which}")
        assert found.values["gain"] == pytest.approx(1, abs=0.02)
        assert found.values["correlation"] > 0.995
        assert (folder / f"comparison{which}.fits").exists()
        assert (folder / f"comparison{which}.png").exists()
    peak = np.nanmax(np.abs(data["comparison_U"].planes["reference"]))
    assert peak == pytest.approx(np.abs(data["comparison_U"].values["peak reference"]))
    assert data["comparison_U"].values["peak reference"] < 0
    told = {what for who, what, _ in data.log.told() if who == "CompareMaps"}
    assert {"gain of the map", "Q: gain of the map", "U: gain of the map"} <= told


def test_transfer_function_of_each_plane(made):
    """The high-pass filter takes the large scales of each: and no plane's is another's."""
    data, folder = made
    rings = {which: data[f"transfer_function{which}"].rings.transfer for which in ("", "_Q", "_U")}
    for which, transfer in rings.items():
        known = transfer[np.isfinite(transfer)]
        assert known[0] < 0.9
        assert known.max() < 1.2
        assert (folder / f"transfer_function{which}.ecsv").exists()
        assert data[f"transfer_function{which}"].map == f"map{which}"
        of = f"{which[1:]}: " if which else ""
        assert f"{of}rings without modes or power: NaN" in [what for _, what, _ in data.log]
    assert not np.allclose(rings[""], rings["_Q"], equal_nan=True)


def test_pictures_of_the_planes(made):
    names = {path.name for path in made[1].glob("*.png")}
    wanted = {
        f"{stem}{which}.png"
        for stem in ("input", "map", "transfer_function", "comparison")
        for which in ("", "_Q", "_U")
    }
    assert wanted <= names
    page = (made[1] / "report.html").read_text(encoding="utf-8")
    assert "Input (Q)" in page
    assert "Transfer function (U)" in page


def test_a_map_of_i_is_compared_with_i_of_the_reference():
    data = pipeline(zonda.CompareMaps(map="given/map"), stokes="I").run(scene(), threads=1)
    assert "comparison" in data
    assert "comparison_Q" not in data
    assert ("CompareMaps", "Q and U", "not compared: the map has none") in data.log.told()


def test_a_map_in_galactic_axes_is_compared_with_the_input_in_those(tmp_path):
    """At RA 75, Dec 20 deg Galactic meridians lie 47 deg from those of ICRS: without turning, Q
    would be U.
    """
    data = pipeline(zonda.CompareMaps(map="given/map"), frame="galactic").run(scene(), threads=1)
    for which in ("", "_Q", "_U"):
        assert data[f"comparison{which}"].values["gain"] == pytest.approx(1, abs=0.03)
        assert data[f"comparison{which}"].values["correlation"] > 0.99


def cube(path: Path, values, **cards):
    header = fits.Header()
    header.update(
        CTYPE1="RA---TAN",
        CTYPE2="DEC--TAN",
        CRVAL1=75.0,
        CRVAL2=20.0,
        CRPIX1=(SIDE + 1) / 2,
        CRPIX2=(SIDE + 1) / 2,
        CDELT1=-PIXEL / 3600,
        CDELT2=PIXEL / 3600,
        BUNIT="K",
        TEMPSCAL="K_RJ",
        BMAJ=0.01,
        BMIN=0.01,
        CTYPE3="STOKES",
        CRPIX3=1.0,
        CRVAL3=1.0,
        CDELT3=1.0,
        **cards,
    )
    fits.writeto(path, values, header, overwrite=True)
    return path


def test_files_of_i_q_and_u(made, tmp_path, capsys):
    """A cube in IAU's convention against the same in COSMO's; zonda's own file, with the noise of
    each plane.
    """
    iau = sky() * np.array([1, 1, -1])[:, None, None]
    one, other = (
        cube(tmp_path / "a.fits", iau, POLCCONV="IAU"),
        cube(tmp_path / "b.fits", 2 * sky(), POLCCONV="COSMO"),
    )
    assert cli.main(["compare", str(one), str(other), "--output", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert [line for line in text.splitlines() if line.startswith("Stokes")] == [
        "Stokes I",
        "Stokes Q",
        "Stokes U",
    ]
    gains = [
        float(line.split("offset")[1].split()[0])
        for line in text.splitlines()
        if line.startswith("gain")
    ]
    assert gains == pytest.approx([2, 2, 2], abs=1e-3)
    for which in ("", "_Q", "_U"):
        assert (tmp_path / "out" / f"comparison{which}.fits").exists()
    own = read_planes(made[1] / "map.fits")
    product = made[0]["map"]
    for which in "IQU":
        np.testing.assert_allclose(
            own.planes[which].values, product.stokes(which).signal, rtol=1e-6
        )
        np.testing.assert_allclose(own.planes[which].noise, product.stokes(which).noise, rtol=1e-5)


def test_q_and_u_without_a_convention_are_left_out(tmp_path, capsys):
    one, other = (
        cube(tmp_path / "a.fits", sky()),
        cube(tmp_path / "b.fits", sky(), POLCCONV="COSMO"),
    )
    assert cli.main(["compare", str(one), str(other), "--output", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert (
        "Q and U: not compared: a.fits has them and no POLCCONV; set that header key to COSMO"
        " or IAU" in text
    )
    assert not (tmp_path / "out" / "comparison_Q.fits").exists()
    plain = tmp_path / "i.fits"
    fits.writeto(plain, sky()[0], fits.getheader(other), overwrite=True)
    assert cli.main(["compare", str(plain), str(other), "--output", str(tmp_path / "out")]) == 0
    assert "Q and U: not compared: i.fits has none" in capsys.readouterr().out


def test_healpix_files_in_other_frames(tmp_path, capsys):
    """The same uniform sky in Galactic and in equatorial axes: turned, they are alike to the pixels
    of nside 256, 0.2 deg, near whose poles the meridians turn fastest; the field is 60 deg from
    both."""
    nside = 256
    d = np.stack(healpy.pix2vec(nside, np.arange(healpy.nside2npix(nside))), axis=1)
    centre = healpy.ang2vec(75.0, 10.0, lonlat=True)
    pixels = np.flatnonzero(d @ centre > np.cos(np.radians(3)))
    rotation = frame_rotation("galactic")
    galactic = np.flatnonzero(d @ rotation @ centre > np.cos(np.radians(4)))
    q_and_u = np.broadcast_to([[0.3], [0.1]], (2, pixels.size))
    turn = between_meridians(d[galactic] @ rotation, np.array([0.0, 0.0, 1.0]), rotation[2])
    in_galactic = turned_by(np.broadcast_to([[0.3], [0.1]], (2, galactic.size)), turn)
    for name, where, planes, coordinates in (
        ("c", pixels, q_and_u, "C"),
        ("g", galactic, in_galactic, "G"),
    ):
        i = 1 + 0.1 * d[where] @ centre
        columns = [fits.Column("PIXEL", "K", array=where)]
        columns += [
            fits.Column(n, "D", unit="K", array=v) for n, v in zip("IQU", (i, *planes), strict=True)
        ]
        table = fits.BinTableHDU.from_columns(columns)
        table.header.update(
            PIXTYPE="HEALPIX", ORDERING="RING", NSIDE=nside, COORDSYS=coordinates, TEMPSCAL="K_RJ"
        )
        table.writeto(tmp_path / f"{name}.fits")
    assert (
        cli.main(
            [
                "compare",
                str(tmp_path / "g.fits"),
                str(tmp_path / "c.fits"),
                "--output",
                str(tmp_path / "out"),
            ]
        )
        == 0
    )
    for which, true in (("_Q", 0.3), ("_U", 0.1)):
        difference = fits.getdata(tmp_path / "out" / f"comparison{which}.fits", "DIFFERENCE")
        assert np.nanmax(np.abs(difference)) < 0.01 * true + 2e-3
    capsys.readouterr()
