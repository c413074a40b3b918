"""Maps that were made with a beam: the telescope's comes on top, and that is told."""

import warnings

import healpy
import numpy as np
import pytest
from astropy.io import fits

from zonda.operators.sky.skymap import SkyMap

UNITS = ["K_RJ", "K_CMB", "MJy/sr", "Jy/beam", "Jy/pixel", "y"]


def blob(made, unit="K_RJ", fwhm=120.0, n=121, **more):
    """A source through a beam of ``fwhm`` [arcsec], peak 1, on pixels of 20 arcsec."""
    y, x = np.mgrid[:n, :n] - n // 2
    values = np.exp(-4 * np.log(2) * (x**2 + y**2) * (20 / fwhm) ** 2)
    return values, made.tan_header(
        (n, n), cdelt=(-20.0, 20.0), unit=unit, BMAJ=fwhm / 3600, BMIN=fwhm / 3600, **more
    )


@pytest.mark.parametrize("unit", UNITS)
def test_a_second_beam_is_told_in_every_unit(made, save, unit):
    values, header = blob(made, unit)
    scan = made.observation([np.radians(75)], np.radians(20), fwhm=120.0)
    with pytest.warns(
        UserWarning,
        match=(
            r"beam of 2′ \(BMAJ\).* 2′ once more.*becomes 2\.83′.*keep 0\.5 of the peak.*`beam:"
            r" none`"
        ),
    ):
        seen = made.look(SkyMap(file=save(values, header)), scan)[0, 0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        as_it_is = made.look(SkyMap(file=save(values, header), beam="none"), scan)[0, 0]
    assert seen / as_it_is == pytest.approx(0.5, abs=2e-3)
    assert any(what == "resolution" and "2.83′ in all" in text for _, what, text in scan.log)


def test_the_cure_for_a_wider_telescope_makes_its_beam(made, save):
    values, header = blob(made, fwhm=60.0)
    scan = made.observation([np.radians(75)], np.radians(20), fwhm=120.0)
    with pytest.warns(UserWarning, match=r"`fwhm: 103\.9 arcsec` makes 2′ in all"):
        made.look(SkyMap(file=save(values, header)), scan)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        seen = made.look(SkyMap(file=save(values, header), fwhm="103.9 arcsec"), scan)[0, 0]
    assert seen == pytest.approx(0.25, rel=5e-3)  # the peak of the source in the beam of 2 arcmin


def test_a_beam_far_narrower_than_the_telescope_s_is_stated_alone(made, save):
    values, header = blob(made, fwhm=60.0)
    scan = made.observation([np.radians(75)], np.radians(20), fwhm=900.0)  # peaks fall by 0.4 %
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made.look(SkyMap(file=save(values, header)), scan)
    assert any(what == "resolution" for _, what, _ in scan.log)


def test_healpix_and_arrays(made, tmp_path):
    healpy.write_map(
        tmp_path / "m.fits",
        np.ones(12 * 64**2),
        coord="C",
        column_units="K_RJ",
        extra_header=[("BMAJ", 2.0)],
    )
    scan = made.observation([np.radians(75)], np.radians(20), fwhm=7200.0)
    with pytest.warns(UserWarning, match="BMAJ"):
        made.look(SkyMap(file=tmp_path / "m.fits"), scan)
    values, header = blob(made)
    with pytest.warns(UserWarning, match="BMAJ"):
        made.look(
            SkyMap(map=fits.ImageHDU(values, header)),
            made.observation([np.radians(75)], np.radians(20), fwhm=120.0),
        )


def test_a_beam_that_is_given_counts_in_place_of_the_header_s(made, save):
    values, header = blob(made, "Jy/beam", fwhm=10.0)
    scan = made.observation([np.radians(75)], np.radians(20), fwhm=120.0)
    with pytest.warns(UserWarning, match=r"beam of 2′ \(BMAJ\)"):
        made.look(SkyMap(file=save(values, header), input_beam="2 arcmin"), scan)
