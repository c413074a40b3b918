"""PySM's sky beside analytic laws: over bands, its signs and its frame; what is refused; nothing
comes from the network.

`.ci/pysm` runs these in an environment with PySM (the extra ``pysm``), where none may be skipped
(ZONDA_PYSM=required).
"""

import importlib
import os
from importlib.util import find_spec

import healpy
import numpy as np
import pytest
import yaml
from astropy.config import set_temp_cache
from astropy.io import fits
from astropy.utils import data
from scipy.integrate import quad

import zonda
from zonda.core.band import Band
from zonda.core.cli import main
from zonda.core.errors import InputError, ZondaError
from zonda.core.numerics.projection import directions, frame_rotation
from zonda.core.numerics.radiation import band_average, cmb_slope, rayleigh_jeans
from zonda.core.plan.planning import planning_class
from zonda.core.polarization import PolarizationAngles
from zonda.operators.sky.pysm import PySMSky, _seeded, band_weights, configuration, emission
from zonda.testing import check_operator

NSIDE = 16
VALUES = (100e-6, 30e-6, -20e-6)
"""I, Q, U [K_RJ] at the frequency of the template."""
GAPS = (
    "# GHz, transmission\n80 0\n90 0\n91 1\n104 0.3\n105 0\n120 0\n121 0.5\n130 0.5\n131 0\n150 0\n"
)


def real(test):
    """Needs PySM."""
    absent = find_spec("pysm3") is None and os.environ.get("ZONDA_PYSM") != "required"
    reason = "PySM is not installed: .ci/pysm makes an environment with it"
    return pytest.mark.pysm(pytest.mark.skipif(absent, reason=reason)(test))


def template(path, values=VALUES, nside=NSIDE):
    """I, Q and U [uK_RJ] as PySM's templates are."""
    maps = np.broadcast_to(1e6 * np.reshape(values, (3, -1)), (3, 12 * nside**2))
    healpy.write_map(path, maps, column_units="uK_RJ", coord="G", dtype=np.float64, overwrite=True)
    return str(path)


def synchrotron(path, index=-3.1, **more):
    return {
        "class": "PowerLaw",
        "map_I": template(path),
        "freq_ref_I": "23 GHz",
        "freq_ref_P": "30 GHz",
        "map_pl_index": index,
        **more,
    }


def dust(path, **more):
    return {
        "class": "ModifiedBlackBody",
        "map_I": template(path),
        "freq_ref_I": "150 GHz",
        "freq_ref_P": "353 GHz",
        "map_mbb_index": 1.54,
        "map_mbb_temperature": 20,
        "unit_mbb_temperature": "K",
        **more,
    }


def black_body(nu, reference):
    """nu^1.54 B_nu(20 K) in K_RJ."""
    return (nu / reference) ** 1.54 * rayleigh_jeans(nu, 20.0) / rayleigh_jeans(reference, 20.0)


LAWS = {
    "synchrotron": (
        synchrotron,
        [lambda nu: (nu / 23e9) ** -3.1] + 2 * [lambda nu: (nu / 30e9) ** -3.1],
    ),
    "dust": (dust, [lambda nu: black_body(nu, 150e9)] + 2 * [lambda nu: black_body(nu, 353e9)]),
}


def bands(tmp_path):
    (tmp_path / "gaps.txt").write_text(GAPS)
    return {
        "delta": Band(name="delta", low="149.99 GHz", high="150.01 GHz"),
        "wide": Band(name="wide", low="120 GHz", high="180 GHz"),
        "gaps": Band(name="gaps", file=tmp_path / "gaps.txt"),
    }


# ---- without PySM


@pytest.mark.parametrize("name", ["delta", "wide", "gaps"])
def test_the_weights_average_straight_lines_exactly_and_power_laws_nearly(tmp_path, name):
    band = bands(tmp_path)[name]
    nu, weights = band_weights(band)
    assert (weights >= 0).all()
    assert (np.diff(nu) <= 0.005 * nu[0] * (1 + 1e-9)).all()
    power = weights * nu**2

    def average(values):
        return np.trapezoid(power * values, nu) / np.trapezoid(power, nu)

    assert average(3 + nu / 1e11) == pytest.approx(
        band_average(band, lambda x: 3 + x / 1e11), rel=1e-12
    )
    exact = band_average(
        band, lambda x: (x / 23e9) ** -3.1
    )  # n (n - 1) / 12 of 0.005^2 is 2.6e-5 where lines are longest
    assert average((nu / 23e9) ** -3.1) == pytest.approx(exact, rel=2.7e-5)


