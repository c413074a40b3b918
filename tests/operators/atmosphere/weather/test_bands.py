import math

import mpmath
import numpy as np
import pytest

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import rayleigh_jeans
from zonda.core.site import Site
from zonda.operators.atmosphere.weather.absorption import absorption_table
from zonda.operators.atmosphere.weather.bands import BandAtmosphere, _cells
from zonda.operators.atmosphere.weather.climatology import profile
from zonda.operators.atmosphere.weather.radiative_transfer import spectrum

PWV = 7.7e-3


@pytest.fixture(scope="module")
def air():
    green_bank = Site(
        name="gb",
        latitude="38.43 deg",
        longitude="-79.84 deg",
        altitude="825 m",
        climatology="green_bank",
    )
    return profile(green_bank, Instant.parse("2024-11-25T07:00:00Z"), PWV)


def band(low, high):
    return Band(name="test", low=f"{low} GHz", high=f"{high} GHz")


@pytest.fixture(scope="module")
def mustang2(air):
    return BandAtmosphere(band(78, 108), air)


def test_band_values_are_the_spectrum_averaged_with_the_passband(air, mustang2):
    elevation = math.radians(42)
    s = spectrum(air.layers, elevation, low=77e9, high=109e9)
    frequency, weight = np.arange(78, 108.1, 0.5), np.ones(61)
    weight[[0, -1]] = 0.5  # the band begins and ends in the middle of a cell
    frequency[[0, -1]] = 78.125, 107.875
    average = lambda x: np.average(np.interp(frequency * 1e9, s.frequency, x), weights=weight)  # noqa: E731
    assert mustang2.emission(PWV, elevation) == pytest.approx(average(s.brightness), rel=2e-5)
    assert mustang2.transmission(PWV, elevation) == pytest.approx(
        average(np.exp(-s.slant_opacity)), rel=2e-5
    )
    assert mustang2.opacity(PWV, elevation) == pytest.approx(
        -math.log(average(np.exp(-s.slant_opacity))), rel=1e-4
    )


def test_shipped_job_has_the_expected_atmosphere(mustang2):
    # ERA5's own profile of a like night, at zenith: 28.8 K (am_era5_green_bank_nov_02h.npz); at 60
    # deg 1.15 times the air
    assert mustang2.emission(PWV, math.radians(60)) == pytest.approx(33.1, abs=0.4)
    assert mustang2.transmission(PWV, math.radians(60)) == pytest.approx(0.874, abs=0.003)


# the stated interpolation error, also where a water line is saturated
@pytest.mark.parametrize(
    ("low", "high"),
    [(78, 108), (66, 118), (130, 170), (175, 195), (200, 270), (540, 575), (92.9, 93.1)],
)
def test_interpolation_against_radiative_transfer(air, low, high):
    table = BandAtmosphere(band(low, high), air)
    assert table.error < 1e-5
    rng = np.random.default_rng(2)
    for pwv, elevation in zip(
        rng.uniform(0, table.pwv_max, 40), np.radians(rng.uniform(5, 90, 40)), strict=True
    ):
        emission, log_transmission = table.transfer(pwv, [elevation])[0]
        assert table.emission(pwv, elevation) == pytest.approx(emission, rel=1e-4)
        assert table.log_transmission(pwv, elevation) == pytest.approx(log_transmission, rel=1e-4)


def test_derivative_against_radiative_transfer(mustang2):
    step, elevation = 1e-3 * PWV, math.radians(60)
    up, down = (mustang2.transfer(PWV + s, [elevation])[0] for s in (step, -step))
    # a central difference: its own error is (1e-3)^2
    assert mustang2.emission_difference(PWV, 1e-9, elevation) / 1e-9 == pytest.approx(
        (up[0] - down[0]) / 2 / step, rel=1e-4
    )
    got = mustang2.log_transmission_difference(PWV, 1e-9, elevation) / 1e-9
    assert got == pytest.approx((up[1] - down[1]) / 2 / step, rel=1e-4)


def exact_difference(table, which, pwv, dpwv, elevation):
    """The same polynomial in 50 digits."""
    _, n_v = table._coefficients.shape[1:]
    with mpmath.workdps(50):
        fixed = np.polynomial.chebyshev.chebvander(table._y(np.array([elevation])), n_v - 1)[0]
        rows = table._coefficients[which]
        line = [
            mpmath.fsum(mpmath.mpf(c) * mpmath.mpf(f) for c, f in zip(row, fixed, strict=True))
            for row in rows
        ]
        x = lambda p: 2 * mpmath.log1p(p / mpmath.mpf(table._scale)) / mpmath.mpf(table._u_max) - 1  # noqa: E731
        value = lambda p: mpmath.fsum(c * mpmath.chebyt(k, x(p)) for k, c in enumerate(line))  # noqa: E731
        return float(value(mpmath.mpf(pwv) + mpmath.mpf(dpwv)) - value(mpmath.mpf(pwv)))


@pytest.mark.parametrize("relative", [0.3, 1e-2, -5e-3, 1e-6, 1e-10, -1e-14])
def test_differences_do_not_cancel(mustang2, relative):
    elevation, step = 0.9, relative * PWV
    for which, method in (
        (0, mustang2.emission_difference),
        (1, mustang2.log_transmission_difference),
    ):
        want = exact_difference(mustang2, which, PWV, step, elevation)
        assert method(PWV, step, elevation) == pytest.approx(want, rel=1e-11)
    # and a zero step is exactly nothing
    assert mustang2.emission_difference(PWV, 0.0, elevation) == 0


