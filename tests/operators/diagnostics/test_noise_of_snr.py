"""What the signal-to-noise ratio divides by: measured noise where a map of the noise alone is made,
and that it says which.
"""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from astropy.io import fits

import zonda
from zonda.core import cli
from zonda.core.maps.noise_figures import FREE, maps_of, noise_stated
from zonda.core.maps.planes import WHITE
from zonda.operators.diagnostics.comparison.files import read_planes
from zonda.operators.diagnostics.plot_operators import Plots, _of_maps, _snr

SCANS, KNEE = 2, "1 Hz"


def camera(polarization):
    return zonda.Instrument(
        name="cam",
        telescope={"name": "dish", "diameter": "100 m"},
        band={"name": "b", "low": "80 GHz", "high": "100 GHz"},
        detectors=38,
        field_of_view="2 arcmin",
        fwhm="9 arcsec",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1 mK s(1/2)",
        knee=KNEE,
        sample_rate="50 Hz",
        polarization=polarization,
    )


def run(folder, *more, scans=1, free=True, polarization="none", **of_map):
    """White and pink noise through a mild filter, with the sky of a faint source: a scene of
    correlated noise.
    """
    y, x = np.indices((81, 81)) - 40.0
    source = 1e-4 * np.exp(-4 * np.log(2) * (x**2 + y**2) * 9 / 20.0**2)
    sky = {"map": source}
    if "stokes" in of_map:
        sky = {
            "map": np.stack([source, source / 2, -source / 3]),
            "polarization_convention": "cosmo",
        }
    pixel = {} if "nside" in of_map else {"pixel": "3 arcsec"}
    steps = [
        zonda.PointingDaisy(
            radius="1.5 arcmin", speed="50 arcsec/s", scan_duration="60 s", scans=scans
        ),
        zonda.SkyMap(**sky, pixel_size="3 arcsec", unit="K_RJ", centre="target"),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="0.1 Hz"),
        zonda.BinMap(**pixel, **of_map),
        *more,
    ]
    runs = {"source_free": {"without": ["sky"], "modes": "full"}} if free else {}
    scene = zonda.Scene(
        site="green_bank",
        instrument=camera(polarization),
        time="2024-11-25T07:00",
        target="75 deg +20 deg",
        seed=11,
    )
    return zonda.Pipeline(steps, runs=runs).run(scene, output=folder, threads=1)


def off_source(found):
    """SNR where the reference has none of the source."""
    snr = found.planes["snr"]
    return snr[np.isfinite(snr) & (np.abs(found.planes["reference"]) < 1e-7)]


@pytest.mark.parametrize(
    ("of_map", "plane"),
    [
        ({}, ""),
        ({"projection": "CAR"}, ""),
        ({"smooth": "9 arcsec"}, ""),
        ({"stokes": "IQU"}, "_Q"),
        ({"stokes": "IQU"}, "_U"),
    ],
)
def test_one_scan_has_a_ratio_of_unit_rms(tmp_path, of_map, plane):
    """The source-free map is the noise itself: 1 to what the covered edge differs; by white noise
    alone it is 1.2 to 3.
    """
    polarization = "pairs" if "stokes" in of_map else "none"
    data = run(
        None,
        zonda.CompareMaps(),
        zonda.CompareMaps(noise="map", name="white"),
        polarization=polarization,
        **of_map,
    )
    found, white = data[f"comparison{plane}"], data[f"white{plane}"]
    assert off_source(found).std() == pytest.approx(1.0, abs=0.1)
    assert (
        np.abs(off_source(found)) > 3
    ).mean() < 0.012  # 0.27 % of a Gaussian, of some hundred independent patches
    words, factor = found.noise["snr"]
    assert words == f"{factor:.3g} x white noise, as in {FREE}"
    assert factor == pytest.approx(off_source(white).std(), rel=0.12)
    assert factor > 1.15
    assert white.noise["snr"] == (WHITE, None)
    assert f"noise of the map: {words}" in found.notes


def test_without_a_map_of_the_noise_alone_it_says_white_noise_only(tmp_path):
    data = run(
        tmp_path,
        zonda.CompareMaps(),
        zonda.SaveMap(),
        zonda.Plots(contours=[-2, 2], dpi=50),
        zonda.Report(),
        free=False,
    )
    assert data["comparison"].noise["snr"] == (WHITE, None)
    assert ("CompareMaps", "noise of the map", WHITE) in list(data.log.told())
    header = fits.getheader(tmp_path / "map.fits", "NOISE")
    assert header["NOISEOF"] == WHITE
    assert "NOISEFAC" not in header
    assert fits.getheader(tmp_path / "comparison.fits", "SNR")["NOISEOF"] == WHITE
    captions = {p.name: p.caption for p in data["pictures"]}
    for name in ("map", "comparison_quality"):
        assert f"Its noise: {WHITE}." in captions[name]
    assert f"Its noise: {WHITE}." in (tmp_path / "report.html").read_text()


