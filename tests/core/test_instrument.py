"""Focal planes, passbands, telescopes, sites."""

import numpy as np
import pytest

import zonda
from zonda.core.errors import InputError, ZondaError
from zonda.core.instrument import hexagonal_packing
from zonda.core.registry import instruments, sites

ARCMIN = np.radians(1 / 60)

CAMERA = {
    "name": "camera",
    "telescope": {"name": "dish", "diameter": "6 m"},
    "band": {"name": "b150", "low": "140 GHz", "high": "160 GHz"},
    "detectors": 7,
    "field_of_view": "10 arcmin",
    "main_beam_efficiency": 0.6,
    "illumination_efficiency": 0.9,
    "net": "500 uK s(1/2)",
    "sample_rate": "50 Hz",
}


def test_mustang2_is_the_papers():
    m2 = instruments.create("mustang2")
    plane = m2.focalplane()
    assert len(plane) == m2.detectors == 223
    assert np.isclose(2 * np.arctan(plane.radius), 4.2 * ARCMIN, rtol=1e-12)
    assert np.isclose(m2.beam_fwhm, np.radians(8.5 / 3600))
    assert np.isclose(m2.band.centre, 93e9, rtol=1e-12)
    assert (m2.net, m2.sample_rate, m2.telescope.diameter) == (1.7e-3, 100.0, 100.0)
    gaps = np.hypot(plane.xi[:, None] - plane.xi, plane.eta[:, None] - plane.eta) + 10 * np.eye(223)
    assert (
        15 < np.degrees(gaps.min()) * 3600 < 17
    )  # the pitch that fills the field, see the docstring


def test_diffraction_limit_where_no_beam_is_given():
    m2 = instruments.create("mustang2").model_copy(update={"fwhm": None})
    assert np.isclose(np.degrees(m2.beam_fwhm) * 3600, 8.11, atol=0.01)  # 1.22 lambda / D at 93 GHz


@pytest.mark.parametrize("n", [1, 2, 7, 19, 61, 223, 1000])
def test_hexagonal_packing(n):
    x, y = hexagonal_packing(n)
    assert len(x) == n
    if n > 1:
        d = np.hypot(x[:, None] - x, y[:, None] - y) + 10 * np.eye(n)
        assert np.isclose(d.min(), 1, rtol=1e-12)
    if n in (7, 19, 61):  # whole hexagons: the centre of gravity is the centre
        assert abs(x.mean()) < 1e-12
        assert abs(y.mean()) < 1e-12


def test_passband_from_a_file(tmp_path):
    table = tmp_path / "band.txt"
    table.write_text("# GHz transmission\n80 0\n85 0.5\n95 1\n105 0\n")
    band = zonda.Band(name="mine", file=table)
    assert band.frequency[0] == 80e9
    assert np.isclose(band.width, (5 * 0.25 + 10 * 0.75 + 10 * 0.5) * 1e9)
    assert 85e9 < band.centre < 97e9


@pytest.mark.parametrize(
    ("text", "lowest"),
    [
        ("160 0\n159 1\n141 1\n140 0\n", 0.0),
        ("frequency,transmission\n140,0\n141,2\n159,2\n160,0\n", 0.0),
        ("140 -0.01 # noise\n141 1\n159 1\n160 -0.01\n", -0.01),
        ("# my band\n140\t0\n141\t1\n159\t1\n160\t0\n", 0.0),
        ("Freq (Hz); err; Throughput\n140e9;1;0\n141e9;1;1\n159e9;1;1\n160e9;1;0\n", 0.0),
        (
            "|bandpass_frequency|bandpass_weight|\n|double|double|\n|GHz||\n"
            " 140                0\n 141                1\n 159                1\n"
            " 160                0\n",
            0.0,
        ),
        (
            "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: f, unit: GHz, datatype: float64}\n"
            "# - {name: wl, unit: mm, datatype: float64}\n"
            "# - {name: throughput, datatype: float64}\nf wl throughput\n140 2.14 0\n"
            "141 2.12 1\n159 1.88 1\n160 1.87 0\n",
            0.0,
        ),
    ],
)
def test_passbands_as_instruments_publish_them(tmp_path, text, lowest):
    """Each is a trapezium about 150 GHz; noise below zero stays."""
    (tmp_path / "band.txt").write_text(text)
    band = zonda.Band(name="mine", file=tmp_path / "band.txt")
    assert band.centre == pytest.approx(150e9)
    assert (np.diff(band.frequency) > 0).all()
    assert (band.transmission.min(), band.transmission.max()) == (lowest, 1.0)


def test_a_passband_of_wavelengths(tmp_path):
    c = 299792.458  # GHz um
    rows = [f"{c / nu:.12g},{t}" for nu, t in ((140, 0), (141, 1), (159, 1), (160, 0))]
    (tmp_path / "band.csv").write_text("\n".join(["wavelength [um],T", *rows]))
    assert zonda.Band(name="mine", file=tmp_path / "band.csv").centre == pytest.approx(150e9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("80 1\n", "has one row"),
        ("80 1 3\n90 1 3\n", "has 3 columns, none of them frequency and transmission"),
        ("80 one\n", "line 1: transmission is 'one', not a finite number"),
        ("80 1\n80 1\n", "has a frequency twice"),
        ("80 nan\n90 1\n", "line 1: transmission is 'nan'"),
        ("80 -0.11\n90 1\n", "transmission is -0.11, more than 10% of the peak below zero"),
        ("0 1\n90 1\n", "frequencies must be positive"),
        ("f [K],t\n80,1\n90,1\n", "frequency has the unit 'K'"),
        ("80 0\n90 0\n", "somewhere > 0"),
    ],
)
def test_bad_passband_files(tmp_path, text, words):
    table = tmp_path / "band.txt"
    table.write_text(text)
    with pytest.raises(ZondaError, match=rf"(?s)Band, file: passband file .*{words}"):
        zonda.Band(name="mine", file=table)


