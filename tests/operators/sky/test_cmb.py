"""The CMB: its spectra within cosmic variance, the band's conversion, files that are no
spectrum.
"""

from __future__ import annotations

import gzip

import healpy
import numpy as np
import pytest

import zonda
from zonda.core.block import Block
from zonda.core.errors import InputError, ZondaError
from zonda.core.numerics.radiation import T_CMB, to_kelvin_rj
from zonda.core.numerics.random import stream_key
from zonda.core.plan.planning import planning_of
from zonda.core.plan.pointing import context_of
from zonda.core.plan.structure import Structure
from zonda.core.registry import instruments
from zonda.operators.sky import cmb
from zonda.operators.sky.cmb import CMBSky, draw, read
from zonda.plugins.checks import scenes

LMAX, NSIDE = 95, 64


def theory(path, polarized=True):
    ell = np.arange(2, LMAX + 1.0)
    tt, ee, bb = 1000 + ell, 30 + 0.1 * ell, 2 + 0 * ell
    columns = [ell, tt, ee, bb, 0.4 * np.sqrt(tt * ee)] if polarized else [ell, tt]
    np.savetxt(path, np.stack(columns, axis=1), header="L TT EE BB TE")
    return path


def test_the_spectra_within_cosmic_variance(tmp_path):
    """Over l and skies: sum (2 l + 1) C^ / C is chi^2 with sum (2 l + 1) degrees. anafast of a
    band-limited map errs by 1e-3.
    """
    spectra = read(str(theory(tmp_path / "t.txt"))).values
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
    spectra = read(str(theory(tmp_path / "t.txt", polarized=False))).values
    fine, coarse = (
        healpy.map2alm(draw(spectra[:, :60], n, stream_key(1, "test"))[0], lmax=40, iter=5)
        for n in (64, 32)
    )
    assert np.abs(fine - coarse).max() < 1e-3 * np.abs(fine).max()


def test_the_stream_is_the_map_in_the_bands_kelvin(tmp_path):
    """Where the detectors look: the multipoles summed with the beam, times K_RJ per K_CMB of the
    band.
    """
    path = theory(tmp_path / "t.txt", polarized=False)
    observation = scenes.scan(3, 2000, radius=60.0)
    step = CMBSky(spectrum=path, nside=256)
    found = scenes.run([step], observation, keep=("sky",)).observations[0].detdata["sky"]
    ell = np.arange(LMAX + 1)
    fwhm = float(observation.focalplane.fwhm[0])
    alm = healpy.map2alm(
        step.sky(observation.seed, True)[0].map.hdu.data["I"].astype(np.float64),
        lmax=LMAX,
        iter=5,
    )
    beam = np.exp(-ell * (ell + 1) * fwhm**2 / (16 * np.log(2)))
    smooth = healpy.alm2map(healpy.almxfl(alm, beam), 1024)
    ra, dec = observation.ra, observation.dec
    expected = healpy.get_interp_val(smooth, np.pi / 2 - dec, ra) * to_kelvin_rj(
        "K_CMB", observation.instrument.band
    )
    # detector 0 is in the middle; both are interpolated, and vary by 1e-2 over a pixel of nside 256
    assert np.std(found[0] - expected) < 0.01 * np.std(expected) + 1e-3 * np.abs(expected).max()


def test_without_polarized_detectors_the_intensity_alone_is_drawn(tmp_path):
    """The same bits of it; and the plan counts less memory."""
    step = CMBSky(spectrum=theory(tmp_path / "t.txt"), nside=64)
    every, intensity = (step.sky(3, polarized)[0].map.hdu for polarized in (True, False))
    assert (every.columns.names, intensity.columns.names) == (["I", "Q", "U"], ["I"])
    np.testing.assert_array_equal(intensity.data["I"], every.data["I"])
    sizes = []
    for polarization in ("none", "pairs"):
        instrument = instruments.create("act_150ghz").varied(
            polarization=polarization, detectors=14
        )
        scene = zonda.Scene(
            site="atacama",
            instrument=instrument,
            time="2024-06-25T07:00",
            target="az 180 deg el 50 deg",
        )
        pipeline = zonda.Pipeline(
            [zonda.PointingStare(scan_duration="5 s"), step, zonda.BinMap(pixel="1 arcmin")]
        )
        context = context_of(pipeline, scene, Structure.of_all(pipeline))
        sizes.append(planning_of(context.operators[1]).memory(context.first))
    assert sizes[0] < sizes[1]


