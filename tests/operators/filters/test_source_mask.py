"""Source masks: where they are, and that what is removed is found outside of them."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

import zonda.testing
from zonda.core.errors import InputError, PipelineError
from zonda.core.numerics.projection import directions
from zonda.operators.filters.common_mode import CommonModeFilter
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.filters.polynomial import Detrend
from zonda.operators.filters.source_mask import SourceMask, counts

N_DET, N = 37, 6000
MASK = {"radius": "25 arcsec"}
WHITE = 0.017
FILTERS = [
    HighpassFilter(frequency="0.5 Hz", mask=MASK),
    HighpassFilter(frequency="0.5 Hz", response="bessel", mask=MASK),
    Detrend(order=4, mask=MASK),
    CommonModeFilter(mask=MASK),
    CommonModeFilter(mask=MASK, scale="rms"),
    CommonModeFilter(mask=MASK, method="mean"),
]


def distance(bench, observation):
    """(n_det, n_samp) from the target, rad, by the arc cosine."""
    plane, (ra, dec) = observation.focalplane, bench.CENTRE
    centre = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    looked = directions(observation.boresight_radec, plane.xi, plane.eta)
    return np.arctan2(np.linalg.norm(np.cross(looked, centre), axis=-1), looked @ centre)


def test_it_is_a_disc_on_the_sky(bench):
    observation = bench.observation(N_DET, N)
    inside = SourceMask(**MASK).of(observation)
    found, radius = inside.at(slice(0, N_DET), slice(0, N)), 25 * bench.ARCSEC
    near = np.abs(distance(bench, observation) - radius) < 1e-9 * radius
    np.testing.assert_array_equal(found[~near], (distance(bench, observation) <= radius)[~near])
    np.testing.assert_array_equal(inside.at(slice(3, 9), slice(100, 333)), found[3:9, 100:333])
    assert counts(inside, N_DET, N) == (int(found.sum()), int(found.all(axis=0).sum()))
    elsewhere = SourceMask(radius="25 arcsec", centre="05h +21d").of(observation)
    assert not elsewhere.at(slice(0, N_DET), slice(0, N)).any()


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (HighpassFilter(frequency="0.5 Hz", mask=MASK), "samples to tell drifts from"),
        (CommonModeFilter(mask=MASK), "nothing is removed at about"),
    ],
)
def test_a_mask_that_leaves_little_warns(bench, step, words):
    """The share that is left is stated, to a twentieth; a small mask says nothing."""
    observation, modes = bench.observation(N_DET, N), isinstance(step, CommonModeFilter)
    observation.focalplane.xi, observation.focalplane.eta = (
        (x if modes else x / 10) for x in (observation.focalplane.xi, observation.focalplane.eta)
    )  # a field smaller than the scan: each detector leaves the mask
    away = distance(bench, observation)
    # half of the samples, or all detectors at a tenth of the instants
    radius = float(np.quantile(away.max(axis=0), 0.1) if modes else np.quantile(away, 0.5))
    wide = step.model_copy(update={"mask": SourceMask(radius=f"{radius} rad")})
    with pytest.warns(UserWarning, match=words) as found:
        wide._inside(observation)
    left = int(re.search(r"leaves about (\d+) %", str(found[0].message))[1])
    assert left == pytest.approx(100 * (away > radius).mean(), abs=4)  # 2.5 and 256 instants
    small = step.model_copy(update={"mask": SourceMask(radius="2 arcsec")})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small._inside(observation)


def source(bench, observation):
    """A Gaussian of 8.5 arcsec on the target, peak 1."""
    return np.exp(-4 * np.log(2) * (distance(bench, observation) / (8.5 * bench.ARCSEC)) ** 2)


@pytest.mark.parametrize("step", FILTERS, ids=repr)
def test_a_source_in_the_mask_keeps_its_flux(bench, step):
    """Nothing of it is outside (3 sigma of the beam and more: 1e-10): what a filter finds is zero,
    and it stays as it was.
    """
    x = source(bench, bench.observation(N_DET, N))
    x[x < 1e-9] = 0
    noise = WHITE * np.random.default_rng(1).standard_normal(x.shape)  # the modes are of something
    alone = type(step)(**{**step.model_dump(mode="json", exclude_unset=True), "mask": None})

    def left(filter):
        both, rest = (
            bench.run(
                [filter], bench.observation(N_DET, N), {"signal": y}, precision="float64"
            ).signal
            for y in (x + noise, noise)
        )
        return both - rest

    peak = x > 0.5
    masked, plain = left(step), left(alone)
    scale = 1e-6 if not isinstance(step, CommonModeFilter) or step.method == "mean" else 0.02
    # scaled modes: the rms of a filled stream; singular modes: found to 1e-6, of streams filled
    # alike
    np.testing.assert_allclose(masked[peak], x[peak], rtol=0, atol=scale)
    assert np.abs(plain[peak] - x[peak]).max() > 3 * np.abs(masked[peak] - x[peak]).max()


@pytest.mark.parametrize("step", FILTERS, ids=repr)
def test_without_a_source_it_changes_little(bench, step):
    """White noise and a common drift: the rms outside is what it is without a mask, within 4
    standard errors of independent samples; a bridge leaves more inside, by no more than a fifth,
    and before a causal filter by no more than a half."""
    rng = np.random.default_rng(2)
    x = WHITE * rng.standard_normal((N_DET, N)) + np.cumsum(rng.standard_normal(N)) * 1e-3
    x -= x.mean(axis=1, keepdims=True)
    observation = bench.observation(N_DET, N)
    alone = type(step)(**{**step.model_dump(mode="json", exclude_unset=True), "mask": None})
    one, other = (
        bench.run([s], bench.observation(N_DET, N), {"signal": x}, precision="float64").signal
        for s in (step, alone)
    )
    inside = distance(bench, observation) <= 25 * bench.ARCSEC
    ratio = {
        where: one[m].std() / other[m].std() for where, m in (("out", ~inside), ("in", inside))
    }
    assert abs(ratio["out"] - 1) < 4 / np.sqrt(2 * (~inside).sum()) + 0.02
    assert 0.9 < ratio["in"] < (1.5 if "bessel" in repr(step) else 1.2)


def test_common_mode_fills_with_the_mean_of_the_others(bench):
    """u and v of the filled matrix, subtracted from the matrix itself: by numpy."""
    rng = np.random.default_rng(3)
    observation = bench.observation(N_DET, N)
    x = np.outer(
        1 + 0.1 * rng.standard_normal(N_DET), rng.standard_normal(N)
    ) + 0.1 * rng.standard_normal((N_DET, N))
    inside = distance(bench, observation) <= 25 * bench.ARCSEC
    assert not inside.all(axis=0).any()
    filled = np.where(inside, np.nanmean(np.where(inside, np.nan, x), axis=0), x)
    u = np.linalg.svd(filled, full_matrices=False)[0][:, 0]
    found = bench.run(
        [CommonModeFilter(mask=MASK, residual=1e-10)],
        observation,
        {"signal": x},
        precision="float64",
    )
    np.testing.assert_allclose(found.signal, x - np.outer(u, u @ filled), rtol=0, atol=1e-8)
    assert (
        found.log[
            "CommonModeFilter", "instants with all detectors in the source mask: no mode removed"
        ]
        == "0"
    )
    mean = bench.run(
        [CommonModeFilter(mask=MASK, method="mean")],
        bench.observation(N_DET, N),
        {"signal": x},
        precision="float64",
    )
    np.testing.assert_allclose(
        mean.signal, x - np.nanmean(np.where(inside, np.nan, x), axis=0), rtol=0, atol=1e-12
    )


def test_a_mask_larger_than_the_scan_is_refused(bench):
    with pytest.raises(PipelineError, match="covers the whole scan"):
        bench.run(
            [HighpassFilter(mask={"radius": "1 deg"})],
            bench.observation(3, 900),
            {"signal": np.ones((3, 900))},
        )
    with pytest.raises(PipelineError, match="covers the whole scan"):
        bench.run(
            [Detrend(mask={"radius": "1 deg"})],
            bench.observation(3, 900),
            {"signal": np.ones((3, 900))},
        )
    with pytest.raises(ValueError, match="fixed on the sky"):
        SourceMask(centre="az 10 deg el 40 deg")


@pytest.mark.parametrize("more", [{}, {"scale": "rms"}, {"method": "mean"}])
def test_dead_detectors_are_found_in_spite_of_a_mask(bench, more):
    """What a mask is filled with varies; the detector does not. The others get what they get
    without the dead.
    """
    x = np.random.default_rng(1).standard_normal((N_DET, 3000))
    x[5], x[7], x[9, 100] = 0.0, 3.0, np.nan
    found = {}
    for flagged in (False, True):
        observation = bench.observation(N_DET, 3000)
        observation.detector_flags[[5, 7, 9]] = flagged
        found[flagged] = bench.run(
            [CommonModeFilter(mask=MASK, **more)], observation, {"signal": x}, precision="float64"
        ).signal
        assert np.flatnonzero(observation.detector_flags).tolist() == [5, 7, 9]
    alive = np.setdiff1d(np.arange(N_DET), [5, 7, 9])
    np.testing.assert_allclose(found[False][alive], found[True][alive], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "step", [Detrend(order=3), HighpassFilter(frequency="0.5 Hz", response="bessel")], ids=repr
)
def test_a_fit_is_no_extrapolation(bench, step):
    """A mask in which some detectors are all but a moment: unit noise about 30 K stays noise (a
    detector whose mask is not used loses its 30 K too; 12 is twice the largest of 1e5 normals and
    more). Without the rule: 7000."""
    radius = "60 arcsec"
    x = 30 + np.random.default_rng(1).standard_normal((N_DET, 3000))
    inside = (
        SourceMask(radius=radius)
        .of(bench.observation(N_DET, 3000))
        .at(slice(0, N_DET), slice(0, 3000))
    )
    assert 0 < (~inside).sum(axis=1).min() < 300
    masked = type(step)(
        **{**step.model_dump(mode="json", exclude_unset=True), "mask": {"radius": radius}}
    )
    found = bench.run(
        [masked], bench.observation(N_DET, 3000), {"signal": x}, precision="float64"
    ).signal
    assert np.abs(found).max() < 12


@pytest.mark.parametrize("step", [FILTERS[0], FILTERS[1], FILTERS[4], FILTERS[5]], ids=repr)
def test_they_keep_the_contract(step):
    zonda.testing.check_operator(
        type(step)(
            **{**step.model_dump(mode="json", exclude_unset=True), "mask": {"radius": "1 arcmin"}}
        )
    )


def image_of_discs(bench, path, centres, radius, turned=0.3):
    """A FITS image, turned on the sky, that is 1 within ``radius`` [rad] of directions ``centres``
    and 0 elsewhere; its WCS.
    """
    made = WCS(naxis=2)
    made.wcs.ctype, made.wcs.crval, made.wcs.crpix = (
        ["RA---TAN", "DEC--TAN"],
        np.degrees(bench.CENTRE),
        [150.2, 140.7],
    )
    made.wcs.cdelt, made.wcs.pc = (
        [-1 / 3600, 1 / 3600],
        [[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]],
    )
    made.wcs.set()
    ra, dec = np.radians(made.wcs_pix2world(*np.meshgrid(np.arange(300), np.arange(280)), 0))
    sky = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    cosine = np.max([np.tensordot(c, sky, 1) for c in centres], axis=0)
    fits.PrimaryHDU((cosine >= np.cos(radius)).astype(np.uint8), made.to_header()).writeto(
        path, overwrite=True
    )
    return made


def unit_vector(ra, dec):
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def test_an_image_is_looked_up_at_the_nearest_pixel(bench, tmp_path):
    """As astropy finds the pixels; where the image has the disc, the disc up to pixels of its
    edge.
    """
    observation, (ra, dec) = bench.observation(N_DET, N), bench.CENTRE
    wcs = image_of_discs(bench, tmp_path / "mask.fits", [unit_vector(ra, dec)], 25 * bench.ARCSEC)
    inside = SourceMask(file=tmp_path / "mask.fits").of(observation)
    found = inside.at(slice(0, N_DET), slice(0, N))
    looked = directions(
        observation.boresight_radec, observation.focalplane.xi, observation.focalplane.eta
    )
    lon, lat = (
        np.degrees(np.arctan2(looked[..., 1], looked[..., 0])) % 360,
        np.degrees(np.arcsin(looked[..., 2])),
    )
    x, y = wcs.wcs_world2pix(lon, lat, 0)
    near = (np.abs(x - np.floor(x) - 0.5) < 1e-6) | (
        np.abs(y - np.floor(y) - 0.5) < 1e-6
    )  # between two pixels
    on = (np.rint(x) >= 0) & (np.rint(x) < 300) & (np.rint(y) >= 0) & (np.rint(y) < 280)
    masked = fits.getdata(tmp_path / "mask.fits")
    expected = np.zeros(found.shape, bool)
    expected[on] = masked[np.rint(y[on]).astype(int), np.rint(x[on]).astype(int)] != 0
    np.testing.assert_array_equal(found[~near], expected[~near])
    edge = (
        np.abs(distance(bench, observation) - 25 * bench.ARCSEC) < np.sqrt(0.5) * bench.ARCSEC
    )  # half a pixel's diagonal
    disc = SourceMask(**MASK).of(observation).at(slice(0, N_DET), slice(0, N))
    np.testing.assert_array_equal(found[~edge], disc[~edge])
    np.testing.assert_array_equal(inside.at(slice(3, 9), slice(100, 333)), found[3:9, 100:333])
    assert counts(inside, N_DET, N) == (int(found.sum()), int(found.all(axis=0).sum()))
    assert found.any()
    assert not found.all()


@pytest.mark.parametrize("kind", [HighpassFilter, CommonModeFilter, Detrend])
def test_a_filter_takes_an_image(bench, tmp_path, kind):
    ra, dec = bench.CENTRE
    image_of_discs(
        bench,
        tmp_path / "mask.fits",
        [unit_vector(ra, dec), unit_vector(ra, dec + 40 * bench.ARCSEC)],
        10 * bench.ARCSEC,
    )
    zonda.testing.check_operator(kind(mask={"file": tmp_path / "mask.fits"}))


def test_a_file_is_resolved_and_loads_again(bench, tmp_path):
    from zonda.core.configuration.pipeline_file import parse

    image_of_discs(bench, tmp_path / "mask.fits", [unit_vector(*bench.CENTRE)], 10 * bench.ARCSEC)
    text = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
operators: [PointingDaisy, WhiteNoise, Efficiency, {HighpassFilter: {mask: {file: mask.fits}}}, BinMap, SaveMap]
"""
    file = parse(text, folder=tmp_path)
    again = parse(file.resolved_yaml())
    assert again.operators[3].mask.file == file.operators[3].mask.file == tmp_path / "mask.fits"