def test_what_needs_no_pysm_is_refused_without_it():
    with pytest.raises(ZondaError, match="give models"):
        zonda.PySMSky()
    with pytest.raises(ZondaError, match="under a name of its own"):
        zonda.PySMSky(models=["s1", "s1"])
    with pytest.raises(ZondaError, match="power of two"):
        zonda.PySMSky(models=["s1"], nside=48)


# ---- its spectra


@real
@pytest.mark.parametrize("name", ["delta", "wide", "gaps"])
@pytest.mark.parametrize("law", LAWS)
def test_the_bands_emission_is_the_laws_average(tmp_path, law, name):
    """Equation (1) of radiation.py by scipy's quadrature between the table's frequencies: 2.7e-5 as
    above. A band of +- 7e-5 of its frequency is the law itself: n (n - 1) / 2 of its square,
    2.8e-8."""
    component, laws = LAWS[law]
    band = bands(tmp_path)[name]
    found = emission({"mine": component(tmp_path / "t.fits")}, NSIDE, band, False, "test")
    assert found.shape == (3, 12 * NSIDE**2)

    def integral(function):
        edges = zip(band.frequency[:-1], band.frequency[1:], strict=True)
        return sum(
            quad(lambda nu: np.interp(nu, band.frequency, band.transmission) * function(nu), *pair)[
                0
            ]
            for pair in edges
        )

    for got, value, of in zip(found, VALUES, laws, strict=True):
        np.testing.assert_allclose(
            got, value * integral(of) / integral(lambda nu: 1.0), rtol=2.7e-5
        )
        if name == "delta":
            np.testing.assert_allclose(got, value * of(150e9), rtol=3e-8)


@real
def test_anisotropy_of_the_cmb_is_that_of_a_map_in_k_cmb(tmp_path):
    """PySM's 2.7255 K for our 2.72548 K: 1e-5. A component of I alone beside a polarized one adds
    nothing to Q and U.
    """
    healpy.write_map(tmp_path / "cmb.fits", np.full(12 * NSIDE**2, 50.0), column_units="uK_CMB")
    band = bands(tmp_path)["wide"]
    cmb = {"class": "CMBMap", "map_I": str(tmp_path / "cmb.fits")}
    alone = emission({"cmb": cmb}, NSIDE, band, False, "test")
    np.testing.assert_allclose(alone[0], 50e-6 * band_average(band, cmb_slope), rtol=5e-5)
    assert not alone[1:].any()
    for names in (("cmb", "dust"), ("dust", "cmb")):
        both = {"cmb": cmb, "dust": dust(tmp_path / "t.fits")}
        found = emission({name: both[name] for name in names}, NSIDE, band, False, "test")
        apart = emission({"dust": both["dust"]}, NSIDE, band, False, "test")
        np.testing.assert_allclose(found[1:], apart[1:], rtol=1e-12)
        np.testing.assert_allclose(found[0], apart[0] + alone[0], rtol=1e-12)


# ---- its frame and signs


def a_scan(made, spread=3.0, n=300):
    rng = np.random.default_rng(1)
    ra0, dec0 = np.radians([75.0, 20.0])
    ra, dec = made.offset(ra0, dec0, *rng.uniform(-1, 1, (2, n)) * np.radians(spread))
    xi, eta = rng.uniform(-1, 1, (2, 4)) * np.radians(0.5)
    o = made.observation(
        ra, dec, xi=xi, eta=eta, psi=rng.uniform(0, 6, n), centre=(ra0, dec0), fwhm=3600.0
    )
    o.focalplane.polarization_angle[:] = rng.uniform(0, 6, 4)
    o.focalplane.polarization_efficiency[:] = 0.9
    return o


