"""Claims files: what is wrong with them is said at its place; the shipped one is right."""

import math
import re

import pytest

from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.errors import ZondaError
from zonda.plugins.validation.calculations import (
    CALCULATIONS,
    beam_width,
    daisy_reach,
    disc_overlap,
    far_field_fwhm,
    flux_per_beam,
    gaussian_overlap,
    rayleigh_distance,
    white_noise_of_daisy,
)
from zonda.plugins.validation.claims import SHIPPED, read

ROW = {
    "id": "a",
    "section": "'1'",
    "claim": "A is 1.",
    "paper": "1",
    "calculate": "{stated: {value: 1}}",
}


def written(tmp_path, *, leave_out=(), **more):
    """A claims file of one row, changed."""
    row = {k: v for k, v in {**ROW, **more}.items() if k not in leave_out}
    path = tmp_path / "claims.yaml"
    path.write_text(
        "paper: P\nclaims:\n  - " + "\n    ".join(f"{k}: {v}" for k, v in row.items()) + "\n"
    )
    return path


def test_the_shipped_claims_are_right_and_of_the_paper():
    claims = read(SHIPPED).claims
    assert len({claim.id for claim in claims}) == len(claims)
    assert sum(claim.is_quick for claim in claims) >= 15
    for claim in claims:
        assert claim.claim.endswith("."), claim.id
        assert not claim.because or claim.counter


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"claims": 1}, "claims"),
        ({"paper": "148 fortnights"}, "unknown unit 'fortnights'"),
        ({"paper": "much"}, "expected a number and its unit"),
        ({"relation": "near"}, "relation"),
        ({"calculate": "{rayleigh: {aperture: 1 m}}"}, "there is no calculation 'rayleigh'"),
        ({"calculate": "{rayleigh_distance: {aperture: 1 m}}"}, "frequency"),
        ({"calculate": "{rayleigh_distance: {aperture: 1 s, frequency: 1 GHz}}"}, "a unit of time"),
        ({"pipeline": "mustang2", "metric": "central_rms"}, "calculate stands alone"),
        ({"seeds": 0}, "seeds"),
        ({"because": "It is so."}, "needs a counter-experiment"),
        ({"needs": "the real map"}, "needs stands alone"),
        ({"counter": "[{name: b, shows: x, expect: {agrees: true, above: 1}}]"}, "give either"),
        ({"counter": "[{name: b, shows: x, expect: {}}]"}, "give either"),
        ({"section": "''"}, "section"),
    ],
)
def test_mistakes_are_named_with_their_place(tmp_path, change, message):
    path = written(tmp_path, **change)
    with pytest.raises(ConfigurationError, match=re.escape(message)) as caught:
        read(path)
    assert all(d.span.source.name == str(path) for d in caught.value.diagnostics)
    assert caught.value.diagnostics[0].place.startswith(f"{path}:")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {
                "counter": (
                    "[{name: b, shows: x, calculate: {stated: {value: 1}}, expect: {agrees: true}}]"
                )
            },
            "the claim's own experiment",
        ),
        (
            {"counter": "[{name: b, shows: x, expect: {agrees: true}}]"},
            "the counter-experiment b runs nothing",
        ),
        (
            {"counter": "[{name: b, shows: x, pipeline: p, expect: {agrees: true}}]"},
            "the counter-experiment b runs nothing",
        ),
    ],
)
def test_a_counter_experiment_that_changes_nothing_explains_nothing(tmp_path, change, message):
    with pytest.raises(ConfigurationError, match=message):
        read(written(tmp_path, because="It is so.", **change))


def test_other_seeds_alone_explain_nothing(tmp_path):
    given = {"pipeline": "mustang2", "metric": "central_rms", "because": "It is so."}
    for more, right in (
        ("seeds: 9", False),
        ("change: {seed: 9}", True),
        ("metric: coverage", True),
    ):
        path = written(
            tmp_path,
            leave_out=("calculate",),
            **given,
            counter=f"[{{name: b, shows: x, {more}, expect: {{above: 1 uK}}}}]",
        )
        if right:
            assert read(path).claims[0].counter
        else:
            with pytest.raises(ConfigurationError, match="the claim's own experiment"):
                read(path)


def test_a_row_without_a_way_to_measure(tmp_path):
    with pytest.raises(ConfigurationError, match="give pipeline and metric, or calculate"):
        read(written(tmp_path, leave_out=("calculate",)))


