"""TOAST's MapMaker on our scans, handed over without a file: maps of I, Q and U beside ours, and
destriped ones.

The scans are recorded ones with gaps, turnarounds, a dead and an opaque detector, opaque samples,
two bands. `.ci/toast` runs these in an environment with TOAST (the extra ``toast``), where none may
be skipped (ZONDA_TOAST=required).
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import zonda
from zonda.operators.maps.grid import HealpixGrid, Looking
from zonda.operators.maps.likelihood_scan import LikelihoodScan

from ..scenes import Marks, skip_without
from .conftest import INSTRUMENT, SCAN, SCENE

pytestmark = [
    pytest.mark.toast,
    pytest.mark.filterwarnings("ignore:Pointing", "ignore::DeprecationWarning", "ignore:SkyMap"),
]

skip_without("toast")

import astropy.units as u
import toast
import toast.ops
import toast.templates

from zonda.interop.toast import to_toast

NSIDE = 128
give_weights = LikelihoodScan.give_weights
SKY = {
    "CTYPE1": "RA---TAN",
    "CTYPE2": "DEC--TAN",
    "CUNIT1": "deg",
    "CUNIT2": "deg",
    "CDELT1": -0.05,
    "CDELT2": 0.05,
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A table of two minutes of pointing with turnarounds (flag 4) and two gaps, one of them of 3
    s.
    """
    scan = zonda.PointingBackAndForth(**SCAN | {"scan_duration": "120 s"}, flag_turnarounds=True)
    o, *_ = (
        zonda.Pipeline([scan, zonda.WhiteNoise(), zonda.Efficiency()])
        .run(zonda.Scene(**SCENE), keep=["signal"])
        .observations
    )
    time, kept = o.start.posix + o.seconds, np.ones(o.n_samples, bool)
    kept[2000:2300] = kept[7000:7060] = False
    columns = [time, np.degrees(np.unwrap(o.azimuth)), np.degrees(o.elevation), o.flags]
    path = tmp_path_factory.mktemp("recorded") / "scan.csv"
    head = "time [s], az [deg], el [deg], flags"
    np.savetxt(path, np.transpose(columns)[kept], fmt="%.9f", delimiter=",", header=head)
    return path


BINNED = zonda.BinMap(stokes="IQU", nside=NSIDE)


def run(recorded, *noise, level=1.0, maker=BINNED):
    """An extended polarized sky of 20 mK times ``level``, and noise; maps of every band."""
    y, x = np.indices((400, 400)) / 400
    values = np.array([0.02 * np.cos(9 * x + 7 * y), 0.01 * np.sin(8 * x), 0.01 * np.cos(6 * y)])
    scene = zonda.Scene(**SCENE | {"instrument": INSTRUMENT | {"detectors": 56}})
    pointing = zonda.PointingRecorded(file=recorded, split="10 s", flag_mask=15)
    o, *_ = (
        zonda.Pipeline([pointing, zonda.WhiteNoise(), zonda.Efficiency()])
        .run(scene, keep=["signal"])
        .observations
    )
    ra, dec = np.degrees(o.centre)
    header = SKY | {
        "RADESYS": "ICRS",
        "CRPIX1": 200.5,
        "CRPIX2": 200.5,
        "CRVAL1": ra,
        "CRVAL2": dec,
    }
    sky = zonda.SkyMap(
        map=values, wcs=header, unit="K_RJ", polarization_convention="cosmo", scale=level
    )
    steps = [
        pointing,
        sky,
        *noise,
        zonda.Efficiency(),
        Marks(),
        maker,
    ]
    return zonda.Pipeline(steps, precision="float64", runs={"noiseless": {"only": ["sky"]}}).run(
        scene, keep=["signal"]
    )


def theirs(data, band, *templates, mode="IQU", **how):
    """Hits (n_pix,) and I, Q, U (3, n_pix; or I alone) of a band by TOAST's MapMaker."""
    chosen = toast.Data(toast.Comm())
    chosen.obs.extend(
        to_toast(o, comm=chosen.comm) for o in data.observations if o.name.endswith(band)
    )
    pixels = toast.ops.PixelsHealpix(
        nside=NSIDE, nest=False, detector_pointing=toast.ops.PointingDetectorSimple()
    )
    weights = toast.ops.StokesWeights(mode=mode, detector_pointing=pixels.detector_pointing)
    binning = toast.ops.BinMap(
        pixel_dist="dist", pixel_pointing=pixels, stokes_weights=weights, noise_model="noise_model"
    )
    matrix = toast.ops.TemplateMatrix(templates=list(templates)) if templates else None
    toast.ops.MapMaker(
        name="maker",
        det_data="signal",
        binning=binning,
        template_matrix=matrix,
        keep_final_products=True,
        write_binmap=False,
        write_map=False,
        write_hits=False,
        write_cov=False,
        write_rcond=False,
        write_invcov=False,
        save_cleaned=False,
        map_rcond_threshold=1e-3,
        solve_rcond_threshold=1e-3,
        **{"iter_max": 15, "convergence": 1e-10} | how,
    ).apply(chosen)
    product = next(key for key in ("maker_map", "maker_binmap") if key in chosen)
    found = np.zeros((1 + len(mode), 12 * NSIDE**2))
    for name, rows in (("maker_hits", found[:1]), (product, found[1:])):
        local = chosen[name]
        size = local.distribution.n_pix_submap
        for k, submap in enumerate(local.distribution.local_submaps):
            rows[:, submap * size : (submap + 1) * size] = local.data[k].T
    return found[0], found[1:]