def seen(o, values, frame):
    """What the detectors see of I, Q and U of the meridians of a frame."""
    cosine, sine = np.empty((2, o.n_detectors, o.n_samples))
    angles = PolarizationAngles.of(o, o.boresight_radec, frame_rotation(frame)[2])
    angles.fill(np.arange(o.n_detectors), 0, cosine, sine)
    i, q, u = values
    return i + o.focalplane.polarization_efficiency[:, None] * (q * cosine + u * sine)


@real
def test_q_and_u_are_those_of_galactic_meridians(made, tmp_path):
    o = a_scan(made)
    step = PySMSky(components={"mine": synchrotron(tmp_path / "t.fits", index=0)}, nside=128)
    # third order in pixels of 8e-3 rad, over which meridians turn by as much; the beam mixes 7e-3
    # rad of turned ones
    np.testing.assert_allclose(
        made.look(step, o), seen(o, VALUES, "galactic"), rtol=0, atol=1e-4 * VALUES[0]
    )
    o.focalplane.polarization_efficiency[:] = 0.0
    np.testing.assert_allclose(made.look(step, o), VALUES[0], rtol=1e-6)


@real
def test_the_sky_is_where_and_as_healpys_rotator_has_it(made, tmp_path):
    """Multipoles up to 12 of a Galactic map, turned by healpy's Rotator to ICRS and smoothed there,
    against the stream.
    """
    rng, lmax, fine = np.random.default_rng(3), 12, 1024
    size = healpy.Alm.getsize(lmax)
    alm = 1e-5 * (rng.normal(size=(3, size)) + 1j * rng.normal(size=(3, size)))
    alm[:, : lmax + 1] = alm[:, : lmax + 1].real
    alm[1:, healpy.Alm.getlm(lmax)[0] < 2] = 0
    path = template(tmp_path / "t.fits", healpy.alm2map(alm, 128, lmax=lmax), 128)
    component = {
        "class": "PowerLaw",
        "map_I": path,
        "freq_ref_I": "23 GHz",
        "freq_ref_P": "23 GHz",
        "map_pl_index": 0,
    }
    o = a_scan(made)
    found = made.look(PySMSky(components={"mine": component}, nside=128), o)
    turned = healpy.Rotator(coord=["G", "C"]).rotate_alm(
        healpy.smoothalm(alm.copy(), fwhm=np.radians(1.0))
    )
    maps = healpy.alm2map(turned, fine, lmax=lmax)
    x, y, z = np.moveaxis(directions(o.boresight_radec, o.focalplane.xi, o.focalplane.eta), -1, 0)
    theta, phi = np.arccos(z), np.arctan2(y, x)
    expected = seen(o, [healpy.get_interp_val(m, theta, phi) for m in maps], "icrs")
    # third order in l * 8e-3 rad = 0.1, bilinear in 12 * 1e-3 rad, healpy's G to C 0.04 arcsec from
    # astropy's; 1e-4 of the spread
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-4 * np.std(expected))


# ---- as a step

CAMERA = {
    "telescope": {"name": "dish", "diameter": "6 m"},
    "name": "c",
    "field_of_view": "1 deg",
    "net": "300 uK s(1/2)",
    "sample_rate": "20 Hz",
    "polarization": "pairs",
    "main_beam_efficiency": 1,
    "illumination_efficiency": 1,
    "bands": [
        {"name": "f090", "low": "77 GHz", "high": "106 GHz", "detectors": 80},
        {"name": "f150", "low": "127 GHz", "high": "172 GHz", "detectors": 80},
    ],
}
SCENE = {
    "site": "atacama",
    "instrument": CAMERA,
    "time": "2024-06-25T07:00",
    "target": "az 180 deg el 50 deg",
    "seed": 1,
}
SCAN = {"PointingBackAndForth": {"scan_duration": "20 s", "check_limits": "warn"}}


def file(tmp_path, **step):
    path = tmp_path / "run.yaml"
    steps = [
        SCAN,
        {"PySMSky": step},
        {"BinMap": {"pixel": "10 arcmin", "stokes": "IQU"}},
        "SaveMap",
    ]
    path.write_text(yaml.safe_dump(SCENE | {"operators": steps}))
    return path