def test_files_that_are_no_masks(bench, tmp_path):
    observation = bench.observation(3, 100)
    image_of_discs(bench, tmp_path / "mask.fits", [unit_vector(*bench.CENTRE)], 10 * bench.ARCSEC)
    with pytest.raises(ValueError, match="give either file, an image, or radius and centre"):
        SourceMask(file=tmp_path / "mask.fits", radius="1 arcmin")
    header = fits.getheader(tmp_path / "mask.fits")
    path = tmp_path / "other.fits"
    for values, change, said in (
        (np.zeros((3, 4, 4)), {}, "has no two-dimensional image"),
        (np.full((4, 4), np.nan), {}, "has pixels that are NaN"),
        (np.zeros((4, 4)), {}, "all of its pixels are 0"),
        (np.ones((4, 4)), {"CTYPE1": "RA---SIN", "CTYPE2": "DEC--SIN"}, "is not a plain TAN"),
        (np.ones((4, 4)), {"CTYPE1": "", "CTYPE2": ""}, "needs two celestial axes"),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fits.PrimaryHDU(
                values, fits.Header({**header, "NAXIS": values.ndim, **change})
            ).writeto(path, overwrite=True)
            with pytest.raises(InputError, match=said) as caught:
                SourceMask(file=path).of(observation)
        assert str(path) in str(caught.value)
