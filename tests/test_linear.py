"""`zonda.linear`: exact adjoints, and the maps and equations of the map makers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import zonda
import zonda.linear
from zonda.core.data import Data
from zonda.core.errors import ZondaError
from zonda.core.flags import INVALID, TURNAROUND
from zonda.plugins.checks.scenes import run, scan, scene

N_DET, N = 37, 3000
POLARIZED = np.resize(np.radians([0, 90, 45, 135]), N_DET)


def observation(samples=N, flagged=True, plate=False):
    """Circles of 3 arcmin, with gaps, a turnaround and two dead detectors."""
    o = scan(N_DET, samples, radius=3.0)
    o.focalplane.polarization_angle[:] = POLARIZED
    o.focalplane.polarization_efficiency[:] = np.linspace(0.8, 1, N_DET)
    o.focalplane.net[:] = np.linspace(1e-3, 2e-3, N_DET)
    if flagged:
        o.flags[[0, 1, 700, 701, 702, samples - 1]] = INVALID
        o.flags[1500:1600] = TURNAROUND
        o.detector_flags[[3, 20]] = 1
    if plate:
        o.hwp_angle = 11.0 * o.seconds
    return o


def pointed(o):
    return Data(scene(o.instrument), [o])


def grid_of(o, **how):
    return zonda.linear.grid(pointed(o), zonda.BinMap(**how))


def dot_test(A, seed=0):
    """|<x, A y> - <A^T x, y>| over |x| |A y|: rounding of sums of 1e5 terms."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=A.shape[0]), rng.normal(size=A.shape[1])
    seen = A.matvec(y)
    error = abs(x @ seen - A.rmatvec(x) @ y)
    assert np.linalg.norm(seen) > 0
    assert error <= 1e-12 * np.linalg.norm(x) * np.linalg.norm(seen)


GRIDS = {
    "TAN": {"pixel": "10 arcsec"},
    "TAN, samples outside": {"pixel": "10 arcsec", "width": "4 arcmin"},
    "CAR": {"pixel": "10 arcsec", "projection": "CAR", "frame": "galactic"},
    "HEALPix": {"nside": 8192},
    "HEALPix, nested": {"nside": 8192, "ordering": "nested", "frame": "galactic"},
}


@pytest.mark.parametrize("stokes", ["I", "IQU"])
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
@pytest.mark.parametrize("grid", GRIDS)
def test_the_transpose_of_pointing(grid, interpolation, stokes):
    o = observation()
    P = zonda.linear.pointing(o, grid_of(o, **GRIDS[grid]), interpolation, stokes)
    dot_test(P)
    if interpolation == "nearest":
        dot_test(zonda.linear.binning(P))
    seen = P.matvec(np.repeat([1.0, 0.0, 0.0], P.grid.n_pixels)[: P.shape[1]]).reshape(N_DET, N)
    assert not seen[[3, 20]].any()  # no signal
    assert not seen[:, 700:703].any()
    used = seen[seen != 0]
    assert used == pytest.approx(1, abs=1e-12)  # of a constant sky
    share = used.size / seen.size
    assert 0.1 < share < 0.9 if "outside" in grid else share > 0.94


@settings(max_examples=20, deadline=None)
@given(
    samples=st.integers(1, 200),
    gaps=st.lists(st.integers(0, 199), max_size=5),
    width=st.floats(1, 9),
    bilinear=st.booleans(),
    polarized=st.booleans(),
)
def test_pointing_of_any_scan_and_width(samples, gaps, width, bilinear, polarized):
    """The transpose, also where nothing is seen; no sample sees more than one pixel's worth."""
    o = observation(samples, flagged=False)
    o.flags[[gap % samples for gap in gaps]] = INVALID
    g = zonda.linear.grid(pointed(o), zonda.BinMap(pixel="20 arcsec", width=f"{width} arcmin"))
    how = ("bilinear" if bilinear else "nearest"), ("IQU" if polarized else "I")
    P, rng = zonda.linear.pointing(o, g, *how), np.random.default_rng(samples)
    m, d = rng.normal(size=P.shape[1]), rng.normal(size=P.shape[0])
    size = np.linalg.norm(d) * np.linalg.norm(m) * np.sqrt(P.shape[0])
    assert abs(d @ P.matvec(m) - P.rmatvec(d) @ m) <= 1e-13 * size
    sums = P.matvec(np.ones(P.shape[1]) * (np.arange(P.shape[1]) < g.n_pixels))
    assert np.abs(sums[sums != 0] - 1).max(initial=0) < 1e-12