@real
def test_each_band_has_its_own_map_and_paths_start_beside_the_file(tmp_path, monkeypatch):
    """A uniform sky: I and the degree of polarization of each map are the law's averages. Galactic
    meridians turn by 3e-3 rad within a pixel, Q and U by twice that; weights of another convention
    would make 5e-2 of these bands."""
    (tmp_path / "data").mkdir()
    component = synchrotron(tmp_path / "data" / "t.fits") | {"map_I": "data/t.fits"}
    monkeypatch.chdir("/")
    path = file(tmp_path, components={"mine": component}, nside=64)
    assert main(["run", str(path), "--output", str(tmp_path / "out")]) == 0
    for band in SCENE["instrument"]["bands"]:
        flat = Band(name="b", low=band["low"], high=band["high"])
        path = tmp_path / "out" / f"map_{band['name']}.fits"
        i, q, u = (fits.getdata(path, name) for name in "IQU")
        good = np.isfinite(i)
        assert good.sum() > 10
        laws = LAWS["synchrotron"][1][:2]
        for found, value, law in zip(
            (i, np.hypot(q, u)), (VALUES[0], np.hypot(*VALUES[1:])), laws, strict=True
        ):
            np.testing.assert_allclose(found[good], value * band_average(flat, law), rtol=1e-2)


@real
@pytest.mark.parametrize("of", ["s0", "co1", "rg3"])
def test_nothing_is_downloaded_unless_it_is_asked_for(tmp_path, capsys, monkeypatch, of):
    """rg3 puts the names of its files together from what PySM lists; co1's stand in its class."""
    monkeypatch.delenv("PYSM_LOCAL_DATA", raising=False)
    monkeypatch.setattr("socket.socket.connect", None)
    path = file(tmp_path, models=[of], nside=64)
    with set_temp_cache(tmp_path):
        before = data.conf.allow_internet
        assert main(["run", str(path), "--output", str(tmp_path / "out")]) == 2
        assert data.conf.allow_internet == before
        said = capsys.readouterr().err
        assert "PySMSky" in said
        assert "set download: true" in said
        assert "PYSM_LOCAL_DATA" in said
        assert main(["check", str(path)]) == 2
        assert {"s0": "pysm_2/synch_t_new.fits", "co1": "co/HFI", "rg3": "001.0.fits"}[
            of
        ] in capsys.readouterr().err


@real
@pytest.mark.parametrize(
    ("model", "nside", "template"),
    [
        ("co1", 512, "co/HFI_CompMap_CO-Type1_512_R2.00_ring.fits"),
        ("co2", 2048, "co/HFI_CompMap_CO-Type1_2048_R2.00_ring.fits"),
        ("rg1", 16, "websky/0.4/radio/radio_0017.0.fits"),
        ("rg3", 16, "websky/0.4/radio_catalog/background/2048/001.0.fits"),
        ("cib1", 16, "websky/0.4/cib/cib_0017.0.fits"),
    ],
)
def test_templates_whose_names_classes_put_together_are_looked_for(
    tmp_path, monkeypatch, model, nside, template
):
    """Without reading them: what is there here is no FITS file."""
    monkeypatch.setenv("PYSM_LOCAL_DATA", str(tmp_path))
    with set_temp_cache(tmp_path):
        step = PySMSky(models=[model], nside=nside)
        with pytest.raises(InputError, match=template):
            step.check(None)
        (tmp_path / template).parent.mkdir(parents=True)
        (tmp_path / template).write_text("one template")
        assert model in step.check(None)[0]


