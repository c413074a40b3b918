"""A function of a block as a step."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import zonda
import zonda.testing
from zonda.core.errors import PipelineError
from zonda.plugins.checks.scenes import camera, scene

STEPS = (
    zonda.PointingDaisy(scan_duration="4 s"),
    zonda.AtmosphereLayers(pwv="5 mm"),
    zonda.WhiteNoise(),
    zonda.Efficiency(),
)


def double(block):
    """Twice the signal."""
    return 2 * block.detdata["signal"]


def drops(block):
    """Leaves a part of the stream."""
    block.detdata["signal"] = block.detdata["signal"][:, ::2]


def modes_removed(x):
    """The two strongest modes of detectors x samples, removed."""
    _, vectors = np.linalg.eigh(x @ x.T)
    u = vectors[:, -2:]
    return x - u @ (u.T @ x)


def pca(block):
    """One's own PCA."""
    return modes_removed(block.detdata["signal"])


def signal(*steps, threads=1):
    return zonda.Pipeline([*STEPS, *steps]).run(scene(camera(19)), keep=["signal"], threads=threads)


def test_what_it_returns_is_the_stream_with_its_mean():
    plain, doubled = signal().tod(), signal(zonda.operator(double)).tod()
    assert plain.mean() > 10
    # the mean stands beside the stream: what is rounded to 2^-24 is below 100 K
    np.testing.assert_allclose(doubled, 2 * plain, atol=100 * 2.0**-24)


def test_in_place_and_as_a_lambda_and_as_a_decorator():
    @zonda.operator(linear=True)
    def in_place(block):
        block.detdata["signal"] *= 2

    returned = zonda.operator(lambda block: 2 * block.detdata["signal"])
    expected = signal(zonda.operator(double)).tod()
    for step in (in_place, returned):
        np.testing.assert_array_equal(signal(step).tod(), expected)
    assert (in_place.label, returned.label, in_place.linear, returned.linear) == (
        "in_place",
        "function",
        True,
        False,
    )


def test_it_keeps_the_contract():
    zonda.testing.check_operator(zonda.operator(double, linear=True))
    zonda.testing.check_operator(zonda.operator(double, linear=True, couples="all"))


def test_the_conformance_kit_finds_a_function_that_is_not_linear():
    with pytest.raises(AssertionError, match="linear"):
        zonda.testing.check_operator(
            zonda.operator(lambda block: block.detdata["signal"] + 1.0, linear=True)
        )


def test_a_component_of_its_own():
    offset = zonda.operator(
        lambda block: np.full(block.shape, 0.5),
        name="offset",
        requires=(),
        provides=[zonda.Component("offset", "calibrated")],
    )
    steps = [STEPS[0], STEPS[2], offset, STEPS[3]]
    data = zonda.Pipeline(steps, runs={"alone": {"only": ["offset"]}}).run(
        scene(camera(3)), keep=["signal", "signal/alone", "offset"], threads=1
    )
    np.testing.assert_array_equal(data.tod("signal/alone"), 0.5)
    np.testing.assert_array_equal(data.tod("offset"), 0.5)


def test_a_whole_scan_of_each_detector():
    seen = []

    @zonda.operator(couples="time", linear=True)
    def demean(block):
        seen.append(block.shape[1])
        return block.detdata["signal"] - block.detdata["signal"].mean(axis=1, keepdims=True)

    found = signal(demean).tod()
    assert set(seen) == {400}
    # rounded to 2^-24 of fluctuations below 10 K, once for each sample
    assert np.abs(found.mean(axis=1)).max() < 10 * 2.0**-24