def planes(product):
    """I, Q, U (3, n) of our map."""
    return np.array([product.signal, product.polarization.q, product.polarization.u])


@pytest.mark.parametrize("band", ["f090", "f150"])
def test_iqu_of_scans_with_gaps(recorded, band):
    data = run(recorded, zonda.WhiteNoise())
    ours = data[f"map_{band}"]
    (o,) = (each for each in data.observations if each.name.endswith(band))
    assert o.n_samples == 12000
    assert (~o.good_samples).sum() > 360 + 37 + 2000  # gaps, opaque samples, turnarounds
    hits, maps = theirs(data, band)
    counted = np.zeros(12 * NSIDE**2)
    counted[ours.pixels] = ours.hits
    np.testing.assert_array_equal(hits, counted)
    assert hits.sum() == o.good_samples.sum() * o.good_detectors.sum()
    solved = ours.known
    assert solved.sum() > 100
    difference = np.abs(planes(ours) - maps[:, ours.pixels])[:, solved].max(axis=1)
    largest = np.abs(maps[:, ours.pixels][:, solved]).max()
    print(
        f"\nTOAST's I, Q, U minus ours, {band}: {difference} K of {largest:.1e} K in {solved.sum()}"
        " pixels"
    )
    # ours rounds cosines and weights to 2^-31, times condition numbers of some tens
    assert (difference < 1e-7 * largest).all()


def test_its_destriper_takes_1_over_f_noise_out_of_our_scans(recorded):
    """Offsets of 1 s against pink noise with a knee of 1 Hz, without a sky, whose slope within a
    pixel would count as noise. I, which many detectors average and whose large scales no crossing
    scan determines, stays as it is."""
    data = run(recorded, zonda.WhiteNoise(), zonda.PinkNoise(knee="1 Hz"), level=0.0)
    step = toast.templates.Offset(
        step_time=1 * u.s, noise_model="noise_model", use_noise_prior=False, times="times"
    )
    ours = data["map_f150"]
    (_, binned), (_, destriped) = (theirs(data, "f150", *t) for t in ((), (step,)))
    well = (ours.hits > np.median(ours.hits)) & (ours.known)
    left = [np.std(m[:, ours.pixels][:, well], axis=1) for m in (binned, destriped)]
    print(f"\nrms of I, Q, U: binned {left[0]} K, destriped {left[1]} K")
    assert left[1][1] < 0.8 * left[0][1]
    assert left[1][2] < 0.95 * left[0][2]
    assert left[1][0] < 1.1 * left[0][0]


def without_a_prior(scan, *arguments):
    """Weights of a scan whose baselines have no prior, of equal detectors."""
    noise = scan.noise
    own, white = np.full_like(noise.own, 1e30), np.full_like(noise.white, np.median(noise.white))
    scan.noise = replace(noise, white=white, own=own)
    give_weights(scan, *arguments)


def parts(observation, grid, length):
    """(n_pixels,) the part of the map that each pixel is in: no baseline leads from one to
    another, so that the mean of each is not determined.
    """
    good, n = np.flatnonzero(observation.good_detectors), observation.n_samples
    pixels = Looking.of(observation, grid).pixels(good, 0, n)[:, observation.good_samples]
    number = -(-n // length) * np.arange(len(good))[:, None] + np.arange(n) // length
    places = pixels, grid.n_pixels + number[:, observation.good_samples]
    size = grid.n_pixels + number.max() + 1
    ones = np.ones(pixels.size)
    graph = coo_array((ones, [place.ravel() for place in places]), (size, size))
    return connected_components(graph, directed=False)[1][: grid.n_pixels]


def test_a_destriped_map_is_that_of_its_offsets(recorded, monkeypatch):
    """Baselines of 1 s in the same samples, some of them flagged in part, without a prior of their
    amplitudes, in either; gaps of 3 s and less."""
    monkeypatch.setattr(LikelihoodScan, "give_weights", without_a_prior)
    maker = zonda.MaximumLikelihoodMap(
        nside=NSIDE,
        modes=0,
        free=0,
        trend=0,
        refine=0,
        baseline="1 s",
        tolerance=1e-8,
        undetermined="none",
        half_difference=False,
    )
    data = run(recorded, zonda.WhiteNoise(), zonda.PinkNoise(knee="1 Hz"), maker=maker)
    ours = data["map_f150"]
    step = toast.templates.Offset(
        step_time=1 * u.s, noise_model="noise_model", times="times", good_fraction=0.0
    )
    # MapMaker compares squares
    hits, maps = theirs(data, "f150", step, mode="I", iter_max=300, convergence=1e-16)
    np.testing.assert_array_equal(hits[ours.pixels], ours.hits)
    (o,) = (each for each in data.observations if each.name.endswith("f150"))
    part = parts(o, HealpixGrid(NSIDE, False, ours.pixels), 100)
    difference = ours.signal - maps[0, ours.pixels]
    for k in np.unique(part):
        difference[part == k] -= np.average(difference[part == k], weights=ours.hits[part == k])
    ratio = difference / ours.noise
    print(f"\nTOAST's offsets minus ours: rms {np.std(ratio):.1e}, at most {abs(ratio).max():.1e}")
    assert len(np.unique(part)) < 10 < len(part)
    # residuals of 1e-8 of the right side (50 in units of noise), over Ritz values down to 0.006:
    # 1e-4 of the noise of the map
    assert (np.abs(ratio) < 1e-4).all()
    binned = theirs(data, "f150", mode="I")[1][0, ours.pixels]
    assert np.std((binned - maps[0, ours.pixels]) / ours.noise) > 1  # offsets were there
