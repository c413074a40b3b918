"""A written map opens elsewhere with every source where it was, its unit, its beam and its
history.
"""

from __future__ import annotations

import errno
import tracemalloc

import healpy as hp
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from astropy.wcs import WCS

import zonda
from zonda.core.errors import InputError, OutputError, PipelineError, ZondaError
from zonda.core.maps import map_file
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.radiation import band_average, intensity_to_kelvin
from zonda.operators.io.save_map import SaveMap
from zonda.plugins.checks.scenes import camera, scene

ARCSEC = np.pi / 648000


def wcs_map(nx, ny, seed=0, half=True, source=None):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [75.0, 20.0]
    wcs.wcs.crpix = [(nx + 1) / 2, (ny + 1) / 2]
    wcs.wcs.cdelt = [-2 / 3600, 2 / 3600]
    rng = np.random.default_rng(seed)
    signal = rng.normal(0, 1e-4, (ny, nx))
    signal[0, 0] = np.nan
    if source is not None:
        x, y = np.rint(wcs.world_to_pixel_values(*source)).astype(int)
        signal[y, x] = 1.0
    hits = rng.integers(0, 50, (ny, nx))
    return MapProduct(
        signal,
        hits,
        hits * 1e6,
        1e-3 / np.sqrt(np.maximum(hits, 1)),
        rng.normal(0, 1e-4, (ny, nx)) if half else None,
        wcs.to_header(),
        centre=(np.radians(75.0), np.radians(20.0)),
        pixel=2 * ARCSEC,
        weighting="inverse_variance",
        fwhm=9 * ARCSEC,
    )


