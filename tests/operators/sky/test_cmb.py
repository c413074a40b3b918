"""The CMB: its spectra within cosmic variance, the band's conversion, files that are no spectrum."""

from __future__ import annotations

import healpy
import numpy as np
import pytest

import zonda
from zonda.core.block import Block
from zonda.core.errors import InputError, ZondaError
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.numerics.random import stream_key
from zonda.core.plan.look import look
from zonda.core.plan.planning import planning_of
from zonda.core.plan.structure import Structure
from zonda.core.registry import instruments
from zonda.operators.sky import cmb
from zonda.operators.sky.cmb import CMBSky, draw, read_spectrum
from zonda.plugins.checks import scenes

LMAX, NSIDE = 95, 64


def theory(path, polarized=True):
    ell = np.arange(2, LMAX + 1.0)
    tt, ee, bb = 1000 + ell, 30 + 0.1 * ell, 2 + 0 * ell
    columns = [ell, tt, ee, bb, 0.4 * np.sqrt(tt * ee)] if polarized else [ell, tt]
    np.savetxt(path, np.stack(columns, axis=1), header="L TT EE BB TE")
    return path


def test_the_spectra_within_cosmic_variance(tmp_path):
    """Over l and skies: sum (2 l + 1) C^ / C is chi^2 with sum (2 l + 1) degrees. anafast of a band-limited map errs by 1e-3."""
    spectra = read_spectrum(str(theory(tmp_path / "t.txt")))
    number, found = 12, np.zeros((4, LMAX + 1))
    for k in range(number):
        maps = draw(spectra, NSIDE, stream_key(k, "test"))
        found += healpy.anafast(maps, lmax=LMAX, iter=3)[[0, 1, 2, 3]] / number
    ell = np.arange(10, LMAX + 1)
    degrees = number * (2 * ell + 1).sum()
    for got, wanted in zip(found[:3], spectra[:3], strict=True):
        ratio = ((2 * ell + 1) * got[ell] / wanted[ell]).sum() / (2 * ell + 1).sum()
        assert abs(ratio - 1) < 4 * np.sqrt(2 / degrees) + 2e-3
    te = spectra[3]
    ratio = ((2 * ell + 1) * found[3][ell] / te[ell]).sum() / (2 * ell + 1).sum()
    assert abs(ratio - 1) < 4 * np.sqrt((1 + 1 / 0.4**2) / degrees) + 2e-3


def test_another_nside_is_the_same_sky(tmp_path):
    spectra = read_spectrum(str(theory(tmp_path / "t.txt", polarized=False)))
    fine, coarse = (healpy.map2alm(draw(spectra[:, :60], n, stream_key(1, "test"))[0], lmax=40, iter=5) for n in (64, 32))
    assert np.abs(fine - coarse).max() < 1e-3 * np.abs(fine).max()


def test_the_stream_is_the_map_in_the_bands_kelvin(tmp_path):
    """Where the detectors look: the multipoles summed with the beam, times K_RJ per K_CMB of the band."""
    path = theory(tmp_path / "t.txt", polarized=False)
    observation = scenes.scan(3, 2000, radius=60.0)
    step = CMBSky(spectrum=path, nside=256)
    found = scenes.run([step], observation, keep=("sky",)).observations[0].detdata["sky"]
    ell = np.arange(LMAX + 1)
    fwhm = float(observation.focalplane.fwhm[0])
    alm = healpy.map2alm(step.sky(observation.seed, True)[0].map.table.data["I"].astype(np.float64), lmax=LMAX, iter=5)
    beam = np.exp(-ell * (ell + 1) * fwhm**2 / (16 * np.log(2)))
    smooth = healpy.alm2map(healpy.almxfl(alm, beam), 1024)
    ra, dec = observation.ra, observation.dec
    expected = healpy.get_interp_val(smooth, np.pi / 2 - dec, ra) * to_kelvin_rj("K_CMB", observation.instrument.band)
    # detector 0 is in the middle; both are interpolated, and vary by 1e-2 over a pixel of nside 256
    assert np.std(found[0] - expected) < 0.01 * np.std(expected) + 1e-3 * np.abs(expected).max()