@pytest.mark.parametrize("grid", ["TAN", "CAR", "HEALPix"])
def test_bilinear_pointing_sees_a_plane_as_it_is(grid):
    """Of functions that are linear in the coordinates of the pixels; nearest is off by up to half a
    pixel. HEALPix interpolates along rings, whose pixels are shifted."""
    o = observation(300, flagged=False)
    g = grid_of(o, **GRIDS[grid])
    dec = o.detector_positions()[1]
    if grid == "HEALPix":
        import healpy

        plane = np.pi / 2 - healpy.pix2ang(g.nside, g.pixels_covered)[0]
    elif grid == "CAR":
        g = grid_of(o, pixel="10 arcsec", projection="CAR")
        plane = np.radians(g.wcs.pixel_to_world_values(0, np.arange(g.shape[0]))[1])
        plane = np.repeat(plane, g.shape[1])
    else:
        rows = np.indices(g.shape)[0].ravel()
        y = g.wcs.world_to_pixel_values(*np.degrees(o.detector_positions()))[1]
        plane, dec = rows.astype(float), y
    seen = zonda.linear.pointing(o, g, "bilinear").matvec(plane).reshape(dec.shape)
    inside = seen != 0
    assert inside.mean() > 0.9
    # z, not the latitude, is linear between HEALPix rings: (30 arcsec)^2 / 8 tan(20 deg)
    np.testing.assert_allclose(seen[inside], dec[inside], rtol=1e-8, atol=0)


@pytest.mark.parametrize("how", [{}, {"crop": True}, {"stokes": "IQU", "plate": True}])
@pytest.mark.parametrize("grid", ["TAN", "CAR", "HEALPix"])
def test_binning_is_the_map_of_bin_map(grid, how):
    stokes, plate = how.get("stokes", "I"), how.get("plate", False)
    o = observation(plate=plate)
    rng = np.random.default_rng(2)
    signal = rng.normal(size=(N_DET, N))
    signal[3, 5] = np.nan  # of a dead detector
    asked = zonda.BinMap(stokes=stokes, **GRIDS["TAN, samples outside" if "crop" in how else grid])
    data = run([asked], o, signal, keep=("signal",))
    found = data["map"]
    P = zonda.linear.pointing(data.observations[0], zonda.linear.grid(data, asked), stokes=stokes)
    m = zonda.linear.binning(P).matvec(data.tod().ravel()).reshape(3 if plate else 1, -1)
    values = np.asarray(found.planes["signal"].values).reshape(len(m), -1)
    if grid == "HEALPix" and "crop" not in how:
        m = m[:, np.isin(P.grid.pixels_covered, found.pixels)]
    known = np.isfinite(values[0])
    # terms are rounded to 2^-37 K and 2^-31 of a weight, of signals up to 5 K; condition <= 100
    np.testing.assert_allclose(m[:, known], values[:, known], atol=1e-6 if plate else 1e-8)
    assert known.sum() > 100


def test_binning_with_a_window_and_with_weights():
    o, rng = observation(), np.random.default_rng(3)
    signal = rng.normal(size=(N_DET, N))
    asked = zonda.BinMap(pixel="10 arcsec")
    data = run([zonda.Taper(share="30 %"), asked], o, signal, keep=("signal",))
    P = zonda.linear.pointing(data.observations[0], zonda.linear.grid(data, asked))
    values = data["map"].signal.ravel()
    m = zonda.linear.binning(P).matvec(data.tod().ravel())
    known = np.isfinite(values)
    np.testing.assert_allclose(m[known], values[known], atol=1e-8)
    dot_test(zonda.linear.binning(P))
    o = observation()
    P = zonda.linear.pointing(o, P.grid)
    w = rng.uniform(0, 2, (N_DET, N))
    m = zonda.linear.binning(P, w).matvec(signal.ravel())
    use = np.where(o.good_detectors[:, None] & o.good_samples, w, 0.0).ravel()
    with np.errstate(invalid="ignore"):
        mean = P.rmatvec(use * signal.ravel()) / P.rmatvec(use)
    known = np.isfinite(mean)
    np.testing.assert_allclose(m[known], mean[known], atol=1e-12)


