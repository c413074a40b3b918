"""The sites, instruments and bands that come with zonda."""

import csv
import tomllib
from pathlib import Path

import numpy as np
import pytest

from zonda.core.instrument import STAND_IN
from zonda.core.numerics.radiation import cmb_slope
from zonda.core.registry import bands, instruments, sites
from zonda.operators.atmosphere.weather.climatology import climatologies
from zonda.plugins import layouts as layout_table

ROOT = Path(__file__).resolve().parents[2]
POINTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
OF_ONE_BAND = [
    "mustang2",
    "gbt",
    "atlast",
    "atlast_full",
    "lmt",
    "toltec",
    "lmt_150ghz",
    "lmt_220ghz",
    "lmt_280ghz",
    "act",
    "act_150ghz",
    "act_98ghz",
    "act_220ghz",
    "so_lat",
    "so_lat_145ghz",
    "so_lat_93ghz",
    "so_lat_225ghz",
    "so_lat_280ghz",
    "so_sat",
    "so_sat_145ghz",
    "so_sat_93ghz",
    "so_sat_225ghz",
    "so_sat_280ghz",
    "spt",
    "spt3g",
    "spt_150ghz",
    "spt_95ghz",
    "spt_220ghz",
    "ccat",
    "fyst",
    "ccat_280ghz",
    "ccat_350ghz",
    "cmb_s4",
    "cmb_s4_150ghz",
    "cmb_s4_95ghz",
    "apex",
    "laboca",
    "hexagonal_array",
]
OF_SEVERAL_BANDS = [
    "so_lat_lf",
    "so_lat_mf",
    "so_lat_uhf",
    "so_sat_lf",
    "so_sat_mf",
    "so_sat_uhf",
    "so_lat_lf_baseline",
    "so_lat_mf_baseline",
    "so_lat_uhf_baseline",
    "so_sat_lf_baseline",
    "so_sat_mf_baseline",
    "so_sat_uhf_baseline",
    "so_lat_lf_goal",
    "so_lat_mf_goal",
    "so_lat_uhf_goal",
    "so_sat_lf_goal",
    "so_sat_mf_goal",
    "so_sat_uhf_goal",
    "act_pa4",
    "act_pa5",
    "act_pa6",
    "spt3g_trichroic",
    "toltec_3band",
    "ccat_primecam",
    "cmb_s4_lat_lf",
    "cmb_s4_lat_mf",
    "cmb_s4_lat_hf",
]
NUMBERS = (
    "detectors",
    "band edges",
    "passbands",
    "NET",
    "knee and slope",
    "beams",
    "field of view",
    "layout",
    "polarization angles",
    "sample rate",
    "efficiencies",
)
"""Numbers that have a source, or a stand-in that is named, in each camera of several bands."""


def test_every_layout_has_its_entry_point():
    assert POINTS["zonda.layouts"] == {
        name: f"{layout_table.__name__}:{name}" for name in dir(layout_table)
    }
    with pytest.raises(AttributeError, match="no attribute 'nowhere'"):
        _ = layout_table.nowhere


def test_every_name_is_in_the_files():
    """Instruments, sites and bands of zonda's own, each once."""
    for group, known, number in (
        ("instruments", instruments, len(OF_ONE_BAND + OF_SEVERAL_BANDS)),
        ("sites", sites, 44),
        ("bands", bands, 21),
    ):
        assert list(POINTS[f"zonda.{group}"].values()) == [f"zonda.plugins.data.{group}"]
        own = [found for found in known.candidates() if found.distribution == "zonda"]
        assert len({found.name for found in own}) == len(own) == number
        assert all(found.file.endswith(".yaml") for found in own)
    assert {*OF_ONE_BAND, *OF_SEVERAL_BANDS} <= {*instruments}


def test_sites_of_the_reference():
    path = ROOT.parent / "shared" / "reference" / "sites.csv"
    if not path.exists():
        pytest.skip(f"reference file {path.name} is not here")
    with path.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            site = sites.create(row["site"])
            assert np.degrees([site.latitude, site.longitude]) == pytest.approx(
                [float(row["latitude_deg"]), float(row["longitude_deg"])]
            )
            assert site.altitude == float(row["altitude_m"])
            region = row["weathergen_region"]
            assert site.climatology == (region if region in climatologies() else None)


def test_every_site():
    own = [sites.create(found.name) for found in sites.candidates() if found.file]
    assert {site.climatology for site in own} - {None} == set(climatologies())
    for site in own:
        assert site.provenance
        assert site.description
    assert sites.create("chajnantor") == sites.create("llano_de_chajnantor")
    assert sites.create("south_pole").name == "amundsen_scott"