def test_without_polarized_detectors_the_intensity_alone_is_drawn(tmp_path):
    """The same bits of it; and the plan counts less time and memory."""
    step = CMBSky(spectrum=theory(tmp_path / "t.txt"), nside=64)
    every, intensity = (step.sky(3, polarized)[0].map.table for polarized in (True, False))
    assert (every.columns.names, intensity.columns.names) == (["I", "Q", "U"], ["I"])
    np.testing.assert_array_equal(intensity.data["I"], every.data["I"])
    costs, sizes = [], []
    for polarization in ("none", "pairs"):
        instrument = instruments.create("act_150ghz").varied(polarization=polarization, detectors=14)
        scene = zonda.Scene(site="atacama", instrument=instrument, time="2024-06-25T07:00", target="az 180 deg el 50 deg")
        pipeline = zonda.Pipeline([zonda.PointingStare(scan_duration="5 s"), step, zonda.BinMap(pixel="1 arcmin")])
        context = look(pipeline, scene, Structure.of_all(pipeline))
        planning = planning_of(context.operators[1])
        costs.append(planning.estimate(context).cost.once)
        sizes.append(planning.memory(context.first))
    assert costs[0] < costs[1]
    assert sizes[0] < sizes[1]


def test_the_forecast_follows_the_highest_multipole(tmp_path):
    """Transforms take l_max^2 nside."""
    once = []
    for lmax in (1000, 3000, 6000):
        path = tmp_path / f"{lmax}.txt"
        ell = np.arange(2, lmax + 1.0)
        np.savetxt(path, np.stack([ell, 1000 + 0 * ell], axis=1))
        pipeline = zonda.Pipeline([zonda.PointingStare(scan_duration="5 s"), CMBSky(spectrum=path, nside=1024), zonda.BinMap()])
        scene = zonda.Scene(site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="75 deg 20 deg")
        context = look(pipeline, scene, Structure.of_all(pipeline))
        once.append(planning_of(context.operators[1]).estimate(context).cost.once)
    assert (once[1] - once[0]) == pytest.approx(8e-10 * 1024 * (3000**2 - 1000**2))
    assert (once[2] - once[0]) == pytest.approx(8e-10 * 1024 * (3071**2 - 1000**2))  # 3 nside - 1


def test_seeds_and_realizations(tmp_path):
    path = theory(tmp_path / "t.txt", polarized=False)
    seeded = [CMBSky(spectrum=path, nside=16).sky(seed, True)[0].map.table.data["I"] for seed in (1, 2, 1)]
    assert not np.array_equal(seeded[0], seeded[1])
    np.testing.assert_array_equal(seeded[0], seeded[2])
    fixed = [CMBSky(spectrum=path, nside=16, realization=4).sky(seed, True)[0].map.table.data["I"] for seed in (1, 2)]
    np.testing.assert_array_equal(*fixed)


def test_scans_of_other_seeds_may_be_prepared_meanwhile(tmp_path):
    """The state has what `exec` needs: a scan keeps the sky of its seed while another scan's is drawn; none is drawn again."""
    path, found = theory(tmp_path / "t.txt", polarized=False), []
    for others in (False, True):
        step, observation = CMBSky(spectrum=path, nside=64), scenes.scan(3, 200, radius=60.0)
        state = step.prepare(observation)
        if others:
            another = scenes.scan(3, 200, radius=60.0)
            another.seed = observation.seed + 1
            step.prepare(another)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cmb, "draw", None)
            block = Block(observation, slice(0, 3), slice(0, 200))
            step.exec(block, state)
        found.append(block.detdata["sky"])
    assert np.ptp(found[0]) > 0
    np.testing.assert_array_equal(*found)


def test_without_a_spectrum_it_is_refused():
    with pytest.raises((ZondaError, ValueError), match="spectrum"):
        zonda.CMBSky()


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("2 1000\n3 x\n", "cannot be read as a power spectrum"),
        ("2 1000 5\n3 1000\n", "the number of columns changed"),
        ("2 1000 1\n3 1000 1\n", "has 3 columns, not 2 or 5"),
        ("2 1000\n4 1000\n", "multipoles are missing"),
        ("3 1000\n2 1000\n", "no rising series"),
        ("2 -5\n3 1000\n", "no sky has this spectrum"),
        ("2 100 1 0 50\n3 100 1 0 5\n", "no sky has this spectrum"),
    ],
)
def test_files_that_are_no_spectrum(tmp_path, text, match):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=match) as caught:
        read_spectrum(str(path))
    assert "bad.txt" in str(caught.value)
    assert "usecols" not in str(caught.value)
    with pytest.raises(InputError, match=match):  # before a run
        zonda.CMBSky(spectrum=path).check(None)