DISC = {"radius": "2 arcmin"}
FILTERS = {
    "brick wall": [zonda.HighpassFilter(frequency="1 Hz")],
    "brick wall, many cosines": [zonda.HighpassFilter(frequency="4 Hz")],
    "brick wall, DCT": [zonda.HighpassFilter(frequency="10 Hz", degree=2)],
    "shorter than a cycle": [zonda.HighpassFilter(frequency="10 mHz")],
    "brick wall, mask": [zonda.HighpassFilter(frequency="1 Hz", mask=DISC, trim="2 s")],
    "bessel": [zonda.HighpassFilter(frequency="1 Hz", response="bessel", degree=None)],
    "bessel, mask": [zonda.HighpassFilter(frequency="1 Hz", response="bessel", mask=DISC)],
    "line": [zonda.Detrend()],
    "line, mask": [zonda.Detrend(order=3, mask=DISC)],
    "splines": [zonda.Despline(knots="2 s")],
    "many splines": [zonda.Despline(knots="200 ms")],
    "polynomials": [zonda.PolynomialFilter(order=4)],
    "polynomials of parts": [zonda.PolynomialFilter(interval="scanning", mask=DISC)],
    "ground": [zonda.GroundFilter(bin="2 arcmin", trend=2)],
    "window": [zonda.Taper()],
    "mode": [zonda.CommonModeFilter()],
    "modes, scaled, mask": [zonda.CommonModeFilter(modes=3, scale="rms", mask=DISC)],
    "mean, mask": [zonda.CommonModeFilter(method="mean", mask=DISC)],
    "of wafers": [zonda.CommonModeFilter(modes=2, group="wafer", scale="rms")],
    "several": [
        zonda.Detrend(),
        zonda.Taper(),
        zonda.CommonModeFilter(modes=2),
        zonda.HighpassFilter(frequency="0.5 Hz"),
        zonda.CommonModeFilter(method="mean"),
    ],
}


