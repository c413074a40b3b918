"""TOAST's operators as steps of our pipelines: its filters beside ours, in Python, in files, in
campaigns, with two bands.

`.ci/toast` runs these in an environment with TOAST (the extra ``toast``), where none may be skipped
(ZONDA_TOAST=required).
"""

import re

import numpy as np
import pytest
import yaml
from astropy.io import fits

import zonda
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.errors import ZondaError
from zonda.core.operator import Operator
from zonda.testing import check_operator

from ..scenes import Marks, skip_without
from .conftest import SCAN, SCENE

pytestmark = [
    pytest.mark.toast,
    pytest.mark.filterwarnings("ignore:Pointing", "ignore::DeprecationWarning"),
]

skip_without("toast")


TURNAROUNDS_TOO = 9
"""TOAST's mask of samples that a fit leaves out, but for turnarounds (4) and trimmed ends (2),
which our filters use.
"""


class Spoils(Operator):
    """A sample that is not finite, as a file may have."""

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})
    knows_means = True

    def exec(self, block, state):
        if (
            block.detectors.start <= 3 < block.detectors.stop
            and block.samples.start <= 250 < block.samples.stop
        ):
            block.detdata["signal"][3 - block.detectors.start, 250 - block.samples.start] = np.nan


def run(*filters, precision="float64", runs=None, keep=("signal",), spoilt=True):
    """Two bands with the atmosphere's mean emission, turnarounds, a dead and an opaque detector,
    opaque samples, a spoilt one.
    """
    steps = [
        zonda.PointingBackAndForth(**SCAN, flag_turnarounds=True),
        zonda.AtmosphereLayers(pwv="1 mm"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        Marks(),
        *([Spoils()] if spoilt else []),
        *filters,
        zonda.BinMap(projection="CAR", pixel="2 arcmin"),
    ]
    return zonda.Pipeline(steps, precision=precision, runs=runs).run(
        zonda.Scene(**SCENE), keep=keep, threads=1
    )


def theirs(name, **traits):
    return zonda.ToastOperator(operator=name, traits=traits)


POLYNOMIALS = {"order": 3, "shared_flag_mask": TURNAROUNDS_TOO}
SAME = {
    "polynomial of the scan": (
        theirs("PolyFilter", view=None, **POLYNOMIALS),
        zonda.PolynomialFilter(order=3),
    ),
    "polynomial of each throw": (
        theirs("PolyFilter", **POLYNOMIALS),
        zonda.PolynomialFilter(order=3, interval="throw"),
    ),
    "polynomial of each pass": (
        theirs("PolyFilter", order=1, view="scanning"),
        zonda.PolynomialFilter(order=1, interval="scanning"),
    ),
    "ground": (
        theirs(
            "GroundFilter",
            trend_order=1,
            filter_order=None,
            bin_width="0.47 deg",
            detrend=True,
            shared_flag_mask=TURNAROUNDS_TOO,
        ),
        zonda.GroundFilter(bin="0.47 deg"),
    ),
    "common mode": (theirs("CommonModeFilter"), zonda.CommonModeFilter(method="mean")),
}


@pytest.mark.parametrize("what", SAME)
def test_its_filters_are_ours(what):
    """Least squares by different algorithms in float64: 1e-13 of the 12 K of the atmosphere's mean
    emission, with the rounding of fits to 4130 samples; a map adds the quantum of its sums, 1e-11 K
    here."""
    spoilt = what != "common mode"  # ours takes such a detector for dead
    one, other = (run(step, spoilt=spoilt) for step in SAME[what])
    for a, b in zip(one.observations, other.observations, strict=True):
        good = np.ix_(b.good_detectors, b.good_samples)
        np.testing.assert_array_equal(a.detector_flags, b.detector_flags)
        x, y = a.detdata["signal"][good], b.detdata["signal"][good]
        assert np.isnan(x).sum() == np.isnan(y).sum() == spoilt
        assert np.nanstd(y) > 1e-3
        print(f"\n{what}, {a.name}: {np.nanmax(np.abs(x - y)):.1e} K of {np.nanstd(y):.1e} K")
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-12)
    for band in ("map_f090", "map_f150"):
        np.testing.assert_array_equal(one[band].hits, other[band].hits)
        np.testing.assert_allclose(one[band].signal, other[band].signal, rtol=0, atol=3e-11)


