"""How scans cross in pixels, and the hits of each scan: known geometries, TOAST's arithmetic, exact
sums, files.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from astropy.io import fits

import zonda
from zonda.core.errors import InputError, PipelineError
from zonda.core.numerics.projection import directions
from zonda.operators.maps import coverage
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.maps.map_sums import MapSums

GRIDS = [{"pixel": "10 arcsec"}, {"pixel": "10 arcsec", "projection": "CAR"}, {"nside": 16384}]
LATITUDE, ELEVATION = math.radians(-23.0), math.radians(50.0)


def along(bench, angle, index=0, n_det=7, n=2001):
    """A scan along a line through the centre, ``angle`` [rad] from east to north."""
    observation = bench.observation(n_det, n, index=index)
    s = 90 * bench.ARCSEC * np.sin(np.linspace(0, 20, n))
    lat = bench.CENTRE[1] + s * math.sin(angle)
    observation.boresight_radec = bench.quaternions(
        bench.CENTRE[0] + s * math.cos(angle) / np.cos(lat), lat, 0.3
    )
    return observation


def zeros(observation):
    return np.zeros((observation.n_detectors, observation.n_samples))


def made(bench, observations, **parameters):
    how = {} if {"nside", "pixel"} & parameters.keys() else {"pixel": "10 arcsec"}
    step = BinMap(**{"crosslinking": True, "scan_hits": True, **how, **parameters})
    return bench.run([step], observations, {"signal": zeros}).map


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi / 2, 2.5])
def test_one_direction_is_one(bench, grid, angle):
    """The parallels converge by 3e-4 rad within the field: exp(2 i psi) turns by no more."""
    product = made(bench, along(bench, angle), **grid)
    hit = product.hits > 0
    assert product.crosslinking[hit].min() > 1 - 1e-6
    assert np.isnan(product.crosslinking[~hit]).all()
    mean = product.directions[:, hit]
    np.testing.assert_allclose(
        mean, np.broadcast_to([[math.cos(2 * angle)], [math.sin(2 * angle)]], mean.shape), atol=1e-3
    )


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("between", [0.2, math.pi / 4, 1.0, math.pi / 2])
def test_two_directions_that_enclose_an_angle(bench, grid, between):
    """|a + b exp(2 i delta)| / (a + b) of a and b samples; |cos delta| of as many of either."""
    both = [along(bench, 0.4, 0), along(bench, 0.4 + between, 1)]
    product = made(bench, both, **grid)
    a, b = product.hits_of(0), product.hits_of(1)
    crossed = (a > 0) & (b > 0)
    assert crossed.sum() > 3
    expected = abs(a + b * np.exp(2j * between))[crossed] / (a + b)[crossed]
    np.testing.assert_allclose(product.crosslinking[crossed], expected, atol=1e-3)
    alike = a[crossed] == b[crossed]
    np.testing.assert_allclose(
        product.crosslinking[crossed][alike], abs(math.cos(between)), atol=1e-3
    )


def test_eight_directions_evenly_around_are_zero(bench):
    product = made(
        bench,
        [along(bench, k * math.pi / 8, k) for k in range(8)],
        pixel="20 arcsec",
        width="20 arcsec",
    )
    counts = np.array([product.hits_of(k)[0, 0] for k in range(8)])
    left = (
        abs((counts * np.exp(2j * np.pi * np.arange(8) / 8)).sum()) / counts.sum()
    )  # numbers differ a little
    assert left < 0.1
    assert product.crosslinking[0, 0] == pytest.approx(left, abs=1e-3)


def test_daisy_crosses_evenly_in_the_middle_and_a_line_does_not():
    """95 passes (speed times time over pi radius) in directions that are evenly spread but for the
    last petals: far below 1 / sqrt(95), which random directions leave. A line across it: 1 but for
    the turning of the field in 20 s."""
    camera = zonda.Instrument(
        name="c",
        telescope=zonda.Telescope(name="dish", diameter="100 m"),
        detectors=1,
        field_of_view="1 arcsec",
        fwhm="9 arcsec",
        band=zonda.Band(name="b", low="80 GHz", high="100 GHz"),
        net="1 mK s(1/2)",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        sample_rate="50 Hz",
    )
    scene = zonda.Scene(
        site="green_bank", instrument=camera, time="2024-11-25T07:00", target="05h +20d", seed=3
    )
    found = {}
    daisy = zonda.PointingDaisy(
        scan_duration="10 min", offsets="none", radius="2 arcmin", speed="60 arcsec/s"
    )
    for pointing in (daisy, zonda.PointingBackAndForth(scan_duration="20 s")):
        steps = [
            pointing,
            zonda.BinMap(pixel="40 arcsec", width="2 arcmin", contents="hits", crosslinking=True),
        ]
        found[type(pointing).__name__] = zonda.Pipeline(steps).run(scene)["map"].crosslinking
    assert found["PointingDaisy"][1, 1] < 0.3 / math.sqrt(95)
    assert np.nanmin(found["PointingBackAndForth"]) > 0.99


def mount(bench, azimuth, start, index):
    """A scan of the mount to and fro at `ELEVATION` about ``azimuth`` [rad]; ``start``: local
    sidereal time [rad].
    """
    observation = bench.observation(1, 6001, index=index)
    az = azimuth + math.radians(0.5) * np.sin(2 * np.pi * observation.seconds / 4.0)
    dec = np.arcsin(
        math.sin(LATITUDE) * math.sin(ELEVATION)
        + math.cos(LATITUDE) * math.cos(ELEVATION) * np.cos(az)
    )
    east = -np.sin(az) * math.cos(ELEVATION)
    north = math.cos(LATITUDE) * math.sin(ELEVATION) - math.sin(LATITUDE) * math.cos(
        ELEVATION
    ) * np.cos(az)
    hour = np.arctan2(east, north)
    lst = start + 7.292e-5 * observation.seconds
    observation.boresight_radec = bench.quaternions(lst - hour, dec, 0.0)
    return observation, float(hour[0]), float(dec[0])


@pytest.mark.parametrize("azimuth", [60.0, 100.0, 130.0])
def test_rising_and_setting_at_one_elevation(bench, azimuth):
    """The horizon is at the parallactic angle q from the parallel, -q when it rises and q when it
    sets: |cos 2q|.

    15 arcsec/s of sky beside 0.5 deg/s of scan change either direction by some 0.01 rad, to and fro
    alike but for second order; within 6 arcmin q changes by less than 3e-3.
    """
    east, hour, dec = mount(bench, math.radians(azimuth), 0.0, 0)
    _, late, _ = mount(bench, math.radians(-azimuth), 0.0, 1)
    west, _, _ = mount(bench, math.radians(-azimuth), late - hour, 1)
    for observation in (east, west):
        observation.centre = (-hour % (2 * math.pi), dec)
    product = made(bench, [east, west], pixel="3 arcmin")
    both = (
        (product.hits_of(0) > 0)
        & (product.hits_of(1) > 0)
        & (product.distance() < math.radians(0.1))
    )
    assert both.sum() >= 2
    a, b = product.hits_of(0)[both], product.hits_of(1)[both]
    q = math.asin(math.sin(math.radians(azimuth)) * math.cos(LATITUDE) / math.cos(dec))
    q = (
        math.pi - q
        if math.sin(LATITUDE) < math.sin(dec) * math.sin(ELEVATION) and dec < LATITUDE
        else q
    )
    expected = abs(a * np.exp(2j * q) + b * np.exp(-2j * q)) / (a + b)
    np.testing.assert_allclose(product.crosslinking[both], expected, atol=0.012)


def toast_directions(observation):
    """(n_det, n) angle of motion as TOAST's `CrossLinking` finds it: arctan of half differences in
    latitude and longitude.
    """
    d = directions(
        observation.boresight_radec, observation.focalplane.xi, observation.focalplane.eta
    )
    lon, lat = np.unwrap(np.arctan2(d[..., 1], d[..., 0])), np.arcsin(d[..., 2])
    return np.arctan2(np.gradient(lat, axis=-1), np.gradient(lon, axis=-1) * np.cos(lat))


def test_toasts_angles_of_detectors_that_also_turn(bench):
    """One pixel for all: means of cosine and sine. Angles instead of vectors: second order in 1e-5
    rad a sample.
    """
    observation = bench.observation(19, 3000)
    observation.boresight_radec = bench.quaternions(
        bench.CENTRE[0] + 3e-4 * np.sin(observation.seconds),
        bench.CENTRE[1] + 2e-4 * np.sin(1.7 * observation.seconds),
        0.3 * observation.seconds,
    )
    product = made(bench, observation, pixel="20 arcmin", width="20 arcmin")
    angle = toast_directions(observation)
    expected = [np.cos(2 * angle).mean(), np.sin(2 * angle).mean()]
    np.testing.assert_allclose(product.directions[:, 0, 0], expected, atol=2e-4)


def test_frames_turn_the_angle_and_not_its_size(bench):
    sizes, angles = [], []
    for frame in ("icrs", "galactic"):
        both = [along(bench, 0.4, 0), along(bench, 1.1, 1)]
        product = made(bench, both, pixel="20 arcmin", width="20 arcmin", frame=frame)
        sizes.append(product.crosslinking[0, 0])
        angles.append(math.atan2(*product.directions[::-1, 0, 0]))
    assert sizes[0] == pytest.approx(sizes[1], abs=1e-5)  # parallels converge by 3e-4 rad
    assert abs(angles[0] - angles[1]) > 0.1


def test_detectors_that_do_not_move_and_samples_that_do_not_count(bench):
    """A stare on the sky has no direction; flagged and not finite samples and dead detectors are
    left out.
    """
    still = along(bench, 0.3)
    still.boresight_radec[:] = still.boresight_radec[0]
    product = made(bench, still)
    assert product.hits.sum() == still.n_detectors * still.n_samples
    assert np.isnan(product.crosslinking).all()

    observation = along(bench, 0.0)
    half = observation.n_samples // 2
    turned = along(bench, 1.0)
    observation.boresight_radec[half:] = turned.boresight_radec[half:]
    observation.flags[half - 1 :] = 1  # with the jump
    product = made(bench, observation)
    assert product.crosslinking[product.hits > 0].min() > 1 - 1e-6

    spoiled = zeros(observation)
    spoiled[:, half - 1 :] = np.nan
    observation.flags[:] = 0
    product = bench.run(
        [BinMap(pixel="10 arcsec", crosslinking=True)], observation, {"signal": spoiled}
    ).map
    assert product.crosslinking[product.hits > 0].min() > 1 - 1e-6


@pytest.mark.parametrize("grid", GRIDS)
def test_the_map_keeps_its_bits_and_no_signal_is_needed(bench, grid):
    many = [bench.observation(7, 3000, index=i) for i in range(3)]

    def noise(observation):
        return np.random.default_rng(observation.index).normal(size=(7, 3000))

    plain, more, threads, small = (
        bench.run([BinMap(**grid, **options)], many, {"signal": noise}, **how).map
        for options, how in (
            ({}, {}),
            ({"crosslinking": True, "scan_hits": True}, {}),
            ({"crosslinking": True}, {"threads": 2}),
            ({"crosslinking": True}, {"memory": 6_000_000}),
        )
    )
    for plane in ("signal", "hits", "weights", "noise", "half_difference"):
        np.testing.assert_array_equal(getattr(plain, plane), getattr(more, plane))
    assert plain.directions is None
    assert plain.crosslinking is None
    for other in (threads, small):
        np.testing.assert_array_equal(more.directions, other.directions)
    hits = made(bench, many, **grid, contents="hits")
    np.testing.assert_array_equal(hits.directions, more.directions)


def test_sums_cross_processes_exactly(bench):
    """Of one scan after the other, each written and read between."""
    many = [bench.observation(7, 3000, index=i) for i in range(3)]
    kept = []

    def keep(self, data):
        kept.append(data.take(self.label))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BinMap, "finalize", keep)
        for some in (many, many[:1], many[1:]):
            step = BinMap(pixel="10 arcsec", width="4 arcmin", crosslinking=True, scan_hits=True)
            bench.run([step], some, {"signal": zeros})
    whole, one, rest = kept
    one = MapSums.of(one.arrays())
    one += MapSums.of(rest.arrays())
    np.testing.assert_array_equal(
        one.coverage.sums["crosslinking"], whole.coverage.sums["crosslinking"]
    )
    assert len(one.coverage.hits) == 3
    for k in range(3):
        np.testing.assert_array_equal(one.coverage.pixels[k], whole.coverage.pixels[k])
        np.testing.assert_array_equal(one.coverage.hits[k], whole.coverage.hits[k])


@pytest.mark.parametrize("grid", GRIDS)
def test_hits_of_scans_are_those_of_each_alone(bench, grid):
    many = [bench.observation(7, 3000, index=i) for i in range(3)]
    many[1].flags[:1000] = 1
    product = made(bench, many, **grid)
    planes = [product.hits_of(f"scan{i}") for i in range(3)]
    np.testing.assert_array_equal(sum(planes), product.hits)
    assert [plane.sum() for plane in planes] == [21000, 14000, 21000]
    alone = made(bench, many[1], **grid)
    assert sorted(alone.hits[alone.hits > 0]) == sorted(planes[1][planes[1] > 0])
    assert product.hits_of(2).shape == product.signal.shape
    for scan in ("scan7", 3, -1):
        with pytest.raises(InputError, match=r"scan7|number"):
            product.hits_of(scan)
    with pytest.raises(InputError, match="not kept"):
        made(bench, many, **grid, scan_hits=False).hits_of(0)


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("stokes", ["I", "hits"])
def test_visits_are_the_scans_that_have_samples_in_a_pixel(bench, grid, stokes, tmp_path):
    """Of scans along different lines, one of them for the most part flagged; files, pictures and
    other units have the plane as it is.
    """
    many = [along(bench, 0.4 * k, k) for k in range(4)]
    many[1].flags[:1900] = 1
    how = {"contents": "hits"} if stokes == "hits" else {}
    product = made(bench, many, **grid, **how, visits=True)
    visits = product.plane("visits").values[0]
    expected = sum((product.hits_of(k) > 0).astype(int) for k in range(4))
    np.testing.assert_array_equal(visits, expected)
    assert {1, 3} <= set(np.unique(visits))
    np.testing.assert_array_equal(product.to("mK").plane("visits").values[0], expected)
    assert product.plot(plane="visits").get_title() == "visits"
    with fits.open(product.write(tmp_path / "map.fits")) as file:
        one_table = product.pixels is not None
        written = file["MAP"].data["VISITS"] if one_table else file["VISITS"].data
        np.testing.assert_array_equal(written, expected)
        assert written.dtype.kind == "i"


def test_visits_of_tasks_add_up(bench):
    """Of one scan and of two others, written and read between."""
    many, kept = [along(bench, 0.4 * k, k) for k in range(3)], []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BinMap, "finalize", lambda self, data: kept.append(data.take(self.label)))
        for some in (many, many[:1], many[1:]):
            step = BinMap(pixel="10 arcsec", width="4 arcmin", visits=True)
            bench.run([step], some, {"signal": zeros})
    whole, one, rest = (MapSums.of(sums.arrays()) for sums in kept)
    one += rest
    np.testing.assert_array_equal(one.coverage.sums["visits"], whole.coverage.sums["visits"])
    assert whole.coverage.sums["visits"].max() == 3


def test_too_many_hits_of_scans_are_refused(bench, monkeypatch):
    one, other = (
        coverage.Coverage({}, [np.arange(600, dtype=np.int32)], [np.ones(600, np.int32)])
        for _ in range(2)
    )
    sums, more = MapSums(1000, ["signal"]), MapSums(1000, ["signal"])
    sums.coverage, more.coverage = one, other
    monkeypatch.setattr(coverage, "MOST_ENTRIES", 1000)
    with pytest.raises(PipelineError, match="more than 1 GB"):
        sums += more  # of two tasks of a campaign
    with pytest.raises(PipelineError, match="more than 1 GB") as caught:
        made(bench, [bench.observation(7, 3000, index=i) for i in range(3)], pixel="2 arcsec")
    assert "scan_hits" in str(caught.value)


@pytest.mark.parametrize("grid", GRIDS)
def test_files(bench, grid, tmp_path):
    many = [bench.observation(7, 3000, index=i) for i in range(2)]
    product = made(bench, many, **grid)
    with fits.open(product.write(tmp_path / "map.fits")) as file:
        if product.pixels is None:
            np.testing.assert_array_equal(file["CROSSLINKING"].data, product.crosslinking)
            np.testing.assert_array_equal(file["MEAN_SIN_2PSI"].data, product.directions[1])
        else:
            np.testing.assert_array_equal(file["MAP"].data["CROSSLINKING"], product.crosslinking)
        rows = file["SCAN_HITS"].data
        assert list(file["SCANS"].data["NAME"]) == ["scan0", "scan1"]
        second = rows[rows["SCAN"] == 1]
        plane = product.hits_of("scan1")
        expected = np.flatnonzero(plane) if product.pixels is None else product.pixels[plane > 0]
        np.testing.assert_array_equal(second["PIXEL"], expected)
        np.testing.assert_array_equal(second["HITS"], plane[plane > 0])


def test_picture(bench):
    product = made(bench, along(bench, 0.3))
    assert "one direction" in product.plot(plane="crosslinking").images[0].colorbar.ax.get_ylabel()
    with pytest.raises(InputError, match="no plane"):
        made(bench, along(bench, 0.3), crosslinking=False).plot(plane="crosslinking")