@pytest.mark.parametrize("name", OF_ONE_BAND)
def test_every_instrument(name):
    made = instruments.create(name)
    assert made.provenance
    assert made.band == bands.create(made.band.name)
    limit = 1.22 * 299792458 / made.band.centre / made.telescope.diameter
    assert (
        0.8 * limit < made.beam_fwhm < 1.8 * limit
    )  # measured beams: dishes are not evenly illuminated
    plane = made.focalplane()
    assert len(plane) == made.detectors
    assert 2 * np.arctan(plane.radius) == pytest.approx(made.field_of_view, rel=1e-9)


@pytest.mark.parametrize("name", OF_SEVERAL_BANDS)
def test_every_camera_of_several_bands(name):
    made = instruments.create(name)
    assert made.telescope.site in sites
    plane, pixels = made.focalplane(), {}
    for k, (band, camera) in enumerate(made.cameras.items()):
        rows = plane.of_band(k)
        assert (band, len(rows)) == (made.bands[k].name, made.bands[k].detectors)
        assert len(set(np.bincount(rows.wafer))) == 1
        limit = 1.22 * 299792458 / camera.band.centre / made.telescope.diameter
        assert (
            0.73 * limit < camera.beam_fwhm < 1.8 * limit
        )  # published ones; of so_sat_lf 0.78, of Prime-Cam at 280 GHz 1.06
        pixels[band] = {*zip(rows.xi.tolist(), rows.eta.tolist(), strict=True)}
    alike = len({frozenset(places) for places in pixels.values()}) == 1
    assert alike == (made.pixels == "shared")
    # modules side by side stand about the middle of all with room between, so that the farthest
    # detector is not at the edge
    assert 2 * np.arctan(plane.radius) == pytest.approx(
        made.field_of_view, rel=0.15 if made.pixels == "separate" else 1e-9
    )
    assert plane.polarized


@pytest.mark.parametrize("name", OF_SEVERAL_BANDS)
def test_every_number_has_a_source_or_is_a_stand_in(name):
    """Each of `NUMBERS` once; what `zonda show instrument` splits at semicolons is whole."""
    parts = instruments.create(name).provenance.split("; ")
    told = [part.removeprefix(STAND_IN).partition(": ") for part in parts]
    assert sorted(number for number, _, _ in told) == sorted(NUMBERS)
    assert all(len(text) > 5 for _, _, text in told)
    for part in parts:
        assert not ("not verified" in part.partition("(")[0] and not part.startswith(STAND_IN)), (
            part
        )


def test_counts_and_scales_of_the_hardware_models():
    """sotodlib/sim_hardware.py: 430 of 432 horns or 37 pixels a wafer, 5.3 and 18 mm apart, 0.00495
    and 0.09668 deg/mm, wafers 128.4 mm and tubes 359.6 mm apart. s4sim/hardware/config.py: 48, 430
    and 467 pixels a wafer, 16.1, 5.3 and 5.2 mm apart, 0.003964 deg/mm, tubes 0.87 deg apart."""
    cases = [
        ("so_lat_lf", 3, 37, 18 * 0.00495, 128.4 * 0.00495),
        ("so_lat_mf", 12, 430, 5.3 * 0.00495, 128.4 * 0.00495),
        ("so_lat_uhf", 6, 430, 5.3 * 0.00495, 128.4 * 0.00495),
        ("so_sat_lf", 7, 37, 18 * 0.09668, 128.4 * 0.09668),
        ("so_sat_mf", 7, 430, 5.3 * 0.09668, 128.4 * 0.09668),
        ("cmb_s4_lat_lf", 8, 48, 16.1 * 0.003964, None),
        ("cmb_s4_lat_mf", 54, 430, 5.3 * 0.003964, 0.87),
        ("cmb_s4_lat_hf", 19, 467, 5.2 * 0.003964, 0.87),
    ]
    for name, number, pixels, pitch, between in cases:
        rows = instruments.create(name).focalplane().of_band(0)
        assert len(rows) == 2 * number * pixels, name
        z = 1 / np.sqrt(1 + rows.xi**2 + rows.eta**2)
        places = np.stack([rows.xi * z, rows.eta * z, z], axis=1)[::2]
        first = places[:pixels]
        away = np.degrees(
            2 * np.arcsin(np.linalg.norm(first[:, None] - first, axis=2) / 2)
        ) + 1e3 * np.eye(pixels)
        # places within a rhombus are sines of a plane, not arcs: 4 % at the rim of the SAT's
        # wafers, 1e-4 of the LAT's
        assert away.min(axis=1) == pytest.approx(pitch, rel=0.04 if "sat" in name else 1e-3), name
        middles = np.stack(
            [m / np.linalg.norm(m) for m in places.reshape(number, pixels, 3).mean(axis=1)]
        )
        apart = np.degrees(np.arccos(np.clip(middles @ middles.T, -1, 1))) + 1e3 * np.eye(number)
        if between is not None:
            # two lost of 430 pixels, up to 20 pitches from the middle together, move it by 0.05,
            # two wafers by 0.1
            assert apart.min() == pytest.approx(between, abs=0.2 * pitch), name