def test_the_mean_emission_costs_no_digits_in_float32():
    """Whether the operator removes it or leaves it: 12 K are rounded to 0.5 uK in float32, 10 mK to
    0.5 nK.
    """
    gone, kept = (
        theirs("PolyFilter", view=None, **POLYNOMIALS),
        theirs("PolyFilter", pattern="no such detector"),
    )
    for step, ours, largest in ((gone, [zonda.PolynomialFilter(order=3)], 5e-9), (kept, [], 0.0)):
        one, other = (run(*steps, precision="float32") for steps in ([step], ours))
        for band in ("map_f090", "map_f150"):
            np.testing.assert_allclose(
                one[band].signal, other[band].signal, rtol=0, atol=largest + 3e-11
            )


def test_signals_are_acted_on_side_by_side():
    """Signals are formed and filtered one by one, a remainder too: of no operator of TOAST it is
    known whether it is linear.
    """
    step = theirs("PolyFilter", view=None, order=2)
    runs = {"noise": {"only": ["white"]}, "rest": {"without": ["white"]}}
    data = run(step, runs=runs, keep=("signal/noise", "signal/rest", "signal"))
    for o in data.observations:
        whole, noise, rest = (
            o.detdata[name][o.good_detectors] for name in ("signal", "signal/noise", "signal/rest")
        )
        # PolyFilter is linear but for the sample that is not finite in all of them
        np.testing.assert_allclose(noise + rest, whole, rtol=0, atol=1e-12)
        assert 0 < np.nanstd(noise) < np.nanstd(whole)


def test_what_it_flags_no_map_uses():
    """FlagNaNs flags single samples, SimpleDeglitch spikes; YieldCut drops detectors: all are flags
    of ours afterwards.
    """
    before, cut = run(), run(theirs("YieldCut", keep_frac=0.5))
    for a, b in zip(before.observations, cut.observations, strict=True):
        assert not b.good_detectors[~a.good_detectors].any()
        assert 0 < b.good_detectors.sum() < a.good_detectors.sum()
    for band, o in zip(("map_f090", "map_f150"), cut.observations, strict=True):
        spoilt = 1 if o.good_detectors[3] else 0
        assert cut[band].hits.sum() == o.good_detectors.sum() * o.good_samples.sum() - spoilt


FILE = {
    **{key: SCENE[key] for key in ("site", "time", "target", "seed")},
    "instrument": SCENE["instrument"],
    "operators": [
        {"PointingBackAndForth": SCAN},
        "WhiteNoise",
        "Efficiency",
        {"ToastOperator": {"operator": "PolyFilter", "traits": {"order": 3, "view": None}}},
        {"BinMap": {"pixel": "2 arcmin"}},
        "SaveMap",
    ],
}


def test_in_a_file_and_in_a_campaign_of_workers(tmp_path):
    """Both bands of two realizations, one worker and two: the same bits."""
    (tmp_path / "poly.yaml").write_text(yaml.safe_dump(FILE))
    loaded = zonda.load(tmp_path / "poly.yaml")
    assert loaded.pipeline().operators[3].traits == {"order": 3, "view": None}
    made = []
    for workers in (1, 2):
        folder = tmp_path / str(workers)
        zonda.campaign(
            loaded.pipeline(), loaded.scene(), output=folder, realizations=2, workers=workers
        )
        made.append({path.name: fits.getdata(path) for path in sorted(folder.rglob("map_f*.fits"))})
    assert {"map_f090.fits", "map_f150.fits"} <= set(made[0])
    for name, values in made[0].items():
        np.testing.assert_array_equal(values, made[1][name])


def mistake(tmp_path, **step):
    steps = [*FILE["operators"][:3], {"ToastOperator": step}, *FILE["operators"][4:]]
    (tmp_path / "wrong.yaml").write_text(yaml.safe_dump(FILE | {"operators": steps}))
    with pytest.raises(ConfigurationError) as caught:
        zonda.load(tmp_path / "wrong.yaml").pipeline()
    return re.sub(r"\s+", " ", str(caught.value))