def test_seeds_and_realizations(tmp_path):
    path = theory(tmp_path / "t.txt", polarized=False)
    seeded = [
        CMBSky(spectrum=path, nside=16).sky(seed, True)[0].map.hdu.data["I"] for seed in (1, 2, 1)
    ]
    assert not np.array_equal(seeded[0], seeded[1])
    np.testing.assert_array_equal(seeded[0], seeded[2])
    fixed = [
        CMBSky(spectrum=path, nside=16, realization=4).sky(seed, True)[0].map.hdu.data["I"]
        for seed in (1, 2)
    ]
    np.testing.assert_array_equal(*fixed)


def test_scans_of_other_seeds_may_be_prepared_meanwhile(tmp_path):
    """The state has what `exec` needs: a scan keeps the sky of its seed while another scan's is
    drawn; none is drawn again.
    """
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
        ("2 1000\n3 x\n", "line 2: has no number in column 2"),
        ("2 1000 5\n3 1000\n", "line 2: has 2 values, not 3"),
        ("2 1000 1\n3 1000 1\n", "has 3 columns, and no heading names them"),
        ("2 1e-10\n3 1e-10\n", r"dimensionless \(rms 22.9 uK\)"),
        ("2 1e-9\n3 1e-9\n", "unit: K\\^2"),
        ("2 1e9\n3 1e9\n", "rms of 2.*e\\+04 uK"),
        ("# dimensionless\n2 1000\n3 1000\n", "unit: uK\\^2"),
        ("# L EE BB\n2 30 1\n3 30 1\n", "no heading names them"),
        ("2 1000\n4 1000\n", "multipoles are missing"),
        ("3 1000\n2 1000\n", "no rising series"),
        ("2 1000\n3 nan\n4 1000\n", "line 2: has no number in column 2"),
        ("2\n3\n", "has one column"),
        ("2 -5\n3 1000\n", "no sky has this spectrum"),
        ("2 100 1 0 50\n3 100 1 0 5\n", "no sky has this spectrum"),
    ],
)
def test_files_that_are_no_spectrum(tmp_path, text, match):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=match) as caught:
        read(str(path))
    assert "bad.txt" in str(caught.value)
    assert "usecols" not in str(caught.value)
    with pytest.raises(InputError, match=match):  # before a run
        zonda.CMBSky(spectrum=path).check(None)


def spectra():
    """l, and l (l + 1) C_l / (2 pi) in uK^2 by name: with a peak at l = 220, as the CMB's."""
    ell = np.arange(2, 901.0)
    tt = 1000 + 4500 * np.exp(-(((ell - 220) / 120) ** 2))
    return ell, {"TT": tt, "EE": 0.01 * tt, "BB": 1e-4 * tt, "TE": 0.05 * tt, "PP": 1e-7 / ell}


@pytest.mark.parametrize(
    ("heading", "order", "unit"),
    [
        ("L TT EE BB TE", ["TT", "EE", "BB", "TE"], "uK^2"),  # CAMB
        ("", ["TT", "EE", "BB", "TE"], "uK^2"),
        ("L    TT     TE     EE     BB     PP", ["TT", "TE", "EE", "BB", "PP"], "uK^2"),  # Planck
        (
            "dimensionless total lensed [l(l+1)/2pi] C_l's\n1:l 2:TT 3:EE 4:TE 5:BB 6:phiphi",
            ["TT", "EE", "TE", "BB", "PP"],
            "dimensionless",
        ),  # CLASS
        ("ell dl_tt dl_ee dl_te", ["TT", "EE", "TE"], "uK^2"),
    ],
)
def test_files_of_several_codes_are_one_spectrum(tmp_path, heading, order, unit):
    """Their units, orders and factors differ, not what is read: to rounding, 1e-12."""
    ell, powers = spectra()
    size = 1.0 if unit == "uK^2" else 1e-12 / T_CMB**2
    path = tmp_path / "cl.txt"
    np.savetxt(
        path, np.stack([ell, *(powers[name] * size for name in order)], axis=1), header=heading
    )
    found = read(str(path))
    for k, name in enumerate(("TT", "EE", "BB", "TE")):
        expected = (
            powers[name] * 2 * np.pi / (ell * (ell + 1)) * 1e-12 if name in order else 0 * ell
        )
        np.testing.assert_allclose(found.values[k, 2:], expected, rtol=1e-12)
    assert unit in found.text