def healpix_map(n, nside=256, nest=True):
    centre = hp.ang2pix(nside, 75.0, 20.0, nest=True, lonlat=True)
    pixels = np.sort(centre // 4096 * 4096 + np.random.default_rng(4).permutation(4096)[:n])
    if not nest:
        pixels = hp.nest2ring(nside, pixels)
    signal = np.arange(n) * 1e-5 + 1e-9
    return MapProduct(
        signal,
        np.arange(n) + 1,
        (np.arange(n) + 1) * 1e6,
        np.full(n, 1e-3),
        None,
        None,
        centre=(np.radians(75.0), np.radians(20.0)),
        pixel=hp.nside2resol(nside),
        nside=nside,
        nest=nest,
        pixels=pixels,
        fwhm=9 * ARCSEC,
    )


@pytest.fixture
def run(data, make_observation):
    data.observations.append(make_observation(100))
    data.log.count("SkyMap", "samples outside", 3)

    def finalize(**products):
        data.products.update({k.replace("__", "/"): v for k, v in products.items()})
        SaveMap().finalize(data)
        return data.output

    return finalize


@pytest.mark.parametrize("shape", [(100, 100), (101, 101), (64, 37), (37, 64), (1, 1)])
def test_a_source_is_at_its_world_coordinate(run, shape):
    source = (75.0 + 20 / 3600, 20.0 - 14 / 3600) if min(shape) > 30 else (75.0, 20.0)
    with fits.open(run(map=wcs_map(*shape, source=source)) / "map.fits") as file:
        wcs, values = WCS(file[0].header), file[0].data
        y, x = np.unravel_index(np.nanargmax(values), values.shape)
        found = wcs.pixel_to_world(x, y)
        assert found.frame.name == "icrs"
        # The source was put into the pixel nearest to it: at most half a pixel (1 arcsec) off in
        # each direction
        assert abs(found.ra.deg - source[0]) * np.cos(np.radians(20)) <= 1.0001 / 3600
        assert abs(found.dec.deg - source[1]) <= 1.0001 / 3600


def test_every_plane_comes_back(run):
    product = wcs_map(50, 40)
    with fits.open(run(map=product) / "map.fits") as file:
        file.verify("exception")
        names = ["SIGNAL", "HITS", "WEIGHTS", "NOISE", "HALF_DIFFERENCE"]
        assert [h.name for h in file][:5] == names
        for name in names:
            np.testing.assert_array_equal(file[name].data, getattr(product, name.lower()))
            np.testing.assert_allclose(WCS(file[name].header).wcs.crval, [75, 20], rtol=1e-13)
        assert file["HITS"].data.dtype.kind == "i"
        assert "BUNIT" not in file["HITS"].header
        assert file["WEIGHTS"].header["BUNIT"] == "K-2"
        assert "BMAJ" not in file["HITS"].header


def test_the_beam_is_the_resolution_of_the_map(run):
    product = wcs_map(60, 60).smoothed(12 * ARCSEC)
    header = fits.getheader(run(map=product) / "map.fits")
    assert header["BMAJ"] == pytest.approx(15 / 3600)  # 9 and 12 in quadrature


def test_the_header_says_what_it_is(run):
    header = fits.getheader(run(map=wcs_map(50, 40)) / "map.fits")
    assert header["BUNIT"] == "K"
    assert header["TEMPSCAL"] == "K_RJ"
    assert header["BMAJ"] == header["BMIN"] == pytest.approx(9 / 3600)
    assert header["BPA"] == 0
    assert header["SEED"] == 7
    assert header["CREATOR"] == "zonda 0.1.0"
    assert header["PIPELINE"] == "demo <b>"
    assert header["SITE"] == "hill"
    assert header["DATE-OBS"].startswith("2024-11-25T07:00:00.123456789")
    assert list(header["HISTORY"]) == ["a: 1", "b: '\\xe9'"]


STATED = ("DATE-OBS", "MJD-OBS", "EXPTIME", "NSCANS", "OBJECT", "SITE", "INSTRUME", "RESTFRQ")


@pytest.fixture(scope="module")
def observed(tmp_path_factory):
    """Two scans with a gap, of a mosaic; the scene's own target and time are not those of the map's
    first scan alone."""
    folder = tmp_path_factory.mktemp("observed")
    steps = [
        zonda.PointingDaisy(
            radius="1 arcmin",
            scan_duration="8 s",
            gap="30 s",
            targets=["05h +20d", "05h00m04s +20d01m"],
        ),
        zonda.SkyMap(map=np.ones((9, 9)), pixel_size="1 arcmin", centre="05h +20d", unit="K_RJ"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(pixel="6 arcsec"),
        zonda.SaveMap(),
    ]
    where = scene(camera(7), time="2024-11-25T07:00:12.25", target="06h +10d")
    data = zonda.Pipeline(steps, runs={"noiseless": {"only": ["sky"]}}).run(
        where, output=folder / "out", threads=1
    )
    return data, folder


def test_the_header_says_when_and_where_the_scans_were(observed):
    _data, folder = observed
    header = fits.getheader(folder / "out" / "map.fits")
    # 8 s at the camera's rate twice; not the 46 s from the first sample to the last
    assert header["EXPTIME"] == pytest.approx(16.0, abs=0.05)
    assert header["DATE-OBS"] == "2024-11-25T07:00:12.25"  # no Z: FITS 4.0, section 9.1.1
    assert Time(header["MJD-OBS"], format="mjd").isot == "2024-11-25T07:00:12.250"
    assert header["OBJECT"] == "05h00m00.00s +20d00m00.0s, 05h00m04.00s +20d01m00.0s"


def test_a_map_written_in_python_has_the_headers_of_the_step(observed):
    data, folder = observed
    for name in ("map", "noiseless/map"):
        path = data[name].write(folder / "own.fits", overwrite=True)
        saved = folder / "out" / f"{name.replace('/', '_')}.fits"
        with fits.open(path) as own, fits.open(saved) as theirs:
            for a, b in zip(own, theirs, strict=False):  # SaveMap's tables stand behind
                assert repr(a.header) == repr(b.header)
    assert all(key in fits.getheader(path) for key in STATED)


def test_other_units_are_those_of_the_maps_beam_and_spectrum(observed, tmp_path):
    data, _ = observed
    data.output, step = tmp_path, zonda.SaveMap(unit="mJy/beam", spectral_index=2.5)
    step.finalize(data)
    with fits.open(tmp_path / "map.fits") as file, fits.open(tmp_path / "noise_map.fits") as noise:
        header, known = file[0].header, np.isfinite(file[0].data)
        band, fwhm = data.scene.instrument.band, np.radians(header["BMAJ"])

        def spectrum(nu):
            return (nu / band.centre) ** 2.5 * intensity_to_kelvin(nu)

        beam = np.pi * fwhm**2 / (4 * np.log(2))
        kelvin = file[0].data[known] * 1e-29 / beam * band_average(band, spectrum)
        np.testing.assert_allclose(kelvin, data["map"].signal[known], rtol=1e-12)
        assert (header["BUNIT"], header["SPECINDX"]) == ("mJy/beam", 2.5)
        assert header["RESTFRQ"] == pytest.approx(band.centre)
        assert file["NOISE"].header["BUNIT"] == noise[0].header["BUNIT"] == "mJy/beam"
        # the rms stays in kelvin, as its comment says
        assert noise[0].header["RMSHALF"] == pytest.approx(data["map"].rms(of="half_difference"))
    assert data["map"].unit == "K_RJ"


def test_a_unit_that_cannot_be_is_refused_with_its_cause(data):
    with pytest.raises(ZondaError, match="unknown unit 'furlong'"):
        SaveMap(unit="furlong")
    with pytest.raises(ZondaError, match="spectral_index is for Jy"):
        SaveMap(unit="K_CMB", spectral_index=1)
    product = wcs_map(20, 20)
    product.fwhm, product.band = 0.0, scene(camera(1)).instrument.band
    data.products["map"] = product
    with pytest.raises(InputError, match=r"SaveMap(.|\n)*beam of the map is not known"):
        SaveMap(unit="Jy/beam").finalize(data)


def test_the_tables_hold_the_configuration_and_the_tally(run):
    with fits.open(run(map=wcs_map(50, 40)) / "map.fits") as file:
        assert list(file["RESOLVED_YAML"].data["LINE"]) == ["a: 1", "b: '\\xe9'"]
        assert file["TALLY"].data["VALUE"][0] == "3"


def test_companion_runs_and_the_noise_map(run, data):
    free = wcs_map(120, 120, seed=2)
    main = wcs_map(120, 120, seed=1)
    folder = run(map=main, source_free__map=free, noiseless__map=wcs_map(120, 120))
    assert sorted(p.name for p in folder.iterdir()) == [
        "map.fits",
        "noise_map.fits",
        "noiseless_map.fits",
        "source_free_map.fits",
    ]
    with fits.open(folder / "noise_map.fits") as file:
        assert [h.name for h in file][:2] == ["HALF_DIFFERENCE", "SOURCE_FREE"]
        np.testing.assert_array_equal(file["SOURCE_FREE"].data, free.signal)
        header = file[0].header
        # Within 30 arcsec of the centre, 2 arcsec pixels, the centre at a pixel corner: a disc of
        # 15 pixels' radius. Pixels on the rim may fall either way: 12 of 700, so 1 %
        y, x = np.mgrid[:120, :120] - 59.5
        inside = np.hypot(x, y) <= 15
        w = main.weights[inside]
        assert header["RMSHALF"] == pytest.approx(
            np.sqrt((w * main.half_difference[inside] ** 2).sum() / w.sum()), rel=0.01
        )
        w = free.weights[inside]
        assert header["RMSFREE"] == pytest.approx(
            np.sqrt((w * free.signal[inside] ** 2).sum() / w.sum()), rel=0.01
        )
        # White noise smoothed with a beam of sigma s pixels falls by 1 / (2 sqrt(pi) s); 50
        # independent beams: 10 %, four sigma
        sigma = 9 / 2 / 2.3548
        assert header["RMSFREEB"] == pytest.approx(1e-4 / (2 * np.sqrt(np.pi) * sigma), rel=0.4)
    assert len(data.products["map_file"]) == 4


def test_a_centre_without_data_has_no_rms(run):
    empty = wcs_map(120, 120)
    empty.half_difference[:] = np.nan
    header = fits.getheader(run(map=empty) / "noise_map.fits")
    assert header["RMSHALF"] is None


@pytest.mark.parametrize("n", [1, 7, 99, 100, 101, 1500])
@pytest.mark.parametrize("nest", [True, False])
def test_healpy_reads_a_partial_map(run, n, nest):
    """healpy's own partial writer loses pixels below 100: ours must not."""
    product = healpix_map(n, nest=nest)
    path = run(map=product) / "map.fits"
    values, header = hp.read_map(path, field=0, nest=nest, h=True, dtype=np.float64)
    header = dict(header)
    assert values.size == hp.nside2npix(256)
    np.testing.assert_array_equal(values[product.pixels], product.signal)
    assert np.count_nonzero(values != hp.UNSEEN) == n
    np.testing.assert_array_equal(
        hp.read_map(path, field=1, nest=nest)[product.pixels], product.hits
    )
    assert header["COORDSYS"] == "C"
    assert header["TUNIT2"] == "K"
    assert header["TEMPSCAL"] == "K_RJ"
    assert header["SEED"] == 7


def test_no_output_folder_and_no_map(data):
    with pytest.raises(PipelineError, match="no map to write"):
        SaveMap().finalize(data)
    data.output = None
    with pytest.raises(OutputError, match="no output folder"):
        SaveMap().finalize(data)


def test_an_earlier_file_is_kept_on_request(run, data):
    run(map=wcs_map(20, 20))
    before = (data.output / "map.fits").read_bytes()
    with pytest.raises(OutputError, match="exists already"):
        SaveMap(overwrite=False).finalize(data)
    assert (data.output / "map.fits").read_bytes() == before


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()]
)
def test_a_failure_in_the_middle_leaves_the_old_file(run, data, monkeypatch, error):
    run(map=wcs_map(20, 20))
    before = (data.output / "map.fits").read_bytes()

    def half(file, *_):
        file.write(b"SIMPLE")
        raise error

    monkeypatch.setattr(map_file, "write_image", half)
    expected = KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else OutputError
    with pytest.raises(expected):
        SaveMap().finalize(data)
    assert (data.output / "map.fits").read_bytes() == before
    assert not [p for p in data.output.iterdir() if "part" in p.name]