def test_two_rows_of_one_name(tmp_path):
    path = written(tmp_path)
    path.write_text(
        path.read_text()
        + "  - {id: a, section: '2', claim: B., paper: 1, calculate: {stated: {value: 1}}}\n"
    )
    with pytest.raises(ConfigurationError, match="two claims are called 'a'"):
        read(path)


@pytest.mark.parametrize("text", ["", "[1, 2]", "paper: [", "paper: P\nclaims: []"])
def test_files_that_are_none(tmp_path, text):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ZondaError):
        read(tmp_path / "c.yaml")


def test_counter_experiments_take_over_what_they_do_not_state(tmp_path):
    path = written(
        tmp_path,
        leave_out=("calculate",),
        pipeline="mustang2",
        metric="central_rms",
        seeds=5,
        change="{seed: 3}",
        counter=(
            "[{name: b, shows: x, change: {PinkNoise.shared: 0}, seeds: 2, expect: {above: 1 uK}}]"
        ),
    )
    own = dict(read(path).claims[0].experiments())
    assert own["b"].metric == "central_rms"
    assert own["b"].change == {"seed": 3, "PinkNoise.shared": 0}
    assert (own[""].seeds, own["b"].seeds) == (5, 2)


# ---- closed forms against other ways to work them out


def test_the_paper_s_beam_is_a_gaussian_beam():
    aperture, frequency = 6.0, 150e9
    z_r = rayleigh_distance(aperture, frequency)
    assert beam_width(aperture, frequency, z_r) == pytest.approx(math.sqrt(2) * aperture)
    far = 1e9
    assert beam_width(aperture, frequency, far) / far == pytest.approx(
        far_field_fwhm(aperture, frequency), rel=1e-4
    )


@pytest.mark.parametrize("overlap", [disc_overlap, gaussian_overlap])
def test_overlaps_against_sums_over_a_grid(overlap):
    aperture, frequency, distance = 6.0, 150e9, 5e3
    import numpy as np

    x = np.linspace(-30, 30, 3001)
    width = beam_width(aperture, frequency, distance)
    shift = 299792458.0 / frequency / aperture * distance
    xx, yy = np.meshgrid(x, x)

    def shape(centre):
        square = (xx - centre) ** 2 + yy**2
        if overlap is disc_overlap:
            return (square <= (width / 2) ** 2).astype(float)
        return np.exp(-square * 4 * math.log(2) / width**2)

    shared = np.minimum(shape(0.0), shape(shift)).sum() / shape(0.0).sum()
    assert overlap(aperture, frequency, distance) == pytest.approx(
        shared, abs=5e-3
    )  # pixels of 0.02 m at the discs' edges


def test_flux_of_a_filled_beam_against_astropy():
    import astropy.units as u

    beam = u.Quantity(16, "arcsec")
    solid = (math.pi * beam**2 / (4 * math.log(2))).to("sr")
    expected = (12.2 * u.uK).to(u.uJy, u.brightness_temperature(92 * u.GHz, beam_area=solid)).value
    assert flux_per_beam(12.2e-6, beam.to_value("rad"), 92e9) / 1e-32 == pytest.approx(
        expected, rel=1e-6
    )


def test_the_daisy_of_the_pipelines_reaches_as_far():
    import numpy as np

    from zonda.operators.pointing.daisy import PointingDaisy

    step = PointingDaisy(radius="4 arcmin", speed="50 arcsec/s", scan_duration="1 min")
    x, y = step.path(np.linspace(0, 30000, 200_001))
    assert np.hypot(x, y).max() == pytest.approx(daisy_reach(step.radius), rel=1e-4)


def test_every_calculation_says_what_it_is():
    assert all(
        CALCULATIONS[name].__doc__ or CALCULATIONS[name].__wrapped__.__doc__
        for name in CALCULATIONS
    )


def test_the_white_noise_of_a_stare():
    # the boresight stays within the field: every detector-second falls on the disc, 4 pi sigma^2 of
    # which a smoothed pixel holds
    sigma = 1e-4 / math.sqrt(8 * math.log(2))
    seconds = 100 * 50.0 * 4 * math.pi * sigma**2 / (math.pi * 0.01**2)
    found = white_noise_of_daisy(1e-3, 100, 0.02, 1e-3, 50.0, 1e-4)
    assert found == pytest.approx(1e-3 / math.sqrt(seconds))