def test_a_function_of_the_whole_scan_is_called_once():
    """Whatever the memory; the stream has its mean in it, in float64."""
    seen = []

    def looks(block):
        seen.append(
            (block.shape, block.detdata["signal"].dtype, block.detdata["signal"].mean() > 10)
        )

    step = zonda.operator(looks, couples="all", provides=())
    small = (
        zonda.Pipeline([*STEPS, step])
        .run(scene(camera(19)), keep=["signal"], threads=1, memory=300_000)
        .tod()
    )
    assert seen == [((19, 400), np.dtype(np.float64), True)]
    np.testing.assert_array_equal(small, signal().tod())


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_ones_own_pca_is_that_of_the_scan(precision):
    """As numpy's of the stream that a run keeps; by blocks it is another one. Where it takes the
    mean away, no mean is left.
    """

    def run(*steps, **how):
        return (
            zonda.Pipeline([*STEPS, *steps], precision=precision)
            .run(scene(camera(19)), keep=["signal"], threads=1, **how)
            .tod()
        )

    expected = modes_removed(np.asarray(run(), np.float64))
    whole = zonda.operator(pca, couples="all")
    # 20 K of mean are removed: what is left is rounded as the run's streams are, of millikelvins
    tolerance = {"float32": 20 * 2.0**-23, "float64": 1e-12}[precision]
    np.testing.assert_allclose(run(whole), expected, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(run(whole, memory=500_000), run(whole))
    in_place = zonda.operator(
        lambda block: np.copyto(block.detdata["signal"], pca(block)), couples="all"
    )
    np.testing.assert_array_equal(run(in_place), run(whole))


def test_it_acts_on_each_signal_by_itself():
    runs = {"quiet": {"without": ["white"]}}
    seen = []

    @zonda.operator(couples="all", linear=True)
    def demean(block):
        seen.append({str(one) for one in block.components})
        return block.detdata["signal"] - block.detdata["signal"].mean()

    data = zonda.Pipeline([*STEPS, demean], runs=runs).run(
        scene(camera(19)), keep=["signal", "signal/quiet"], threads=1
    )
    assert [one >= {"white"} for one in seen] == [True, False]
    for name in ("signal", "signal/quiet"):
        assert abs(data.tod(name).mean()) < 30 * 2.0**-24


@pytest.mark.parametrize("couples", ["sample", "time", "all"])
def test_a_function_that_does_nothing_is_told(couples):
    def forgets(block):
        block.detdata["signal"] * 2

    with pytest.warns(UserWarning, match=r"forgets left signal as it was: does it lack a return\?"):
        signal(zonda.operator(forgets, couples=couples))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*left signal as it was")
        for step in (
            zonda.operator(double, couples=couples),
            zonda.operator(forgets, provides=(), couples=couples),
        ):
            signal(step)


def test_its_memory_is_planned_and_refused_beyond_the_ceiling():
    from zonda.core.plan.planning import planning_of

    step = zonda.operator(pca, couples="all")
    observation = signal().observations[0]
    assert planning_of(step).memory(observation) == 3 * 8 * 19 * 400
    assert planning_of(zonda.operator(pca, couples="detectors")).memory(observation) == 0
    long = [zonda.PointingDaisy(scan_duration="2 h"), *STEPS[1:], step]
    with pytest.raises(PipelineError, match=r"pca 3.75 GB(.|\n)*pca: make the scan shorter"):
        zonda.Pipeline(long).run(scene(camera(217)), threads=1, ceiling=int(6e8))


def test_provenance_names_the_source():
    (label, kind, said), *_ = [
        row for row in signal(zonda.operator(double)).provenance["operators"] if row[0] == "double"
    ]
    assert (label, kind) == ("double", "double")
    assert said["function"].endswith("test_function_operator.double")
    assert said["source"] == f"{__file__}, line {double.__code__.co_firstlineno}"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: zonda.operator(3), "expected a function of a block, got 3"),
        (lambda: zonda.operator(zonda.BinMap), "expected a function"),
        (
            lambda: zonda.operator(double, requires="signal"),
            r"requires is a list of names(.|\n)*requires=\['signal'\]",
        ),
        (lambda: zonda.operator(double, couples="most"), "cannot couple 'most'"),
        (
            lambda: zonda.operator(double, couples="all", requires=("sky", "signal")),
            "reads one stream",
        ),
        (lambda: zonda.operator(double, couples="all", provides=("other",)), "reads one stream"),
        (
            lambda: signal(zonda.operator(drops, couples="all")),
            r"left no stream signal of shape \(19, 400\)",
        ),
        (
            lambda: zonda.Pipeline([*STEPS, double]),
            r"step 5 is the function double(.|\n)*zonda.operator\(double\) at step 5",
        ),
        (
            lambda: signal(zonda.operator(lambda block: 3)),
            r"returned an array of shape \(\)(.|\n)*the stream signal",
        ),
        (lambda: signal(zonda.operator(lambda block: "no")), "returned 'no'"),
        (
            lambda: signal(zonda.operator(double, provides=())),
            "return nothing: it provides no streams",
        ),
        (
            lambda: signal(zonda.operator(double, provides=("signal", "more"))),
            "return nothing: it provides 2 streams",
        ),
        (
            lambda: zonda.Pipeline([STEPS[0], zonda.operator(double)]),
            "double needs signal, which no step provides",
        ),
    ],
)
def test_mistakes(make, said):
    with pytest.raises(PipelineError, match=said):
        make()


def test_what_the_function_raises_is_named_with_the_step_and_chained():
    def deep(block):
        return block.detdata["signal"].reshape(-1, 7, 11)  # numpy raises

    with pytest.raises(
        PipelineError, match=r"calibrate: the function .*deep raised ValueError: cannot reshape"
    ) as caught:
        signal(zonda.operator(deep, name="calibrate"), threads=2)
    assert isinstance(caught.value.__cause__, ValueError)
    line = deep.__code__.co_firstlineno + 1
    assert caught.value.cure == f"mend it: {__file__}, line {line}"

    def refuses(block):
        raise PipelineError("not today", place="refuses")

    with pytest.raises(PipelineError, match=r"^refuses: not today$"):
        signal(zonda.operator(refuses))


def test_a_pipeline_file_does_not_know_it():
    from zonda.core.configuration.pipeline_file import parse

    zonda.operator(double)
    text = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
operators: [PointingDaisy, double]
"""
    with pytest.raises(zonda.ZondaError, match="unknown operator 'double'"):
        parse(text)