@real
def test_templates_are_found_where_pysm_looks_for_them(tmp_path, monkeypatch):
    """In PYSM_LOCAL_DATA, in astropy's cache, and where `download` fetches them; a preset is then
    the component that it names.
    """
    (tmp_path / "pysm_2").mkdir()
    for k, name in enumerate("tqu"):
        values = np.full(12 * NSIDE**2, 1e6 * VALUES[k])
        healpy.write_map(
            tmp_path / f"pysm_2/synch_{name}_new.fits",
            values,
            column_units="uK_RJ",
            dtype=np.float64,
        )
    band, found = bands(tmp_path)["wide"], []
    step = PySMSky(models=["s0"], nside=NSIDE)
    monkeypatch.setenv("PYSM_LOCAL_DATA", str(tmp_path))
    step.check(None)
    config = configuration(step.models, {}, "test")
    found.append(emission(config, NSIDE, band, False, "test"))
    monkeypatch.delenv("PYSM_LOCAL_DATA")
    (tmp_path / "cache").mkdir()
    with set_temp_cache(tmp_path / "cache"):
        with pytest.raises(InputError, match="neither files nor templates"):
            step.check(None)
        monkeypatch.setattr("pysm3.utils.data.DATAURL", f"{(tmp_path / 'none').as_uri()}/")
        with pytest.raises(InputError, match="neither files") as caught:
            emission(config, NSIDE, band, True, "test")
        assert "check the network" in str(caught.value)
        monkeypatch.setattr("pysm3.utils.data.DATAURL", f"{tmp_path.as_uri()}/")
        PySMSky(models=["s0"], nside=NSIDE, download=True).check(None)
        found.append(emission(config, NSIDE, band, True, "test"))
        step.check(None)  # now they are in the cache
        found.append(emission(config, NSIDE, band, False, "test"))
    for maps in found:
        np.testing.assert_array_equal(maps, found[0])
    laws = (lambda nu: (nu / 408e6) ** -3.0, lambda nu: (nu / 23e9) ** -3.0)
    for got, value, law in zip(found[0], VALUES, (laws[0], laws[1], laws[1]), strict=True):
        np.testing.assert_allclose(got, value * band_average(band, law), rtol=2.7e-5)


@real
@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"models": ["d111"]}, "PySM has no model 'd111'.*did you mean 'd11'"),
        ({"components": {"mine": {"class": "PowrLaw"}}}, "PySM: KeyError: 'PowrLaw'"),
        (
            {"components": {"mine": {"class": "PowerLaw", "colour": "red"}}},
            "unexpected keyword argument 'colour'",
        ),
        (
            {
                "components": {
                    "mine": {
                        "class": "PowerLaw",
                        "map_I": "absent.fits",
                        "freq_ref_I": "1 GHz",
                        "map_pl_index": -3,
                    }
                }
            },
            "absent.fits.*correct the path",
        ),
    ],
)
def test_what_pysm_does_not_take_is_refused_with_its_place(made, given, match):
    step = PySMSky(**given)

    def tried():
        step.check(None)
        step.prepare(a_scan(made))

    with pytest.raises(InputError, match=f"(?s){match}") as caught:
        tried()
    assert caught.value.place == "PySMSky"


@real
def test_random_models_have_the_same_bits_and_leave_numpys_generator_alone(tmp_path):
    config = {
        "mine": (
            dust(tmp_path / "t.fits")
            | {
                "class": "DecorrelatedModifiedBlackBody",
                "correlation_length": 0.1,
            }
        )
    }
    np.random.seed(5)  # noqa: NPY002
    expected = np.random.random()  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    one, other = (emission(config, NSIDE, bands(tmp_path)["wide"], False, "test") for _ in range(2))
    assert np.random.random() == expected  # noqa: NPY002
    np.testing.assert_array_equal(one, other)
    drawn = {"mine": {"a": {"class": "PowerLawRealization"}, "b": {"class": "PowerLaw"}}}
    assert _seeded(drawn, importlib.import_module("pysm3").models)["mine"]["a"][
        "seeds"
    ]  # without, each run has another sky
    assert "seeds" not in _seeded(drawn, importlib.import_module("pysm3").models)["mine"]["b"]


@real
def test_it_keeps_the_contract_and_a_plan_knows_its_brightness(made, tmp_path):
    step = PySMSky(components={"mine": synchrotron(tmp_path / "t.fits")}, nside=64)
    check_operator(step)
    o = a_scan(made)
    planning = planning_class(PySMSky)(step)
    assert planning.traits(o).peak == pytest.approx(
        np.abs(step.sky(o).map.hdu.data["I"]).max(), rel=1e-6
    )
    assert planning.memory(o) > 12 * 64**2 * 8 * 6
