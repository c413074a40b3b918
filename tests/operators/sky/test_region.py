"""What a scan reaches of a map: only that is worked on, and what it sees there does not change."""

import healpy
import numpy as np
import pytest

from zonda.core.errors import InputError
from zonda.core.plan.planning import planning_of
from zonda.operators.sky import region as regions
from zonda.operators.sky.gridding import interpolated
from zonda.operators.sky.region import TILE, Disc, region, tangent_grid_wcs
from zonda.operators.sky.skymap import SkyMap

ARCMIN = np.pi / 10800
CENTRE = (np.radians(60.0), np.radians(25.0))


def direction(ra, dec):
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def strip(made, length=5.0, n=4000, **more):
    """A scan to and fro along a slanted line of ``length`` deg."""
    along = np.radians(length) / 2 * np.sin(np.linspace(0, 20, n))
    lon, lat = made.offset(*CENTRE, np.tan(along), np.tan(0.5 * along))
    return made.observation(lon, lat, centre=CENTRE, **more)


@pytest.mark.parametrize(
    ("reach", "step", "message"),
    [(68.0, 1e-2, "reaches 68 deg"), (29.0, 1e-6, "pixels of 0.206 arcsec")],
)
def test_grids_too_large(made, reach, step, message):
    lon, lat = made.offset(*CENTRE, np.tan(np.radians([-reach, reach])), 0.0)
    with pytest.raises(InputError, match=message):
        region(made.observation(lon, lat, centre=CENTRE), step, 0.0, None, "here")