def test_mistakes_are_told_at_their_place(tmp_path):
    assert "toast.ops has no operator 'PolyFitler'" in (
        said := mistake(tmp_path, operator="PolyFitler")
    )
    assert "PolyFilter" in said.partition("PolyFitler")[2]
    assert "wrong.yaml:" in said
    assert "has no trait 'ordre'" in (
        said := mistake(tmp_path, operator="PolyFilter", traits={"ordre": 3})
    )
    assert "did you mean 'order'" in said or "order" in said.partition("ordre")[2]
    assert "'order' trait" in mistake(tmp_path, operator="PolyFilter", traits={"order": "three"})
    assert "trait bin_width" in mistake(
        tmp_path, operator="GroundFilter", traits={"bin_width": "1 parsnip"}
    )
    assert "no stream for TOAST but the signal" in mistake(
        tmp_path, operator="PolyFilter", traits={"det_data": "sky"}
    )


def test_what_the_scan_lacks_is_told_before_anything_is_simulated():
    stare = [zonda.PointingStare(scan_duration="5 s"), zonda.WhiteNoise(), zonda.Efficiency()]
    for step, what in (
        (
            theirs("PolyFilter"),
            r"needs 'throw' of intervals.*\n.*name another in its traits: scanning",
        ),
        (theirs("GroundFilter", azimuth="az"), r"needs 'az' of shared data.*\n.*azimuth"),
    ):
        pipeline = zonda.Pipeline([*stare, step, zonda.BinMap(projection="CAR", pixel="2 arcmin")])
        with pytest.raises(ZondaError, match=what):
            pipeline.run(zonda.Scene(**SCENE))


def test_what_it_cannot_do_is_told_with_its_own_words():
    """GroundFilter of TOAST 3.0.6 with both polynomials and bins stops at a mistake of its own."""
    with pytest.raises(
        ZondaError,
        match=r"ToastOperator, scan-000-f090: toast\.ops\.GroundFilter: NameError: .*counts",
    ):
        run(theirs("GroundFilter", bin_width="0.5 deg", filter_order=5))


def test_an_operator_that_changes_nothing_is_told():
    data = run(theirs("PolyFilter", pattern="no such detector"))
    assert {what for who, what, _ in data.log if who.startswith("ToastOperator")} >= {"no effect"}
    data = run(theirs("PolyFilter", view=None))
    assert "no effect" not in {what for who, what, _ in data.log if who.startswith("ToastOperator")}


def test_where_no_detector_is_left_no_instant_is_flagged():
    class Dead(Operator):
        requires = frozenset({"signal"})

        def prepare(self, observation):
            observation.detector_flags |= 1

    data = run(Dead(), theirs("PolyFilter", order=3, view="throw"))
    flagged = [
        text
        for who, what, text in data.log
        if who.startswith("ToastOperator") and what == "instants that TOAST flagged"
    ]
    assert flagged == ["0", "0"]


def test_an_operator_within_an_operator():
    """TOAST's noise behind a calibration: its PSD is that of the NET."""
    steps = [zonda.PointingBackAndForth(**SCAN), zonda.WhiteNoise(), zonda.Efficiency()]
    nested = {"operator": "Pipeline", "traits": {}}
    assert (
        zonda.ToastOperator(operator="BinMap", traits={"pre_process": nested}).traits["pre_process"]
        == nested
    )
    noise = theirs("SimNoise", noise_model="noise_model", realization=3)
    scene = zonda.Scene(**SCENE)
    plain, both = (
        zonda.Pipeline([*steps, *more]).run(scene, keep=["signal"]) for more in ([], [noise])
    )
    for a, b, net in zip(plain.observations, both.observations, (300e-6, 360e-6), strict=True):
        added = (b.detdata["signal"] - a.detdata["signal"])[a.good_detectors]
        # standard error of an rms of n samples, 1 / sqrt(2 n)
        assert added.std() == pytest.approx(
            net * np.sqrt(100), rel=5 / np.sqrt(2 * added.size) + 1e-3
        )


def test_it_keeps_the_contract():
    check_operator(theirs("PolyFilter", view=None, order=2))
