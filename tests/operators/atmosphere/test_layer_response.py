"""Layers whose water emits and absorbs as it does at its height, and the strength of the turbulence
by elevation.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

import zonda
from zonda.core.configuration.time import Instant
from zonda.core.errors import ZondaError
from zonda.core.instrument import Band
from zonda.core.operator import Operator
from zonda.core.registry import sites
from zonda.operators.atmosphere.distribution import Slab, air_correlation
from zonda.operators.atmosphere.planning import calibrated
from zonda.operators.atmosphere.response import LayerTerms, kappa
from zonda.operators.atmosphere.turbulence.covariance import correlation
from zonda.operators.atmosphere.weather.bands import BandAtmosphere
from zonda.operators.atmosphere.weather.climatology import profile
from zonda.operators.atmosphere.weather.radiative_transfer import (
    emission,
    emission_slopes,
    spectrum,
)
from zonda.testing import check_operator

HEIGHTS = np.array([500.0, 1500.0, 2500.0, 3500.0, 5000.0])
SCENES = {"chajnantor": ("2022-08-01T03:00", 1e-3), "green_bank": ("2024-11-25T07:00", 7.7e-3)}


def air(site):
    when, pwv = SCENES[site]
    return profile(sites.create(site), Instant.parse(when)), pwv


def band(low, high):
    return Band(name="b", low=f"{low} GHz", high=f"{high} GHz")


# --------------------------------------------------------------------------------------------------
# kappa


def test_slopes_of_the_emission_are_its_derivatives():
    """Central differences of 1e-5 relative steps: 1e-10 of second order, 1e-11 of rounding over the
    step.
    """
    rng = np.random.default_rng(1)
    t, source = rng.gamma(0.6, 0.4, (7, 5)), rng.uniform(180, 290, (8, 5))
    t[2], t[3] = 3e-4, 2e-3  # on both sides of where the closed form loses digits
    for k in range(7):
        step = np.zeros_like(t)
        step[k] = 1e-5 * t[k]
        slope = (emission(t + step, source) - emission(t - step, source)) / (2 * step[k])
        # 300 K x 2e-16 over the step of the thinnest layer
        np.testing.assert_allclose(
            emission_slopes(t, source)[k], slope, rtol=1e-6, atol=300 * 4e-16 / step[k].min()
        )


@pytest.mark.parametrize("site", SCENES)
@pytest.mark.parametrize(("low", "high"), [(92, 94), (140, 160), (394, 428)])
def test_kappa_is_what_water_at_a_height_changes(site, low, high):
    """Against spectra of the profile with 2 % more and less water in one level, and in all."""
    profile_, pwv = air(site)
    layers, elevation = profile_.layers.scaled(pwv), math.radians(50)
    weights = band(low, high)

    def brightness(h2o):
        found = spectrum(replace(layers, h2o=h2o), elevation, low=low * 1e9, high=high * 1e9)
        inside = np.clip(found.frequency + 0.25e9, low * 1e9, high * 1e9) - np.clip(
            found.frequency - 0.25e9, low * 1e9, high * 1e9
        )
        return float(found.brightness @ inside / inside.sum())

    def slope(which):
        step = np.where(which, 0.02, 0.0)
        more, less = layers.h2o * (1 + step), layers.h2o * (1 - step)
        water = replace(layers, h2o=more).water.sum() - replace(layers, h2o=less).water.sum()
        return (brightness(more) - brightness(less)) / water

    column = slope(np.ones(len(layers.h2o), bool))
    levels = [int(np.argmin(np.abs(layers.middle - h))) for h in HEIGHTS]
    expected = [slope(np.arange(len(layers.h2o)) == k) / column for k in levels]
    found = kappa(
        BandAtmosphere(weights, profile_, 3 * pwv), pwv, elevation, layers.middle[levels]
    )["emission"]
    # The half-cells at the band's edges stand elsewhere in their cell here: 1e-3 in lines.
    np.testing.assert_allclose(found, expected, rtol=3e-3)


OF_AM = {
    ("chajnantor", 93): {500: 1.1409, 1500: 0.9606, 2500: 0.8434, 3500: 0.7601, 5000: 0.6157},
    ("chajnantor", 150): {500: 1.1324, 1500: 0.9677, 2500: 0.8557, 3500: 0.7744, 5000: 0.6318},
    ("green_bank", 93): {500: 1.2610, 5000: 0.5754},
}
"""kappa by am 14.0 at the levels of the product's profile nearest to these heights: 1 GHz wide, 50
deg, +-20 % of the water.
"""


@pytest.mark.parametrize(("site", "frequency"), OF_AM)
def test_kappa_is_that_of_am(site, frequency):
    profile_, pwv = air(site)
    expected = OF_AM[site, frequency]
    at = [int(np.argmin(np.abs(profile_.layers.middle - h))) for h in expected]
    atmosphere = BandAtmosphere(band(frequency - 0.5, frequency + 0.5), profile_, 3 * pwv)
    found = kappa(atmosphere, pwv, math.radians(50), profile_.layers.middle[at])["emission"]
    np.testing.assert_allclose(
        found, list(expected.values()), rtol=2e-3
    )  # the table of cross-sections against am itself


@pytest.mark.parametrize("site", SCENES)
@pytest.mark.parametrize("name", ["emission", "opacity"])
def test_kappa_over_the_whole_column_is_the_column(site, name):
    """int kappa rho_v dh = PWV, by trapezoids over the profile up to its top; below the lowest
    middle kappa is held.
    """
    profile_, pwv = air(site)
    atmosphere = BandAtmosphere(band(78, 108), profile_, 3 * pwv)
    scaled = profile_.scaled(pwv)
    h = np.linspace(0, 40e3, 8001)
    density = scaled.at(h).vapour_density
    found = np.trapezoid(kappa(atmosphere, pwv, math.radians(60), h)[name] * density, h) / 1000.0
    assert np.trapezoid(density, h) / 1000.0 == pytest.approx(
        pwv, rel=5e-3
    )  # geopotential against geometric metres
    assert found == pytest.approx(
        np.trapezoid(density, h) / 1000.0, rel=5e-3
    )  # kappa is linear between levels 170 m apart
    # And in the sum over the levels exactly.
    water = atmosphere.transfer.of_water(pwv, [math.radians(60)])
    assert float(getattr(water, name)[0] @ water.water / water.of_column(name)[0]) == pytest.approx(
        pwv, rel=1e-12
    )
    step = pwv * 1e-4
    direct = {
        "emission": atmosphere.emission_difference(pwv, step, math.radians(60)),
        "opacity": -atmosphere.log_transmission_difference(pwv, step, math.radians(60)),
    }[name]
    # The Chebyshev table's own error of a slope is 3e-4; the column's water takes the place of air
    # here as there.
    assert float(water.of_column(name)[0]) == pytest.approx(float(direct) / step, rel=1e-3)


@pytest.mark.parametrize(("low", "high", "most"), [(78, 108, 2), (394, 428, 4), (640, 680, 8)])
def test_terms_follow_the_elevation_of_a_dip(low, high, most):
    profile_, pwv = air("chajnantor")
    atmosphere = BandAtmosphere(band(low, high), profile_, 3 * pwv)
    ends = math.sin(math.radians(20)), math.sin(math.radians(80))
    terms = LayerTerms.of(atmosphere, pwv, HEIGHTS, 0.02, ends)
    assert max(terms.degrees) <= most
    assert max(LayerTerms.of(atmosphere, pwv, HEIGHTS, 0.02, (0.7, 0.702)).degrees) <= 1
    s = np.linspace(*ends, 29)
    water = atmosphere.transfer.of_water(pwv, np.arcsin(s).tolist())
    for name in ("emission", "opacity"):
        own, column = pwv * water.at(name, HEIGHTS), pwv * water.of_column(name)[:, None]
        largest = np.abs(own * s[:, None]).max()
        for k in range(len(HEIGHTS)):
            out = np.zeros((1, len(s)))
            terms.add(
                name, terms.weights[:, k, None, None] * np.ones((1, len(s))), s[None], out
            )  # of a layer with a g = 1
            expected = 0.02 * (own - column)[:, k]
            assert (
                np.abs((out[0] - expected) * s).max() <= 0.02 * 1e-3 * largest
            )  # twice the error that degrees are chosen for


# --------------------------------------------------------------------------------------------------
# simulation


class Keep(Operator):
    """Keeps the streams."""

    requires = frozenset({"atmosphere", "transmission", "pwv", "opacity"})
    knows_means = True

    def prepare(self, observation):
        return observation.detdata

    def exec(self, block, state):
        for name in self.requires:
            whole = state.setdefault(
                name, np.zeros((block.observation.n_detectors, block.observation.n_samples))
            )
            whole[block.detectors, block.samples] = block.detdata[name]


def scene(elevation=50, site="chajnantor", detectors=19, **given):
    instrument = zonda.Instrument(
        name="c",
        detectors=detectors,
        field_of_view="0.5 deg",
        fwhm="2 arcmin",
        net="0.3 mK s(1/2)",
        knee="0 Hz",
        sample_rate="20 Hz",
        main_beam_efficiency=0.8,
        illumination_efficiency=0.8,
        **(
            {
                "telescope": {"name": "t", "diameter": "6 m"},
                "band": {"name": "b", "low": "77 GHz", "high": "106 GHz"},
            }
            | given
        ),
    )
    return zonda.Scene(
        site=site,
        instrument=instrument,
        time=SCENES[site][0],
        target=f"az 40 deg el {elevation} deg",
        seed=3,
    )


def simulated(elevation=50, scan=None, *, on=None, **given):
    given = {"pwv": "1 mm", "pwv_rms": "0.1 %", "outputs": ["pwv", "opacity"]} | given
    scan = scan or zonda.PointingDaisy(radius="0.2 deg", speed="0.2 deg/s", scan_duration="40 s")
    operators = [scan, zonda.AtmosphereLayers(**given), Keep(), zonda.Efficiency()]
    data = zonda.Pipeline(operators).run(on or scene(elevation))
    observation = data.observations[0]
    return observation.detdata, observation.expected_load.model()


def test_one_layer_has_its_own_response():
    """Of a weak fluctuation of one layer alone the emission is kappa_l times the column's, the
    water's the same bits.
    """
    for k in (0, 2, 4):
        omit = [n for n in range(5) if n != k]
        layer, model = simulated(layers=5, omit=omit)
        column, _ = simulated(layers=5, omit=omit, layer_response="column")
        assert layer["pwv"].tobytes() == column["pwv"].tobytes()
        # Over 1 deg of elevation kappa changes by 1e-3; the second order of 0.4 % of fluctuation is
        # 1e-3.
        for stream, name in (("atmosphere", "emission"), ("opacity", "opacity")):
            slope = float((layer[stream] * column[stream]).sum() / (column[stream] ** 2).sum())
            assert slope == pytest.approx(float(model.kappa[name][k]), rel=2e-3)
        np.testing.assert_allclose(
            layer["transmission"], np.expm1(-layer["opacity"]), rtol=1e-6, atol=1e-12
        )


@pytest.mark.parametrize(
    ("site", "pwv", "growth"), [("chajnantor", "1 mm", 1.06), ("green_bank", "7.7 mm", 1.105)]
)
def test_fluctuations_grow(site, pwv, growth):
    """sqrt(sum a^2 kappa^2) with `weights: vapour`: 6 % above Chajnantor, 10 to 11 % above Green
    Bank (by season and hour).
    """
    _, model = simulated(on=scene(site=site), pwv=pwv)
    shares = np.array([layer.amplitude for layer in model.layers])
    assert (shares**2).sum() == pytest.approx(1, rel=1e-12)  # not renormalized
    assert math.sqrt(sum(layer.amplitude**2 for layer in model.emitting)) == pytest.approx(
        growth, abs=0.012
    )


def test_the_plan_follows():
    for response in ("layer", "column"):
        _, model = simulated(layers=5, layer_response=response)
        found = calibrated(model)
        expected = np.array([layer.amplitude for layer in model.layers])
        if response == "layer":
            expected = (
                expected * kappa(model.band, model.pwv, model.elevation, model.heights)["emission"]
            )
        rms = [found.of_layer(k) / (found.kelvin * math.sqrt(found.variances[k])) for k in range(5)]
        np.testing.assert_allclose(rms, np.abs(expected), rtol=1e-12)


# -----------------------------------------------------------------------------------------------
# strength by elevation


def test_the_air_is_correlated_as_its_layers_are():
    """A sheet of depth much beyond the outer scale has the covariance of `turbulence.covariance`
    across the line of sight: int C_3(sqrt(r^2 + z^2)) dz ~ C(r), nu = 1/3 becoming 5/6."""
    z = np.concatenate([[0.0], np.geomspace(1e-6, 40, 4000)])
    for r in (0.3, 1.0, 2.5):
        across = np.trapezoid(air_correlation(np.hypot(r, z)), z) / np.trapezoid(
            air_correlation(z), z
        )
        assert across == pytest.approx(float(correlation(r)[0]), rel=2e-3)
    assert air_correlation(np.array([0.0, 1e-13, 1e-6])) == pytest.approx([1, 1, 1], abs=3e-4)


def test_a_slab_by_hand():
    """Against the double integral of equation (1) on a grid, evenly spread and with the vapour's
    profile.
    """
    profile_, _ = air("chajnantor")
    h = np.linspace(500, 5000, 901)
    for source in (None, profile_):
        slab = Slab(source, 500.0, 5000.0, 500.0)
        density = np.ones(h.size) if source is None else source.at(h).vapour_density
        ends = np.ones(h.size)
        ends[[0, -1]] = 0.5
        weight = density * ends

        def sigma2(elevation, weight=weight):
            s = math.sin(elevation)
            return (
                float(weight @ air_correlation(np.abs(h[:, None] - h) / s / 500.0) @ weight) / s**2
            )

        for degrees in (20, 30, 60):
            s = math.sin(math.radians(degrees))
            fraction = math.sqrt(sigma2(math.radians(degrees)) / sigma2(math.pi / 2)) * s
            assert float(slab.share(s)) == pytest.approx(fraction, rel=2e-3)


def test_limits_of_a_slab():
    """Deep beside the outer scale: airmass^(1/2) in metres, so sin^(1/2) of the line of sight's
    water; shallow: airmass, so 1.
    """
    assert float(Slab(None, 100.0, 20000.0, 10.0).share(0.5)) == pytest.approx(
        math.sqrt(0.5), rel=2e-3
    )
    assert float(Slab(None, 1000.0, 1001.0, 5000.0).share(0.5)) == pytest.approx(1, rel=5e-3)
    profile_, _ = air("chajnantor")
    assert 0.70 < float(Slab(profile_, 500.0, 5000.0, 500.0).share(0.5)) < 0.80
    assert float(Slab(profile_, 500.0, 5000.0, 500.0).share(1.0)) == pytest.approx(1, rel=1e-12)


def test_one_value_for_a_scan():
    """In the layers' own units the field is the same: the PWV's fluctuation is that of `scan` times
    the slab's share.
    """
    for elevation in (35, 60):
        at_scan, _ = simulated(elevation, pwv_rms="1 %")
        at_zenith, model = simulated(elevation, pwv_rms="1 %", pwv_rms_at="zenith")
        share = float(model.slab.share(math.sin(model.elevation)))
        assert share < math.sin(math.radians(elevation)) ** 0.35
        np.testing.assert_allclose(
            at_zenith["pwv"],
            share * at_scan["pwv"],
            rtol=0,
            atol=1e-6 * np.abs(at_scan["pwv"]).max(),
        )


def test_after_the_beam_of_a_telescope_that_looks_up():
    """The beam widens with distance: what a pencil beam would see at the zenith is what the slab
    makes of at the scan.
    """
    small = scene(30, detectors=7, telescope={"name": "t", "diameter": "0.5 m"})
    _, model = simulated(on=small, pwv_rms="1 %", pwv_rms_at="zenith", pwv_rms_after_beam=True)
    before, after = model.fluctuation.before_and_after()
    share = float(model.slab.share(math.sin(model.elevation)))
    up = model._variance_at_zenith
    assert before == pytest.approx(0.01 / math.sqrt(up) * share, rel=1e-9)
    assert after < 0.01 * share  # the column that 0.5 m see is wider at 30 deg


def test_a_dip_has_its_strength_by_sample():
    """Rows of 20 deg of elevation: the same field, as strong as the slab is at each elevation; the
    emission follows.
    """
    scan = zonda.PointingRaster(
        width="1 deg",
        height="20 deg",
        spacing="2 deg",
        speed="3 deg/s",
        scan_duration="40 s",
        axes="horizontal",
    )
    for detectors in (19, 3):  # interpolated from nodes, and detector by detector
        on = scene(50, detectors=detectors)
        at_scan, _ = simulated(scan=scan, on=on, pwv_rms="1 %", tolerance="0.1 %")
        at_zenith, model = simulated(
            scan=scan, on=on, pwv_rms="1 %", pwv_rms_at="zenith", tolerance="0.1 %"
        )
        o = model.observation
        strength = model.slab.share(
            np.sin(o.elevation)
        )  # of the boresight; the field is 0.25 deg wide: 0.4 %
        assert np.ptp(strength) > 0.1
        for name in ("pwv", "atmosphere"):
            expected = at_scan[name] * strength
            rms = float(np.sqrt(np.mean(expected**2)))
            assert float(np.sqrt(np.mean((at_zenith[name] - expected) ** 2))) < 0.01 * rms


def test_a_single_layer_has_no_depth():
    with pytest.raises(ZondaError, match="zenith needs several layers"):
        zonda.AtmosphereLayers(layers=1, pwv_rms_at="zenith")


@pytest.mark.parametrize("given", [{}, {"pwv_rms_at": "zenith", "pwv_rms": "20 %"}])
def test_it_keeps_the_contract(given):
    """Among others the same bits for any block and number of threads."""
    check_operator(zonda.AtmosphereLayers(**({"pwv": "5 mm"} | given)))