def test_toltecs_nets_are_those_of_its_mapping_speed():
    """toltec_noise.py (TolTEC-Camera/MappingSpeedModel): speed = N 3600 / (NEFD^2 N_beams) [deg2 /
    mJy2 / h], N_beams the beams (pi FWHM^2 / 4 ln 2) in a square degree.
    toltec.astro.umass.edu/using_toltec.php: detectors, beams and largest speeds."""
    made = instruments.create("toltec_3band")
    for name, number, arcsec, speed in (
        ("a2000", 1172, 9.5, 69),
        ("a1400", 2532, 6.3, 20),
        ("a1100", 4012, 5.0, 12),
    ):
        camera = made.cameras[name]
        solid_angle = np.pi * np.radians(arcsec / 3600) ** 2 / (4 * np.log(2))
        jansky = 1e-29 * np.sqrt(
            number * 3600 * solid_angle / (np.radians(1) ** 2 * speed)
        )  # of one mJy
        net = jansky / (2 * 1.380649e-23 * (camera.band.centre / 299792458) ** 2 * solid_angle)
        assert camera.net == pytest.approx(net, rel=1e-3)  # of four digits
        assert np.degrees(camera.beam_fwhm) * 3600 == pytest.approx(arcsec)


def test_toltecs_pitch_is_that_of_the_design():
    """a*_prop.ecsv of tolteca: 2.75, 3.364 and 4.9 mm in an array of 127.049 mm, 4 arcmin
    (toltec_info).
    """
    made = instruments.create("toltec_3band")
    for name, mm in (("a1100", 2.75), ("a1400", 3.364), ("a2000", 4.9)):
        plane = made.cameras[name].focalplane()
        places = np.stack([plane.xi, plane.eta], axis=1)[::2]
        pitch = np.hypot(*(places[1:] - places[0]).T).min()
        assert np.degrees(pitch) * 60 == pytest.approx(mm / 127.049 * 4, rel=0.03)


def test_prime_cams_nets_are_those_of_its_modules():
    """ccat_noise_200831.py, CcatLatv2b: uK_CMB s(1/2) of a module; input.yaml: its detectors, and a
    yield of 0.8.
    """
    made = instruments.create("ccat_primecam")
    for band, module in zip(made.bands, (12.7, 47.7, 305400.7), strict=True):
        net = module * np.sqrt(0.8 * band.detectors) * cmb_slope(band.centre)
        assert band.net * 1e6 == pytest.approx(net, rel=2e-4)  # of 4 digits


def test_modules_of_prime_cam():
    """1.3 deg each, 1.78 deg apart (fyst-trajectories: 461.3 mm at 13.89 arcsec / mm)."""
    made = instruments.create("ccat_primecam")
    whole = made.focalplane()
    planes = [whole.of_band(k) for k in range(3)]
    middles = np.degrees([(p.xi[0::2].mean(), p.eta[0::2].mean()) for p in planes])
    for k in range(3):
        assert np.hypot(*(middles[k] - middles[k - 1])) == pytest.approx(
            461.3 * 13.89 / 3600, rel=2e-3
        )
        own = made.cameras[made.bands[k].name].focalplane()
        assert np.degrees(2 * np.arctan(own.radius)) == pytest.approx(1.3, rel=1e-4)


def test_the_lattice_of_laboca():
    """Beam maps (crush/config/laboca/laboca-2017-09.rcp): neighbours 38 arcsec (median of the
    nearest) to 39.5 (mean) apart.
    """
    plane = instruments.create("apex").focalplane()
    pitch = (
        np.degrees(np.hypot(plane.xi[1:] - plane.xi[0], plane.eta[1:] - plane.eta[0]).min()) * 3600
    )
    assert pitch == pytest.approx(38.7, rel=0.06)


def test_nets_of_the_cmb_are_turned_into_rayleigh_jeans():
    # dT_RJ / dT_CMB = x^2 e^x / (e^x - 1)^2 with x = h nu / k T_CMB
    x = 6.62607015e-34 * 92e9 / (1.380649e-23 * 2.72548)
    factor = x**2 * np.exp(x) / np.expm1(x) ** 2
    assert instruments.create("so_lat_mf").cameras["f090"].net == pytest.approx(
        361e-6 * 1.09 * factor, rel=1e-3
    )  # of 4 digits, with NET_corr


