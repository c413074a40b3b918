"""Pictures say what they show, need no window system, and draw on the Axes they are given."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from astropy.wcs import WCS
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from zonda.core.canvas import file_of
from zonda.core.errors import OutputError
from zonda.core.maps.image import Image
from zonda.core.maps.map_arrays import on_plane
from zonda.core.maps.map_plots import (
    map_axes,
    plot_circle,
    plot_coverage,
    plot_map,
)
from zonda.core.maps.map_product import MapProduct
from zonda.operators.diagnostics.plot_operators import Flat, Plots
from zonda.operators.diagnostics.power_spectrum import Spectrum
from zonda.operators.diagnostics.series import TimeStream, TimeStreams
from zonda.operators.diagnostics.series_plots import (
    draw,
    draw_scan,
)

ARCSEC = np.pi / 648000
ARCMIN = 60 * ARCSEC


@pytest.fixture
def wcs():
    made = WCS(naxis=2)
    made.wcs.ctype, made.wcs.crval = ["RA---TAN", "DEC--TAN"], [75.0, 20.0]
    made.wcs.crpix, made.wcs.cdelt = [30.5, 25.5], [-4 / 3600, 4 / 3600]
    return made


@pytest.fixture
def values():
    made = np.random.default_rng(1).normal(0, 1e-4, (50, 60))
    made[25, 30] = -2e-3
    made[0, :] = np.nan
    return made


@pytest.mark.parametrize(
    ("kind", "steps", "dec"),
    [
        ("TAN", (8.0, 4.0), 20.0),
        ("SIN", (3.0, 6.0), 0.0),
        ("CAR", (4.0, 4.0), 60.0),
        ("TAN", (4.0, 4.0), 20.0),
    ],
)
def test_pictures_have_the_proportions_of_the_sky(kind, steps, dec):
    """A field as wide as it is high is drawn so, and the beam is a circle on the paper, whatever
    the pixels' shape.
    """
    dx, dy = steps
    across = dx * (np.cos(np.radians(dec)) if kind == "CAR" else 1.0)
    shape = round(400 / dy), round(400 / across)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = (
        [f"RA---{kind}", f"DEC--{kind}"],
        [75.0, 0.0 if kind == "CAR" else dec],
    )
    wcs.wcs.cdelt = [-dx / 3600, dy / 3600]
    wcs.wcs.crpix = [
        shape[1] / 2 + 0.5,
        shape[0] / 2 + 0.5 - (dec * 3600 / dy if kind == "CAR" else 0),
    ]
    ax = drawn(plot_map(np.random.default_rng(1).standard_normal(shape), wcs, fwhm=40 * ARCSEC))
    box = ax.get_window_extent()
    assert box.width / box.height == pytest.approx(1.0, rel=0.02)
    beam = ellipses(ax)[0].get_window_extent()
    wide, high = beam.width, beam.height
    assert wide == pytest.approx(high, rel=0.02)
    assert wide / box.width == pytest.approx(0.1, rel=0.02)


@pytest.fixture
def spectrum():
    f = np.linspace(0.01, 50, 2000)
    white, pink = np.full(2000, 6e-6), 6e-6 * 0.5 / f
    return Spectrum(
        f, {"signal": white + pink, "white": white, "pink": pink}, 100.0, 6e-6, "PowerSpectrum", 16
    )


@pytest.fixture
def stream():
    seconds = np.arange(1000) / 50
    return TimeStream(
        seconds,
        {"signal": np.array([np.sin(seconds), np.cos(seconds)])},
        ["d0", "d1"],
        "scan",
        "TimeStreams",
    )


@pytest.fixture
def products(wcs, values, spectrum, stream):
    def product(scale, half):
        hits = np.full(values.shape, 40)
        return MapProduct(
            values * scale,
            hits,
            hits * 1e6,
            np.full(values.shape, 1e-4),
            values * half if half else None,
            wcs.to_header(),
            centre=(np.radians(75.0), np.radians(20.0)),
            pixel=4 * ARCSEC,
            weighting="inverse_variance",
            fwhm=9 * ARCSEC,
        )

    return {
        "input": Image(values, wcs.to_header()),
        "map": product(1.0, 0.5),
        "noiseless/map": product(0.5, 0),
        "source_free/map": product(0.1, 0),
        "spectrum": spectrum,
        "time_streams": stream,
    }


def texts(ax):
    return [t.get_text() for t in ax.texts]


def ellipses(ax):
    return [patch for patch in ax.patches if type(patch).__name__ == "Ellipse"]


def drawn(ax):
    FigureCanvasAgg(ax.figure).draw()
    return ax


def test_a_map_has_world_axes_a_unit_and_its_beam(values, wcs):
    ax = plot_map(values, wcs, title="The map", fwhm=9 * ARCSEC)
    plot_circle(drawn(ax), values.shape, (29.5, 24.5), 60 * ARCSEC)
    assert ax.get_title() == "The map"
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("RA (ICRS)", "Dec (ICRS)")
    assert "FWHM 9″" in texts(ax)
    assert "µK" in ax.images[0].colorbar.ax.get_ylabel()
    low, high = ax.images[0].get_clim()
    assert low == -high  # zero is white
    np.testing.assert_allclose(np.ma.getdata(ax.images[0].get_array())[25, 30], -2000)  # uK
    beam, circle = ellipses(ax)
    assert beam.width == pytest.approx(9 / 4)  # pixels
    assert circle.width == pytest.approx(60 / 4)


@pytest.mark.parametrize("fill", [0.0, np.nan])
def test_an_empty_map_can_be_drawn(fill, wcs):
    drawn(plot_map(np.full((50, 60), fill), wcs))
    drawn(plot_coverage(np.zeros((50, 60), int), wcs))


@pytest.mark.parametrize(
    ("kinds", "frame", "names"),
    [
        (("GLON-TAN", "GLAT-TAN"), "", ("l", "b", "Galactic")),
        (("RA---TAN", "DEC--TAN"), "FK5", ("RA", "Dec", "FK5")),
        (("RA---TAN", "DEC--TAN"), "ICRS", ("RA", "Dec", "ICRS")),
    ],
)
def test_axes_are_named_after_the_frame(values, wcs, kinds, frame, names):
    wcs.wcs.ctype = kinds
    wcs.wcs.radesys = frame
    wcs.wcs.set()
    ax = plot_map(values, wcs)
    assert (ax.get_xlabel(), ax.get_ylabel()) == tuple(f"{n} ({names[2]})" for n in names[:2])


def test_the_colour_bar_says_where_values_lie_beyond_it(wcs):
    values = np.zeros((50, 60))
    values[10, 10] = -2.0
    bar = drawn(plot_map(values, wcs, limit=1.0)).images[0].colorbar
    assert bar.extend == "min"
    assert drawn(plot_map(values, wcs, limit=2.0)).images[0].colorbar.extend == "neither"


def test_a_map_with_the_mean_emission_in_it_shows_its_variation(wcs):
    values = 78.7 + 0.1 * np.random.default_rng(1).uniform(-1, 1, (50, 60))
    low, high = drawn(plot_map(values, wcs, limit=78.8)).images[0].get_clim()
    assert 78.59 < low < 78.61
    assert 78.79 < high < 78.81
    assert drawn(plot_map(np.full((50, 60), 78.7), wcs)).images[0].get_clim() == (
        0.0,
        78.7,
    )  # no variation at all


def test_colours_diverge_only_about_zero(wcs):
    """A sky of one sign has a scale from zero, however small its source; one about zero has white
    at zero.
    """
    y, x = np.indices((50, 60))
    blob = 1e-3 * np.exp(-((x - 30) ** 2 + (y - 25) ** 2) / 40)
    noise = 1e-5 * np.random.default_rng(1).normal(
        size=blob.shape
    )  # far below a twentieth of the peak
    for sky in (blob, blob + noise, np.where(blob == blob.max(), 1e-3, 0.0)):
        image = drawn(plot_map(sky, wcs)).images[0]
        assert image.cmap.name == "inferno"
        assert image.get_clim()[0] == pytest.approx(0, abs=50)  # uK: noise alone lies below
        image = drawn(plot_map(-sky, wcs)).images[0]
        assert image.cmap.name == "Blues_r"
        assert image.get_clim()[1] == pytest.approx(0, abs=50)
        assert image.get_clim()[0] < -900
    image = drawn(plot_map(blob - 3e-4, wcs)).images[0]
    assert image.cmap.name == "RdBu_r"
    assert image.get_clim()[0] == -image.get_clim()[1]


def test_a_repeated_track_does_not_hide_the_first(make_observation):
    widths = [
        line.get_linewidth()
        for line in draw_scan([make_observation(500, k) for k in range(3)])[0].ax.lines
    ]
    assert widths == sorted(widths, reverse=True)
    assert widths[0] > 1.5 * widths[-1]


def test_pictures_say_after_which_step_they_were_taken(data, products, spectrum, stream):
    steps = ["Efficiency", "PowerSpectrum", "TimeStreams", "HighpassFilter", "After"]
    data.provenance["operators"] = [(s, {"After": "TimeStreams"}.get(s, s), {}) for s in steps]
    data.products.update(
        {
            "spectrum": replace(spectrum, label="PowerSpectrum"),
            "time_streams": replace(stream, label="After"),
        }
    )
    Plots().finalize(data)
    by_name = {p.name: p.caption for p in data.products["pictures"]}
    assert "after Efficiency" in by_name["power_spectra"]
    assert "after HighpassFilter" in by_name["tod"]


def test_coverage_leaves_unseen_pixels_out(wcs):
    hits = np.zeros((50, 60), int)
    hits[10:20] = 7
    shown = drawn(plot_coverage(hits, wcs)).images[0].get_array()
    assert shown.mask.sum() == 50 * 60 - 600
    assert shown.max() == 7


def test_spectra_mark_the_white_level_and_the_knee(spectrum):
    ax = drawn(draw(spectrum, "s", "")[0].ax)
    assert ax.get_xscale() == ax.get_yscale() == "log"
    assert any("2 NET²" in t and "1.73 mK" in t for t in texts(ax))  # sqrt(6e-6 / 2)
    assert any(t.startswith("measured knee 0.5") for t in texts(ax))
    labels = [t.get_text() for t in ax.get_legend().get_texts()]
    assert labels == ["signal (all)", "white noise", "pink noise"]
    assert "Hz" in ax.get_xlabel()
    assert "K" in ax.get_ylabel()


def test_time_streams(stream):
    ax = drawn(draw(stream, "tod", "")[0].ax)
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["d0", "d1"]
    assert "scan" in ax.get_title()


def test_a_track_starts_at_its_offset(make_observation):
    observation = make_observation(500)
    ax = drawn(draw_scan([observation])[0].ax)
    x, y = ax.lines[0].get_data()
    assert np.hypot(x[0], y[0]) < 1e-9  # the fixture's first sample looks at the centre
    offset = np.radians(0.05) * np.sin(observation.seconds)
    # Tangent-plane offsets differ from ra cos(dec) by a relative offset * tan(dec) = 3e-4
    np.testing.assert_allclose(x, -np.degrees(offset) * 60 * np.cos(np.radians(20)), atol=1.5e-3)
    np.testing.assert_allclose(y, np.degrees(offset) * 60 / 3, atol=1.5e-3)
    assert ax.xaxis_inverted()


def test_no_window_system_and_no_global_state():
    code = (
        "import numpy as np, sys; from astropy.wcs import WCS; from"
        " zonda.core.maps.map_plots import plot_map\nassert 'matplotlib' not in"
        " sys.modules\nw = WCS(naxis=2); w.wcs.ctype = ['RA---TAN',"
        " 'DEC--TAN']\nplot_map(np.zeros((4, 4)), w).figure.savefig('/dev/null',"
        " format='png')\nassert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        env={"PATH": "", "MPLBACKEND": "tkagg", "HOME": "/tmp"},
    )


def test_every_picture_is_written(data, products, make_observation):
    data.products.update(products)
    data.observations.append(make_observation(500))
    Plots().finalize(data)
    names = {
        "input",
        "noiseless_map",
        "map",
        "noise_map",
        "coverage",
        "power_spectra",
        "tod",
        "scan",
    }
    assert {p.name for p in data.output.iterdir()} == {f"{n}.png" for n in names}
    for picture in data.products["pictures"]:
        assert picture.png.startswith(b"\x89PNG")
        assert (data.output / f"{picture.name}.png").read_bytes() == picture.png
        assert picture.caption
    noise = next(p for p in data.products["pictures"] if p.name == "noise_map")
    assert "even minus odd scans" in noise.caption
    assert "all but the sky" in noise.caption
    assert "smoothed by 9″" in noise.caption


@pytest.mark.parametrize(
    "picture",
    [
        "map",
        "polar map",
        "turned map",
        "all-sky map",
        "wide map",
        "strip",
        "spectra",
        "streams",
        "transfer function",
        "scan",
        "coverage",
    ],
)
def test_no_labels_overlap(picture, values, wcs, spectrum, stream, make_observation):
    """No two tick labels of an axis overlap, nor do texts and titles."""
    from zonda.operators.diagnostics.transfer_function import Found, Transfer

    hits = np.geomspace(1, 1e5, 3000).reshape(50, 60)
    if picture == "polar map":
        wcs.wcs.crval = [75.0, -89.99]
        wcs.wcs.set()
    if picture == "turned map":
        wcs.wcs.pc = [[0.7, -0.7], [0.7, 0.7]]
    if picture == "all-sky map":
        wcs.wcs.ctype, wcs.wcs.cdelt, wcs.wcs.crval = (
            ["RA---AIT", "DEC--AIT"],
            [-5.0, 5.0],
            [75.0, 0.0],
        )
    if picture == "strip":
        values = np.tile(values, (1, 20))
    if picture == "wide map":
        values = np.tile(values, (1, 5)) * 1e6
    edges = 1 / np.geomspace(400, 12, 13) / ARCSEC
    ring = np.linspace(0.1, 1, 12)
    rings = Found(np.sqrt(edges[1:] * edges[:-1]), ring, ring / 10, ring, ring, ring)
    ax = {
        "spectra": lambda: draw(spectrum, "s", "")[0].ax,
        "streams": lambda: (
            draw(replace(stream, streams={"signal": -1e3 + stream.streams["signal"]}), "tod", "")[
                0
            ].ax
        ),
        "transfer function": lambda: (
            draw(Transfer(rings, edges, "sky", 9 * ARCSEC, "T", "map"), "transfer_function", "")[
                0
            ].ax
        ),
        "scan": lambda: draw_scan([make_observation(500)])[0].ax,
        "coverage": lambda: plot_coverage(hits, wcs, per_beam=0.3),
    }.get(picture, lambda: plot_map(values, wcs, title="The map", fwhm=9 * ARCSEC))()
    canvas = FigureCanvasAgg(ax.figure)
    canvas.draw()
    everything = [*ax.figure.axes, *(child for axes in ax.figure.axes for child in axes.child_axes)]
    assert not any(
        a.title.get_window_extent().overlaps(t.get_window_extent())
        for a in everything
        for t in a.texts
        if a.get_title()
    )
    for axes in ax.figure.axes:
        if not hasattr(axes, "coords"):
            for axis, side in ((axes.xaxis, 0), (axes.yaxis, 1)):
                labels = [t.get_window_extent() for t in axis.get_ticklabels() if t.get_text()]
                spans = sorted((b.intervalx if side == 0 else b.intervaly).tolist() for b in labels)
                assert all(first[1] < second[0] for first, second in itertools.pairwise(spans)), (
                    axes
                )
            written = [t.get_window_extent() for t in axes.texts]
            assert not any(a.overlaps(b) for a, b in itertools.combinations(written, 2)), [
                t.get_text() for t in axes.texts
            ]
    assert "$" not in " ".join(t.get_text() for t in ax.figure.findobj(Text))
    assert file_of(ax.figure, "png").startswith(b"\x89PNG")


def test_astropys_own_axes_can_be_drawn_on(values, wcs):
    ax = Figure().add_subplot(projection=wcs)
    plot_map(values, wcs, ax=ax)
    assert drawn(ax).coords[0].get_axislabel() == "RA (ICRS)"


@pytest.mark.parametrize(
    ("shape", "stretched"),
    [((60, 1500), "Dec stretched 3.1×"), ((600, 40), "stretched 3.7×"), ((50, 200), "")],
)
def test_a_strip_fills_its_frame(shape, stretched, wcs):
    """Its image is at least an inch high and wide, its colour bar beside the longer edge; the axes
    say if it is stretched.
    """
    wcs.wcs.crpix = [shape[1] / 2, shape[0] / 2]
    ax = drawn(
        plot_map(
            np.random.default_rng(1).normal(size=shape),
            wcs,
            title="A title that is longer than the strip is wide",
        )
    )
    box, whole = ax.get_window_extent(), ax.figure.bbox
    assert min(box.width, box.height) >= ax.figure.dpi
    assert max(box.width / whole.width, box.height / whole.height) > 0.65
    assert stretched in ax.get_xlabel()
    assert ("stretched" in ax.get_xlabel()) == bool(stretched)
    bar = ax.images[0].colorbar.ax.get_window_extent()
    assert (bar.width > bar.height) == (shape[1] > shape[0])


def test_a_map_is_shown_where_it_has_samples(values, wcs):
    """Pictures are cut to the samples, and stay in their place."""
    hits = np.zeros(values.shape, int)
    hits[30:40, 5:20] = 3
    product = MapProduct(
        values,
        hits,
        hits * 1.0,
        values,
        None,
        wcs.to_header(),
        centre=(np.radians(75.0), np.radians(20.0)),
        pixel=4 * ARCSEC,
        fwhm=9 * ARCSEC,
        sample_rate=50.0,
    )
    cut = Flat.of(product, {"signal": product.signal}).cropped()
    assert cut.hits.shape == (12, 17)  # a hundredth of 15 pixels is one
    np.testing.assert_array_equal(cut.planes["signal"], values[29:41, 4:21])
    here, there = cut.wcs.wcs_pix2world(1, 1, 0), wcs.wcs_pix2world(5, 30, 0)
    np.testing.assert_allclose(here, there, rtol=0, atol=1e-9)


def test_coverage_in_seconds_per_beam(wcs):
    hits = np.arange(1, 3001).reshape(50, 60)
    ax = drawn(plot_coverage(hits, wcs, per_beam=0.25))
    np.testing.assert_allclose(np.ma.getdata(ax.images[0].get_array()), hits / 4)
    bar = ax.images[0].colorbar.ax
    assert bar.get_ylabel() == "integration time of all detectors [s per beam]"
    (samples,) = bar.child_axes
    FigureCanvasAgg(ax.figure).draw()
    assert samples.get_ylabel() == "samples per pixel"
    assert samples.get_ylim() == pytest.approx((0, 3000))
    each = np.linspace(0.25, 0.3, 3000).reshape(
        50, 60
    )  # pixels of different size: no second scale can be true
    ax = drawn(plot_coverage(hits, wcs, per_beam=each))
    np.testing.assert_allclose(np.ma.getdata(ax.images[0].get_array()), hits * each, rtol=1e-6)
    assert not ax.images[0].colorbar.ax.child_axes


def test_many_scans_take_few_points(make_observation):
    """A track is drawn with a point per pixel or so, however finely it was sampled; it passes where
    the samples were.
    """
    observation = make_observation(60000)
    x, y = draw_scan([observation])[0].ax.lines[0].get_data()
    ra0, dec0 = observation.centre
    dx, dy = (observation.ra - ra0) * np.cos(dec0) / ARCMIN, (observation.dec - dec0) / ARCMIN
    extent = max(np.ptp(dx), np.ptp(dy))
    assert np.ptp(x) == pytest.approx(np.ptp(dx), abs=0.01 * extent)
    assert np.ptp(y) == pytest.approx(np.ptp(dy), abs=0.01 * extent)
    assert len(x) < 20001


def test_only_what_is_there_is_drawn(data):
    Plots().finalize(data)
    assert data.products["pictures"] == []
    assert list(data.output.iterdir()) == []


def test_a_healpix_map_is_drawn(data):
    import healpy as hp

    nside = 1024
    pixels = hp.query_disc(nside, hp.ang2vec(75.0, 20.0, lonlat=True), np.radians(0.5))
    n = pixels.size
    data.products["map"] = MapProduct(
        np.full(n, 1e-3),
        np.full(n, 5),
        np.full(n, 5.0),
        np.full(n, 1e-3),
        None,
        None,
        centre=(np.radians(75.0), np.radians(20.0)),
        pixel=hp.nside2resol(nside),
        nside=nside,
        pixels=np.sort(pixels),
        fwhm=9 * ARCSEC,
    )
    Plots().finalize(data)
    assert {p.name for p in data.products["pictures"]} == {"map", "coverage"}


def healpix(nside, pixels, centre, frame):
    ones, side = np.ones(len(pixels)), np.sqrt(np.pi / 3) / nside
    return MapProduct(
        ones, ones, ones, ones, None, None, centre, side, frame, nside=nside, pixels=pixels
    )


def test_a_flat_healpix_map_shows_each_pixel_in_its_place():
    import healpy as hp

    nside = 512
    pixels = np.sort(hp.query_disc(nside, hp.ang2vec(266.0, -29.0, lonlat=True), np.radians(1.0)))
    centre = (np.radians(266.0), np.radians(-29.0))
    flat, wcs = on_plane(
        healpix(nside, pixels, centre, "galactic"),
        {"signal": pixels * 1.0, "hits": pixels * 0 + 1},
        300,
    )
    y, x = np.nonzero(flat["hits"])
    lon, lat = wcs.pixel_to_world_values(x, y)
    np.testing.assert_array_equal(flat["signal"][y, x], hp.ang2pix(nside, lon, lat, lonlat=True))
    assert set(flat["signal"][y, x]) == set(pixels)  # none is lost
    assert np.isnan(flat["signal"][flat["hits"] == 0]).all()
    ny, nx = flat["hits"].shape
    assert max(nx, ny) == 300
    np.testing.assert_allclose(
        wcs.pixel_to_world_values(nx / 2, ny / 2), (266.0, -29.0), atol=0.1
    )  # a pixel of the map
    assert all(
        flat["hits"].any(axis=axis)[[6, -7]].all() for axis in (0, 1)
    )  # it reaches as far as the pixels
    assert wcs.wcs.ctype[0].startswith("GLON")


def test_a_healpix_map_of_half_the_sky_is_drawn():
    import healpy as hp

    pixels = np.sort(hp.query_disc(32, hp.ang2vec(10.0, -60.0, lonlat=True), np.radians(100.0)))
    centre = (np.radians(10.0), np.radians(-60.0))
    flat, wcs = on_plane(
        healpix(32, pixels, centre, "icrs"), {"signal": pixels * 1.0, "hits": pixels * 0 + 1}, 300
    )
    assert set(flat["signal"][flat["hits"] > 0]) == set(pixels)
    assert wcs.wcs.ctype[0] == "RA---ZEA"


def test_a_healpix_map_without_hits_is_empty_on_the_plane():
    """As of a scan all of whose samples are flagged."""
    empty = np.zeros(0, np.int64)
    flat, _ = on_plane(
        healpix(32, empty, (1.0, 0.3), "icrs"), {"signal": empty * 1.0, "hits": empty}, 50
    )
    assert np.isnan(flat["signal"]).all()
    assert not flat["hits"].any()


def test_no_output_folder(data):
    data.output = None
    with pytest.raises(OutputError, match="no output folder"):
        Plots().finalize(data)


def test_a_large_input_keeps_its_place_when_thinned(data, wcs):
    values = np.zeros((1600, 3200))
    values[800, 1600] = 1.0
    wcs.wcs.crpix = [1601, 801]
    data.products["input"] = Image(values, wcs.to_header())
    Plots().finalize(data)
    assert [p.name for p in data.products["pictures"]] == ["input"]


def test_time_streams_are_kept_whole(make_observation, data):
    from zonda.core.data import Block
    from zonda.core.numerics.smooth import SmoothField

    observation, operator = (
        make_observation(5000),
        TimeStreams(streams=["signal", "pink"], detectors=3),
    )
    mean = SmoothField.constant(np.arange(19.0), 5000)
    signal = np.random.default_rng(3).normal(size=(19, 5000)).astype(np.float32)
    state = operator.prepare(observation)
    for rows in (slice(0, 16), slice(16, 19)):
        for columns in (slice(0, 2048), slice(2048, 5000)):
            operator.exec(
                Block(
                    observation, rows, columns, {"signal": signal[rows, columns]}, {"signal": mean}
                ),
                state,
            )
    operator.collect(data, observation, state)
    operator.finalize(data)
    kept = data.products["time_streams"]
    assert kept.names == ["d00", "d09", "d18"]
    np.testing.assert_allclose(
        kept.streams["signal"],
        signal[[0, 9, 18]] + np.array([0.0, 9, 18])[:, None],
        rtol=1e-14,
        atol=1e-14,
    )
    assert observation.log.get("TimeStreams", "stream pink is absent at this step") == 1
    assert TimeStreams(observation=1).prepare(observation) is None


@pytest.mark.parametrize("picture", ["streams", "scans"])
def test_the_legend_touches_no_line(picture, stream, make_observation):
    scans = [make_observation(500, index=k) for k in range(3)]
    ax = draw(stream, "tod", "")[0].ax if picture == "streams" else draw_scan(scans)[0].ax
    FigureCanvasAgg(ax.figure).draw()
    box = ax.get_legend().get_window_extent()
    for line in ax.get_lines():
        path = line.get_transform().transform_path(line.get_path())
        assert not path.intersects_bbox(box, filled=False)


def test_maps_side_by_side_have_their_latitudes_written_once(values, wcs):
    first, second = map_axes(values.shape, wcs, 2)
    for ax in (first, second):
        plot_map(values, wcs, ax=ax)
    drawn(first)
    assert first.get_ylabel()
    assert not second.get_ylabel()
    assert first.get_position().width == pytest.approx(second.get_position().width, rel=1e-3)
    assert second.get_position().x1 < 1
    assert second.images[0].colorbar.ax.get_position().x1 < 1