def test_what_is_stated_stands_above_the_file(tmp_path):
    ell, powers = spectra()
    path = tmp_path / "cl.txt"
    np.savetxt(
        path, np.stack([ell, powers["TT"], powers["EE"], powers["TE"], powers["BB"]], axis=1)
    )  # CLASS's order, no heading
    stated = CMBSky(spectrum=path, columns="TT, EE, TE, BB").read().values
    np.testing.assert_allclose(
        stated[3, 2:], powers["TE"] * 2 * np.pi / (ell * (ell + 1)) * 1e-12, rtol=1e-12
    )
    c_l = powers["TT"] * 2 * np.pi / (ell * (ell + 1))
    np.savetxt(path, np.stack([ell, c_l], axis=1))
    with pytest.raises(InputError, match="scaling: none"):
        read(str(path))
    np.testing.assert_allclose(
        CMBSky(spectrum=path, scaling="none").read().values[0, 2:], c_l * 1e-12, rtol=1e-12
    )
    np.savetxt(path, np.stack([ell, powers["TT"] * 1e-12], axis=1))
    np.testing.assert_allclose(
        CMBSky(spectrum=path, unit="K^2").read().values[0, 2:], c_l * 1e-12, rtol=1e-12
    )


def test_the_rms_of_the_sky_is_told(tmp_path):
    """sum (2 l + 1) C_l / (4 pi), as the map drawn has it: its own multipoles' scatter, 0.5 % for l
    up to 900.
    """
    path = tmp_path / "cl.txt"
    ell, powers = spectra()
    np.savetxt(path, np.stack([ell, powers["TT"]], axis=1))
    step = CMBSky(spectrum=path, nside=512)
    assert step.sky(1, False)[1] == pytest.approx(step.read().rms, rel=0.05)
    assert f"rms {1e6 * step.read().rms:.4g} uK_CMB" in step.check(None)[0]


@pytest.mark.parametrize("kind", ["ascii.ecsv", "ascii.csv", "fits", "votable"])
def test_tables_with_names(tmp_path, kind):
    """The spectrum of a table is that of plain text with the same columns."""
    from astropy.table import Table

    ell = np.arange(2, 40)
    columns = {"ell": ell, "TT": 1000.0 + ell, "TE": 0.1 * ell, "EE": 10.0 + ell, "BB": 0.01 * ell}
    made = Table(columns)
    if kind != "ascii.csv":
        for name in cmb.READ:
            made[name].unit = "uK2"
    made.write(tmp_path / "t", format=kind)
    found = read(str(tmp_path / "t"))
    heading = "L " + " ".join(list(columns)[1:])
    np.savetxt(tmp_path / "t.txt", np.transpose(list(columns.values())), header=heading)
    np.testing.assert_allclose(found.values, read(str(tmp_path / "t.txt")).values, rtol=1e-12)


def test_a_packed_spectrum_is_unpacked_up_to_a_limit(tmp_path):
    path = tmp_path / "cl.txt.gz"
    path.write_bytes(gzip.compress(b"2 1000\n3 1000\n"))
    assert read(str(path)).values.shape == (4, 4)
    path.write_bytes(gzip.compress(b"2 1000\n3 1000\n" + b"\n" * 10_000_000))
    with pytest.raises(InputError, match="GB of memory"):
        read(str(path))