def test_titles_headers_and_the_report_state_the_factor(tmp_path):
    """Two scans: the source-free map counts first, half the difference where it is not there or
    where it is wanted.
    """
    data = run(
        tmp_path,
        zonda.CompareMaps(),
        zonda.SaveMap(),
        zonda.Plots(contours=[-2, 2], dpi=50),
        zonda.Report(),
        scans=SCANS,
    )
    words, factor = data["comparison"].noise["snr"]
    snr = fits.getheader(tmp_path / "comparison.fits", "SNR")
    assert (snr["NOISEFAC"], snr["NOISEOF"]) == (pytest.approx(factor), words)
    stated = noise_stated(maps_of(data.products), "map")["I"]
    noise = fits.getheader(tmp_path / "map.fits", "NOISE")
    assert (noise["NOISEFAC"], noise["NOISEOF"]) == (pytest.approx(stated[0]), FREE)
    half = noise_stated({"map": data["map"]}, "map")["I"]
    assert half[1] == "half the difference, even - odd scans"
    assert half[0] == pytest.approx(stated[0], rel=0.1)  # the noise of two scans, independent
    style = Plots(contours=[-2, 2])
    sketch = next(s for s in _of_maps(data, style) if s.name == "map")
    assert sketch.ax.get_title().endswith("× white noise")
    assert f"as in {FREE}." in sketch.caption
    assert sketch.caption in (tmp_path / "report.html").read_text().replace("&#39;", "'")


def test_files_that_a_run_saved_are_compared_by_the_same_noise(tmp_path, capsys):
    """`zonda compare` reads the source-free map beside it, or the factor of the header where that
    is elsewhere.
    """
    data = run(tmp_path / "out", zonda.CompareMaps(beam="20 arcsec"), zonda.SaveMap())
    path = tmp_path / "out" / "map.fits"
    plane = read_planes(path).planes["I"]
    white = data["map"].noise
    np.testing.assert_allclose(plane.noise, white, rtol=1e-12)
    factor = data["comparison"].noise["snr"][1]
    there = plane.smoothed(np.radians(20 / 3600)).measured()
    assert there.factor == pytest.approx(factor, rel=0.05)  # the comparison leaves out the rim
    shutil.copy(path, tmp_path / "alone.fits")
    alone = read_planes(tmp_path / "alone.fits").planes["I"]
    stated = fits.getheader(path, "NOISE")["NOISEFAC"]
    np.testing.assert_allclose(alone.noise, stated * white, rtol=1e-12)
    assert alone.noise_in_words == f"{stated:.3g} x white noise, as in {FREE}"
    assert cli.main(["compare", str(path), str(path), "--output", str(tmp_path / "o")]) == 0
    assert f"x white noise, as in {FREE}" in capsys.readouterr().out


def test_a_source_free_map_of_an_earlier_run_is_not_taken(tmp_path):
    """The second run makes none; the first one's, which it removes, is put back beside its map."""
    path = tmp_path / "source_free_map.fits"
    run(tmp_path, zonda.SaveMap())
    assert read_planes(tmp_path / "map.fits").planes["I"].alone is not None
    old = path.read_bytes()
    run(tmp_path, zonda.SaveMap(), free=False)
    path.write_bytes(old)
    assert read_planes(tmp_path / "map.fits").planes["I"].noise_in_words == WHITE


def test_healpix_files_state_their_noise(tmp_path):
    data = run(tmp_path, zonda.SaveMap(), nside=16384)
    header = fits.getheader(tmp_path / "map.fits", 1)
    factor = noise_stated(maps_of(data.products), "map")["I"][0]
    assert header["NOISFACI"] == pytest.approx(factor)
    assert header["NOISEOF"] == FREE
    assert read_planes(tmp_path / "map.fits").planes["I"].alone is not None


def test_noise_of_p_is_that_of_q_and_u(tmp_path):
    data = run(None, polarization="pairs", stokes="IQU")
    style = Plots(contours=[-3, 3], smooth="none")
    snr, words = _snr(data["map"].stokes("P"), style, maps_of(data.products), "map_P")
    assert f"as in {FREE}" in words
    assert np.nanmean(snr**2) == pytest.approx(2.0, rel=0.2)  # Rayleigh: Q and U of unit variance