def stream(o, seed=4):
    """Drifts that all see, and noise."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(size=o.n_samples))
    return np.outer(rng.uniform(0.5, 1.5, N_DET), walk) + rng.normal(size=(N_DET, o.n_samples))


def parts(o):
    """Three intervals, with gaps before, between and behind."""
    o.intervals["scanning"] = [tuple(o.seconds[[a, b]]) for a, b in PARTS * o.n_samples // N]
    o.focalplane.wafer[:] = np.arange(N_DET) % 2
    return o


PARTS = np.array([(100, 900), (950, 1800), (1810, 2500)])


@pytest.mark.parametrize("name", FILTERS)
def test_filters_are_those_of_a_run_and_their_transpose_is_exact(name):
    o = parts(observation())
    d = stream(o)
    expected = run([*FILTERS[name]], parts(observation()), d, keep=("signal",))
    models = zonda.linear.modes(FILTERS[name], o, d)
    F = zonda.linear.filters(FILTERS[name], o, models)
    made = F.matvec(d.ravel()).reshape(d.shape)
    good = expected.observations[0].good_detectors
    # float64, of drifts up to 100
    np.testing.assert_allclose(made[good], expected.tod()[good], atol=1e-10)
    dot_test(F)
    assert not (o.flags & 128).any()  # the scan is not touched


def test_given_modes_are_projected_out():
    o, rng = observation(), np.random.default_rng(6)
    good, n = np.flatnonzero(o.good_detectors), np.flatnonzero(o.good_samples)
    U = np.zeros((2, N_DET))
    U[:, good] = np.linalg.qr(rng.normal(size=(good.size, 2)))[0].T
    F = zonda.linear.filters([zonda.CommonModeFilter(modes=2)], o, U)
    d = rng.normal(size=(N_DET, N))
    expected = d.copy()
    expected[:, n] -= U.T @ (U @ d[:, n])
    np.testing.assert_allclose(F.matvec(d.ravel()).reshape(d.shape), expected, atol=1e-12)
    dot_test(F)


@settings(max_examples=15, deadline=None)
@given(
    order=st.integers(0, 4),
    seed=st.integers(0, 1000),
    gaps=st.lists(st.integers(0, 299), max_size=8),
)
def test_filters_with_any_gaps_have_exact_transposes(order, seed, gaps):
    o = parts(observation(300, flagged=False))
    o.flags[gaps] = INVALID
    steps = [
        zonda.PolynomialFilter(order=order, interval="scanning"),
        zonda.HighpassFilter(frequency="2 Hz"),
        zonda.GroundFilter(bin="2 arcmin", trend=order),
    ]
    dot_test(zonda.linear.filters(steps, o), seed)


def test_what_is_not_exact_is_refused():
    o = observation()

    class Mine(zonda.Detrend):
        """Another detrending."""

        def exec(self, block, state):
            block.detdata["signal"] *= 2

    double = zonda.operator(lambda block: 2 * block.detdata["signal"], name="double", linear=True)
    for step in (Mine(), double):
        with pytest.raises(ZondaError, match="no exact adjoint"):
            zonda.linear.filters([step], o)

    class Gain(zonda.Operator):
        """A gain that falls, with its transpose."""

        requires = provides = frozenset({"signal"})

        def exec(self, block, state):
            block.detdata["signal"] *= np.exp(-block.observation.seconds[block.samples])

        def adjoint(self, block, state):
            self.exec(block, state)

    dot_test(zonda.linear.filters([Gain(), zonda.Detrend()], o))
    common = zonda.CommonModeFilter()
    with pytest.raises(ZondaError, match="modes"):
        zonda.linear.filters([common], o)
    with pytest.raises(ZondaError, match="modes of shape"):
        zonda.linear.filters([common], o, np.ones((1, 3)))
    of_wafers, of_mean = (
        zonda.CommonModeFilter(**how) for how in ({"group": "wafer"}, {"method": "mean"})
    )
    for steps in ([common, common], [of_wafers], [of_mean], [zonda.Detrend()]):
        with pytest.raises(ZondaError, match="one CommonModeFilter"):
            zonda.linear.filters(steps, o, np.ones((1, N_DET)))
    with pytest.raises(ZondaError, match="not an operator"):
        zonda.linear.filters([None], o)
    with pytest.raises(ZondaError, match="12 samples"):
        zonda.linear.modes([common], o, np.ones((3, 4)))
    grid = grid_of(o, pixel="10 arcsec")
    with pytest.raises(ZondaError, match="'cubic'"):
        zonda.linear.pointing(o, grid, "cubic")
    with pytest.raises(ZondaError, match="bilinear"):
        zonda.linear.binning(zonda.linear.pointing(o, grid, "bilinear"))
    with pytest.raises(ZondaError, match="weights"):
        zonda.linear.binning(zonda.linear.pointing(o, grid), np.ones(3))


@pytest.mark.parametrize(("plate", "gaps"), [(False, False), (True, False), (True, True)])
def test_normal_equations_are_those_of_the_pointing_and_the_noise(plate, gaps):
    """P^T Q P and P^T Q d, of one scan; their solution is the map of `MaximumLikelihoodMap`."""
    o, rng = observation(plate=plate), np.random.default_rng(7)
    signal = 1e-3 * stream(o) + 1e-3 * rng.normal(size=(N_DET, N))
    if gaps:
        signal[::2, 300:420] = signal[1, 700:705] = np.nan
    maker = zonda.MaximumLikelihoodMap(
        pixel="20 arcsec",
        stokes="IQU" if plate else "I",
        half_difference=False,
        tolerance=1e-8,
        undetermined="none",
    )
    data = run([maker], o, signal, keep=("signal",))
    scans, noise, right = zonda.linear.compressed(data, maker)
    A = zonda.linear.normal(scans, noise)
    if not gaps:  # their values are found by iterations, to 1e-10
        dot_test(A)
    grid, stokes = zonda.linear.grid(data, maker), "IQU" if plate else "I"
    P = zonda.linear.pointing(data.observations[0], grid, stokes=stokes)
    Q = zonda.linear.noise_weight(scans[0], noise[0], data.observations[0])
    if not gaps:
        dot_test(Q)
    m = rng.normal(size=A.shape[1])
    # with a plate a run is a sample, whose angle is that of the sample
    expected = A.matvec(m)
    made = (P.T @ Q @ P).matvec(m)
    rounding = 1e-8 if gaps else 1e-10
    np.testing.assert_allclose(made, expected, atol=rounding * np.abs(expected).max())
    made = (P.T @ Q).matvec(data.tod().ravel())
    np.testing.assert_allclose(made, right, atol=1e-7 * np.abs(right).max())
    solved = data["map"].planes["signal"].values.reshape(-1, grid.n_pixels)
    known = np.isfinite(solved[0])
    rest = right - A.matvec(np.nan_to_num(solved).ravel())
    rest = rest.reshape(solved.shape)[:, known]
    assert np.abs(rest).max() < 1e-5 * np.abs(right).max()
    few = zonda.linear.noise_weight(scans[0], noise[0])
    good = data.observations[0].good_detectors
    d = rng.normal(size=(N_DET, N))
    same = few.matvec(d[good].ravel()).reshape(-1, N)
    np.testing.assert_array_equal(Q.matvec(d.ravel()).reshape(N_DET, N)[good], same)
    with pytest.raises(ZondaError, match="detectors"):
        zonda.linear.noise_weight(scans[0], noise[0], observation(2000))


def test_several_bands_and_scans():
    """Each band has its own streams, pixels and equations; scans are added up."""
    bands = [
        {"name": "f090", "low": "77 GHz", "high": "106 GHz", "net": "300 uK s(1/2)"},
        {"name": "f150", "low": "130 GHz", "high": "170 GHz", "net": "360 uK s(1/2)"},
    ]
    telescope = {"name": "dish", "diameter": "50 m"}
    both = {"field_of_view": "3 arcmin", "detectors": 7, "sample_rate": "20 Hz", "bands": bands}
    efficiency = dict.fromkeys(["main_beam_efficiency", "illumination_efficiency"], 0.8)
    camera = zonda.Instrument(name="camera", telescope=telescope, **both, **efficiency)
    night = zonda.Scene(
        site="green_bank", instrument=camera, time="2024-11-25T07:00", target="05h +20d", seed=1
    )
    maker = zonda.MaximumLikelihoodMap(
        pixel="15 arcsec", baseline="0.5 s", half_difference=False, undetermined="none"
    )
    steps = [
        zonda.PointingDaisy(radius="1 arcmin", scan_duration="20 s", scans=2),
        zonda.AtmosphereLayers(pwv="2 mm"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        maker,
    ]
    data = zonda.Pipeline(steps).run(night, keep=["signal"], threads=1)
    scans, noise, right = zonda.linear.compressed(data, maker, "f150")
    own, grid = data.bands["f150"].observations, zonda.linear.grid(data, maker, "f150")
    m = np.random.default_rng(8).normal(size=grid.n_pixels)
    seen, total = np.zeros((2, grid.n_pixels))
    for o, *weighed in zip(own, scans, noise, strict=True):
        P, Q = zonda.linear.pointing(o, grid), zonda.linear.noise_weight(*weighed, o)
        seen += (P.T @ Q @ P).matvec(m)
        total += (P.T @ Q).matvec(data.tod("signal", o.name).ravel())
    applied = zonda.linear.normal(scans, noise, threads=2).matvec(m)
    assert np.abs(seen - applied).max() < 1e-10 * np.abs(applied).max()
    assert np.abs(total - right).max() < 1e-7 * np.abs(right).max()  # rounding of the sums
    with pytest.raises(ZondaError, match="all bands"):
        zonda.linear.filters([zonda.CommonModeFilter(group="all")], own[0], {})
    for band in ("", "f220"):
        with pytest.raises(ZondaError, match="band"):
            zonda.linear.grid(data, maker, band)
        with pytest.raises(ZondaError, match="band"):
            zonda.linear.compressed(data, maker, band)