def test_differences_add_up_to_the_emission(mustang2):
    pwv = np.linspace(5e-3, 9e-3, 50)
    rebuilt = mustang2.emission(PWV, 1.0) + mustang2.emission_difference(PWV, pwv - PWV, 1.0)
    np.testing.assert_allclose(rebuilt, mustang2.emission(pwv, 1.0), rtol=1e-13)


def test_transmission_is_averaged_never_the_opacity(air):
    wet = air.scaled(20e-3)
    s = spectrum(wet.layers, math.pi / 2, low=175e9, high=195e9)
    table = BandAtmosphere(band(175, 195), wet)
    assert table.transmission(20e-3, math.pi / 2) > 1.5 * math.exp(-s.opacity.mean())


def test_wet_air_needs_no_limit(air):
    table = BandAtmosphere(band(78, 108), air.scaled(40e-3))
    assert table.pwv_max == 60e-3
    assert table.emission(60e-3, math.radians(5)) > 200


def test_opaque_band_underflows_nowhere(air):
    table = BandAtmosphere(band(556, 558), air)
    opacity = table.opacity(table.pwv_max, math.radians(5))
    assert 1000 < opacity < 1e6
    assert table.transmission(table.pwv_max, math.radians(5)) == 0.0
    assert np.isfinite(table.log_transmission_difference(table.pwv_max / 2, 1e-6, math.radians(5)))
    ground = float(rayleigh_jeans(557e9, air.temperature[0]))
    assert table.emission(table.pwv_max, math.radians(5)) == pytest.approx(ground, rel=1e-3)


def test_monotone_and_physical(mustang2):
    pwv, elevation = np.meshgrid(
        np.linspace(0, mustang2.pwv_max, 40), np.radians(np.linspace(5, 90, 30)), indexing="ij"
    )
    t, loss = mustang2.emission(pwv, elevation), mustang2.opacity(pwv, elevation)
    for field in (t, loss):
        assert field.shape == pwv.shape
        assert field.dtype == np.float64
        assert (np.diff(field, axis=0) > 0).all()  # more water, more of both
        assert (np.diff(field, axis=1) < 0).all()  # higher up, less of both
    assert (t < 290).all()


def test_a_value_does_not_depend_on_its_neighbours(mustang2):
    rng = np.random.default_rng(3)
    pwv, elevation = (
        PWV * (1 + 0.05 * rng.standard_normal((9, 300))),
        np.radians(rng.uniform(40, 60, 300)),
    )
    whole = mustang2.emission_difference(PWV, pwv - PWV, elevation)
    parts = [
        mustang2.emission_difference(PWV, pwv[:, k : k + 37] - PWV, elevation[k : k + 37])
        for k in range(0, 300, 37)
    ]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole)


def test_passband_is_integrated_within_cells(tmp_path):
    weights, _, frequency, _ = _cells(band(92.9, 93.1), absorption_table())
    assert weights == pytest.approx([0.2e9])
    assert frequency == pytest.approx([93.0e9])
    weights, _, frequency, cells = _cells(band(77.9, 80.3), absorption_table())
    assert weights.sum() == pytest.approx(2.4e9, rel=1e-12)
    assert cells.stop - cells.start == len(weights) == 6
    np.testing.assert_allclose(
        frequency, np.array([78.075, 78.5, 79, 79.5, 80, 80.275]) * 1e9
    )  # the middles of what is covered
    path = tmp_path / "ramp.txt"
    path.write_text("90 0\n91 1\n")
    weights, _, frequency, _ = _cells(Band(name="ramp", file=path), absorption_table())
    # cells 90 (half), 90.5, 91 (half): integral of nu - 90 from 0 to 1/4, 1/4 to 3/4, 3/4 to 1
    np.testing.assert_allclose(weights, np.array([1 / 32, 1 / 4, 7 / 32]) * 1e9, rtol=1e-9)
    np.testing.assert_allclose(
        frequency[[0, 2]], np.array([90 + 1 / 6, 90 + 37 / 42]) * 1e9, rtol=1e-12
    )
    path.write_text("0.1 0\n90 0\n91 1\n92 0\n2000 0\n")
    weights, *_ = _cells(Band(name="padded", file=path), absorption_table())
    assert weights.sum() == pytest.approx(1e9, rel=1e-12)


def test_limits_are_named(air, mustang2):
    with pytest.raises(
        InputError,
        match=r"PWV of 30 mm \(value 1 of 2\) is outside the table of band 'test', 0 to 23\.1 mm",
    ):
        mustang2.emission([PWV, 30e-3], 1.0)
    with pytest.raises(InputError, match=r"PWV of -1 mm"):
        mustang2.transmission(-1e-3, 1.0)
    with pytest.raises(InputError, match=r"PWV of nan mm"):
        mustang2.transmission(math.nan, 1.0)
    with pytest.raises(InputError, match=r"PWV of 27\.7 mm"):
        mustang2.emission_difference(PWV, 20e-3, 1.0)
    with pytest.raises(
        InputError, match=r"elevations of 4\.00 to 4\.00 deg leave the limits .*4.5 to 90 deg"
    ):
        mustang2.emission(PWV, math.radians(4))
    with pytest.raises(
        InputError,
        match=r"band 'test': 990 to 1010 GHz is not inside .* table, 0\.75 to 1000\.25 GHz",
    ):
        BandAtmosphere(band(990, 1010), air)
    with pytest.raises(InputError, match="outside the limits, 0 to 60 mm"):
        BandAtmosphere(band(78, 108), air, pwv_max=0.1)
    with pytest.raises(InputError, match="the profile is dry"):
        BandAtmosphere(band(78, 108), air.scaled(0.0))