def test_two_runs_write_the_same_bytes(run, data):
    run(map=wcs_map(20, 20))
    before = (data.output / "map.fits").read_bytes()
    SaveMap().finalize(data)
    assert (data.output / "map.fits").read_bytes() == before


def test_a_missing_folder_is_refused_before_the_run(data, tmp_path):
    (tmp_path / "out").write_text("a file in its place")
    with pytest.raises(OutputError, match="there is a file of that name"):
        SaveMap().observe(data)
    data.output = None
    with pytest.raises(OutputError, match="no output folder"):
        SaveMap().observe(data)


def test_healpix_tables_are_copied_one_at_a_time(run):
    """Tables of 0.5 MB (pixel numbers and four planes): copies of one while it is written, not of
    all files' at once.
    """
    maps = {"map": healpix_map(4096), **{f"r{k}__map": healpix_map(4096) for k in range(5)}}
    for made in maps.values():
        for name in ("signal", "hits", "weights", "noise", "pixels"):
            setattr(made, name, np.tile(getattr(made, name), 3))
        made.pixels = np.arange(made.signal.size)
    run(**maps)  # what is imported and compiled once
    tracemalloc.start()
    try:
        run(**maps)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 5 * 8 * 3 * 4096 < peak < 4 * 5 * 8 * 3 * 4096