def test_every_sample_and_its_beam_is_in_a_tile(made):
    """By the directions of all detectors, in all rotations of the focal plane."""
    xi, eta = np.array([0.0, 30.0, -20.0]) * ARCMIN, np.array([0.0, 10.0, 25.0]) * ARCMIN
    scan = strip(made, 20.0, xi=xi, eta=eta, psi=np.linspace(0, 6, 4000))
    step, reach = 0.5 * ARCMIN, 6 * ARCMIN
    found = region(scan, step, reach, None, "here")
    assert found.tiles is not None
    assert found.tiles.mean() < 0.5
    from zonda.core.numerics.projection import directions, pixel_matrix

    p = (
        directions(scan.boresight_radec, xi, eta).reshape(-1, 3)
        @ pixel_matrix(tangent_grid_wcs(*CENTRE, found.box, step)).T
    )
    x, y = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
    margin = reach / step + regions.MARGIN
    for dx in (-margin, 0, margin):
        for dy in (-margin, 0, margin):
            assert found.tiles[((y + dy) // TILE).astype(int), ((x + dx) // TILE).astype(int)].all()


def test_a_small_map_under_a_wide_scan_asks_for_a_small_grid(made, save):
    """256 x 256 pixels of 1.6 arcsec under a scan of 26 deg asked for 59081 x 59081."""
    header = made.tan_header((256, 256), ra=60.0, dec=25.0, cdelt=(-1.6, 1.6))
    header["CTYPE1"], header["CTYPE2"] = "RA---SIN", "DEC--SIN"
    values = np.zeros((256, 256))
    values[127:129, 127:129] = 1.0
    scan = strip(made, 26.0, fwhm=9.0)
    operator = SkyMap(file=save(values, header))
    assert max(operator.grid_of(scan).shape) < 1500
    got = made.look(operator, scan)
    assert got.max() > 0.05
    assert scan.log.get("SkyMap", "samples outside the input map") > 0.9 * scan.n_samples


def test_a_map_that_no_sample_comes_near(made):
    far = Disc(-direction(*CENTRE), 0.1)
    found = region(strip(made), ARCMIN, 0.0, far, "here")
    assert not found.tiles.any()


@pytest.mark.parametrize("kind", ["healpix", "CAR"])
def test_tiles_and_blocks_change_nothing(made, save, tmp_path, monkeypatch, kind):
    """What a strip sees of a map of the whole sky is what it sees when the whole box is worked
    on.
    """
    rng = np.random.default_rng(3)
    if kind == "healpix":
        path = tmp_path / "h.fits"
        healpy.write_map(
            path, rng.standard_normal(12 * 64**2), coord="G", column_units="K_RJ", dtype=np.float64
        )
    else:
        header = made.tan_header((180, 360), ra=0.0, dec=0.0, cdelt=(-3600.0, 3600.0))
        header["CTYPE1"], header["CTYPE2"] = "RA---CAR", "DEC--CAR"
        path = save(rng.standard_normal((180, 360)), header)
    scan = strip(made, 60.0, fwhm=3600.0)
    monkeypatch.setattr(regions, "SPARSE", 1.0)
    some = SkyMap(file=path)
    parts = made.look(some, scan)
    assert not some.grid_of(scan).tiles.all()
    monkeypatch.setattr(regions, "SPARSE", 0.0)
    every = SkyMap(file=path)
    assert every.grid_of(scan).tiles is None
    # MARGIN points beyond the beam: 0.27^16 = 8e-10 of what is left out there; HEALPix: 1e-9 of the
    # polynomials' rounding
    np.testing.assert_allclose(parts, made.look(every, scan), atol=1e-8)


@pytest.mark.parametrize("kind", ["healpix", "CAR"])
def test_blocks_are_told(made, save, tmp_path, monkeypatch, kind):
    """The progress bar hears of every block, and of the end."""
    from zonda.operators.sky.read import read_map

    monkeypatch.setattr(regions, "BLOCK", 2 * TILE)
    told = []
    target = tangent_grid_wcs(*CENTRE, (-2 * TILE, 2 * TILE, -2 * TILE, 2 * TILE), ARCMIN)
    if kind == "healpix":
        healpy.write_map(
            tmp_path / "h.fits",
            np.ones(12 * 16**2),
            coord="C",
            column_units="K_RJ",
            dtype=np.float64,
        )
        interpolated(
            read_map(tmp_path / "h.fits"),
            target,
            progress=lambda done, total: told.append((done, total)),
        )
    else:
        header = made.tan_header((18, 36), ra=0.0, dec=0.0, cdelt=(-36000.0, 36000.0))
        header["CTYPE1"], header["CTYPE2"] = "RA---CAR", "DEC--CAR"
        image = read_map(save(np.ones((18, 36)), header))
        interpolated(image, target, progress=lambda done, total: told.append((done, total)))
    assert [done for done, _ in told] == [k * (2 * TILE) ** 2 for k in range(5)]
    assert {total for _, total in told} == {(4 * TILE) ** 2}


def test_planning_interpolates_nothing(made, tmp_path, monkeypatch):
    """Memory, bounds and costs come from the grid's shape; cost grows with the points that are
    worked on.
    """
    from zonda.operators.sky import convolved

    healpy.write_map(
        tmp_path / "h.fits",
        np.full(12 * 64**2, 2.0),
        coord="C",
        column_units="K_RJ",
        dtype=np.float64,
    )

    def refuse(*arguments):
        raise AssertionError("interpolated")

    monkeypatch.setattr(convolved, "interpolated", refuse)
    operator = SkyMap(file=tmp_path / "h.fits")
    small, wide = strip(made, 5.0, fwhm=3600.0), strip(made, 60.0, fwhm=3600.0)
    assert planning_of(operator).traits(wide).peak == pytest.approx(2.0)
    assert planning_of(operator).memory(wide) > planning_of(operator).memory(small) > 0


def test_the_progress_bar_hears_of_interpolation_and_its_end(made, tmp_path, monkeypatch):
    healpy.write_map(
        tmp_path / "h.fits",
        np.full(12 * 64**2, 2.0),
        coord="C",
        column_units="K_RJ",
        dtype=np.float64,
    )
    told = []
    monkeypatch.setattr(
        SkyMap,
        "_progress",
        lambda step, what: lambda done, total: told.append((what, done, total)),
    )
    SkyMap(file=tmp_path / "h.fits").prepare(strip(made, fwhm=3600.0))
    assert {what for what, _, _ in told} == {"interpolating h.fits"}
    assert told[0][1] == 0
    assert told[-2][1] == told[-2][2] > 0
    assert told[-1][1:] == (0, 0)