def test_nets_of_cmb_s4_are_those_of_its_model_with_their_correlation():
    """s4sim/hardware/config.py (3a15318), LAT0: NET [uK_CMB s(1/2)] and NET_corr."""
    for name, *levels in (
        ("cmb_s4_lat_lf", 384 * 1.30, 230 * 1.14),
        ("cmb_s4_lat_mf", 288 * 1.18, 313 * 1.01),
        ("cmb_s4_lat_hf", 670 * 1.02, 1615 * 1.01),
    ):
        for band, level in zip(instruments.create(name).bands, levels, strict=True):
            assert band.net / cmb_slope(band.centre) * 1e6 == pytest.approx(
                level, rel=5e-4
            )  # of 4 digits


SENSITIVITIES = {
    "so_lat_lf": ((48, 24), (35, 18)),
    "so_lat_mf": ((5.4, 6.7), (3.9, 4.2)),
    "so_lat_uhf": ((15, 36), (10, 25)),
    "so_sat_lf": ((21, 13), (15, 10)),
    "so_sat_mf": ((3.4 * 2**0.5, 4.3 * 2**0.5), (2.4 * 2**0.5, 2.7 * 2**0.5)),
    "so_sat_uhf": ((8.6, 22), (5.7, 14)),
}
"""SO_Noise_Calculator_Public_v3_1_2.py: baseline and goal, uK_CMB s(1/2) of all detectors."""


@pytest.mark.parametrize("name", SENSITIVITIES)
def test_the_baseline_and_the_goal_of_the_simons_observatory(name):
    baseline, goal = SENSITIVITIES[name]
    assert instruments.create(f"{name}_goal") == instruments.create(name)
    for made, wanted, error in (
        (f"{name}_baseline", baseline, 2e-4),  # of 4 digits
        (name, goal, 0.30),  # the hardware model's detectors: SAT 280 GHz 18.0 against 14
    ):
        for band, level in zip(instruments.create(made).bands, wanted, strict=True):
            array = 1e6 * band.net / cmb_slope(band.centre) / np.sqrt(band.detectors)
            assert array == pytest.approx(level, rel=error), (made, band.name)


@pytest.mark.parametrize("name", [n for n in OF_SEVERAL_BANDS if n.startswith(("so_", "cmb_"))])
def test_places_are_those_of_the_layout_within_a_microarcsecond(name):
    """The field of view is stated with the digits that the layout's own scale needs: 6 digits moved
    the rim of the SO SATs by 35 mas.
    """
    made = instruments.create(name)
    plane, pixels = made.focalplane().of_band(0), made.bands[0].detectors // 2
    layout = layout_table.LAYOUTS[made.layout](pixels)
    apart = np.hypot(plane.xi[::2] - layout.x, plane.eta[::2] - layout.y).max()
    assert np.degrees(apart) * 3.6e9 < 1.0


def test_beams_of_act_have_the_measured_solid_angles():
    """nsr, Gaussians of the same solid angle: pi FWHM^2 / (4 ln 2)."""
    for name, *solid_angles in (
        ("act_pa4", 227.89, 113.34),
        ("act_pa5", 480.93, 219.69),
        ("act_pa6", 492.73, 229.90),
    ):
        for band, nsr in zip(instruments.create(name).bands, solid_angles, strict=True):
            own = np.pi * band.fwhm**2 / (4 * np.log(2)) * 1e9
            assert own == pytest.approx(nsr, rel=0.01)  # of 3 digits


def test_sample_rate_of_spt_3g():
    for name in ("spt3g", "spt3g_trichroic"):
        assert instruments.create(name).sample_rate == 20e6 / 2**17


def test_atlast_is_the_papers():
    made = instruments.create("atlast")
    assert (made.detectors, made.net, made.sample_rate, made.telescope.diameter) == (
        3000,
        0.266e-3,
        225.0,
        50.0,
    )
    assert (made.main_beam_efficiency, made.illumination_efficiency) == (0.3, 0.8)
    assert np.degrees([made.field_of_view, made.beam_fwhm * 3600]) == pytest.approx([0.25, 16])
    assert np.degrees([made.telescope.speed_max, made.telescope.acceleration_max]) == pytest.approx(
        [3, 1]
    )
    assert made.band.centre == pytest.approx(92e9)
    assert instruments.create("atlast_full").detectors == 200_000


@pytest.mark.parametrize(
    ("name", "metres", "degrees"),
    [
        ("gbt", 100, 4.2 / 60),
        ("lmt", 50, 4 / 60),
        ("act", 6, 0.9),
        ("so_lat", 6, 7.8),
        ("so_sat", 0.42, 35),
        ("spt", 10, 1.9),
        ("fyst", 6, 1.3),
        ("cmb_s4", 6, 7.8),
        ("apex", 12, 0.19),
    ],
)
def test_apertures_and_fields(name, metres, degrees):
    made = instruments.create(name)
    assert made.telescope.diameter == metres
    assert np.degrees(made.field_of_view) == pytest.approx(degrees)