def test_missing_passband_file(tmp_path):
    with pytest.raises(ZondaError, match="no such file"):
        zonda.Band(name="mine", file=tmp_path / "none.txt")


@pytest.mark.parametrize(
    "edges",
    [
        {},
        {"low": "90 GHz"},
        {"low": "90 GHz", "high": "80 GHz"},
        {"low": "0 GHz", "high": "80 GHz"},
    ],
)
def test_band_edges(edges):
    with pytest.raises(ZondaError, match="0 < low < high"):
        zonda.Band(name="mine", **edges)


def test_green_bank():
    site = sites.create("green_bank")
    assert np.isclose(np.degrees(site.latitude), 38.4331)
    assert site.altitude == 825


def test_focalplane_refuses_nonsense():
    plane = instruments.create("mustang2").focalplane()
    plane.names[1] = plane.names[0]
    with pytest.raises(InputError, match="there twice"):
        plane.copy()
    plane = instruments.create("mustang2").focalplane()
    plane.xi[3] = np.nan
    with pytest.raises(InputError, match="xi of detector d003 is not finite"):
        plane.copy()
    plane = instruments.create("mustang2").focalplane()
    plane.eta = plane.eta[:-1]
    with pytest.raises(InputError, match="eta has 222 entries for 223 detectors"):
        plane.copy()


def test_focalplane_shows_itself():
    plane = instruments.create("mustang2").focalplane()
    assert repr(plane) == "<Focalplane: 223 detectors within 2.1 arcmin of the boresight>"
    page = plane._repr_html_()
    assert "8.5 arcsec" in page
    assert "1.7 mK_RJ sqrt(s)" in page


def test_pairs_of_polarized_detectors():
    whole = zonda.Instrument(**dict(CAMERA, detectors=14, polarization="pairs")).focalplane()
    half = zonda.Instrument(**dict(CAMERA, detectors=7)).focalplane()
    assert whole.names[:4] == ["d0A", "d0B", "d1A", "d1B"]
    for a, b in ((whole.xi, half.xi), (whole.eta, half.eta)):  # both look where the one does
        np.testing.assert_array_equal(a.reshape(-1, 2), np.stack([b, b], 1))
    angles = np.degrees(whole.polarization_angle).reshape(-1, 2)
    np.testing.assert_allclose(angles[:, 1] - angles[:, 0], 90)
    np.testing.assert_allclose(angles[:4, 0], [0, 45, 0, 45])
    assert whole.polarized
    assert (whole.polarization_efficiency == 1).all()
    assert not half.polarized


def test_pairs_need_an_even_number():
    with pytest.raises(
        ZondaError, match="even number of detectors, two in each pixel; detectors is 7"
    ):
        zonda.Instrument(**dict(CAMERA, detectors=7, polarization="pairs"))


def test_a_band_is_not_needed_where_there_are_several():
    """`help(Instrument)` says so; an instrument with neither is refused."""
    assert "band : a Band; default None" in zonda.Instrument.__doc__
    with pytest.raises(ZondaError, match="a camera needs a band"):
        zonda.Instrument(**{key: value for key, value in CAMERA.items() if key != "band"})


def test_a_polarization_efficiency_beyond_one_is_refused():
    plane = zonda.Instrument(**CAMERA).focalplane()
    plane.polarization_efficiency[2] = 1.2
    with pytest.raises(
        InputError, match="polarization_efficiency of detector d2 is not between 0 and 1"
    ):
        plane.copy()


def two_bands(**more):
    bands = [
        {"name": "low", "low": "80 GHz", "high": "100 GHz"},
        {"name": "high", "low": "140 GHz", "high": "160 GHz", "yield": "30 %"},
    ]
    given = {"name": "camera", "telescope": {"name": "dish", "diameter": "12 m"}, "bands": bands}
    given |= {"detectors": 91, "field_of_view": "10 arcmin", "main_beam_efficiency": 0.6}
    given |= {"illumination_efficiency": 0.9, "net": "1 mK s(1/2)", "sample_rate": "50 Hz"}
    return zonda.Instrument(**(given | more))


def test_yield_is_the_share_of_live_detectors():
    made = two_bands(**{"yield": "80 %"})
    planes = [made.focalplane().of_band(k) for k in (0, 1)]
    assert [int((1 - plane.dead).sum()) for plane in planes] == [73, 27]  # round(91 x 0.8), 0.3
    # a band alone has the dead detectors that it has in the camera, in each run
    for plane, camera in zip(planes, made.cameras.values(), strict=True):
        assert (camera.focalplane().dead == plane.dead).all()
    # fewer alive: those that were dead still are, and they are not the last ones
    fewer = two_bands(**{"yield": "50 %"}).focalplane().of_band(0).dead
    assert (fewer >= planes[0].dead).all()
    assert 0 < planes[0].dead[:45].sum() < planes[0].dead.sum()
    assert not two_bands().focalplane().of_band(0).dead.any()
    one = two_bands(detectors=1, bands=[{"name": "b", "low": "1 GHz", "high": "2 GHz"}])
    assert not one.varied(**{"yield": 0.1}).focalplane().dead.any()  # one at least is alive


def test_yield_of_a_table_is_refused(tmp_path):
    table = tmp_path / "array.csv"
    table.write_text("name, xi [arcmin], eta [arcmin]\na, 0, 0\nb, 1, 0\n")
    bands = [{"name": "b", "low": "80 GHz", "high": "90 GHz"}]
    with pytest.raises(ZondaError, match="yield is for layouts"):
        two_bands(focalplane=table, detectors=None, bands=bands, **{"yield": 0.5})
