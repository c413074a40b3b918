"""Two streams beside each other, against what is known of the series that they were made of."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
from astropy.table import Table

import zonda
from tests.scenes import in_blocks
from zonda.core.errors import ZondaError
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.diagnostics.compare_streams import VALUES, StreamComparison, pair, values_of
from zonda.operators.diagnostics.plot_operators import Plots, pictures
from zonda.operators.diagnostics.power_spectrum import PowerSpectrum, Welch
from zonda.plugins.checks import scenes

N, RATE, LENGTH = 20000, 50.0, 500


def compare(observation, data, streams, means=None, sizes=(16,), **options):
    """The product of one scan that comes in blocks of ``sizes`` detectors."""
    step = zonda.CompareStreams(**({"segment": "10 s", "detectors": 19} | options))
    return in_blocks(step, observation, data, streams, means, sizes)["stream_comparison"]


def streams(seed=5):
    rng = np.random.default_rng(seed)
    return {k: rng.normal(0, 1e-3, (19, N)) for k in ("signal", "sky")}


@pytest.mark.parametrize("length", [256, 501, 2000])
def test_cross_spectra_are_scipys(length):
    x, y = np.random.default_rng(1).normal(size=(2, 6000)) + 3.0
    found = pair(x, x[::-1] + 0.3 * x + y, Welch(6000, RATE, length))
    how = {"fs": RATE, "nperseg": length, "noverlap": length - length // 2, "detrend": "linear"}
    other = x[::-1] + 0.3 * x + y
    np.testing.assert_allclose(found.power, scipy.signal.csd(x, x, **how)[1][1:].real, rtol=1e-10)
    np.testing.assert_allclose(
        found.reference, scipy.signal.csd(other, other, **how)[1][1:].real, rtol=1e-10
    )
    np.testing.assert_allclose(
        found.cross,
        scipy.signal.csd(other, x, **how)[1][1:],
        rtol=0,
        atol=1e-10 * found.power.max(),
    )


def test_equal_streams(make_observation, data):
    both = streams()["signal"]
    found = compare(
        make_observation(N), data, {"signal": both, "sky": both.copy()}, reference="sky"
    )
    np.testing.assert_allclose(found.coherence, 1, rtol=1e-12)
    assert found.over_detectors("correlation") == pytest.approx((1, 0, 0), abs=1e-9)
    assert found.over_detectors("gain")[:2] == pytest.approx((1, 0), abs=1e-12)
    assert found.over_detectors("rms_difference")[0] < 1e-9
    # sigma of 19 x 20000 values: 0.11 %; the straight lines and the level of 500 samples take 2 to
    # 3 of 250 frequencies' power
    assert found.over_detectors("rms")[0] == pytest.approx(1e-3, rel=0.01)


def test_independent_noise_has_the_bias_of_the_coherence(make_observation, data):
    found = compare(make_observation(N), data, streams(), reference="sky")
    # |estimate| of a coherence of zero: mean 1/n, standard deviation 1/n (exponential); 19
    # detectors x 250 frequencies, of which 1.5 to 2 are one behind the window: 2 % of 1/n for one
    # standard error
    assert found.segments == pytest.approx(Welch(N, RATE, LENGTH).independent)
    assert found.coherence.mean() * found.segments == pytest.approx(
        1, abs=4 * np.sqrt(2 / (19 * 250))
    )
    r, scatter, error = found.over_detectors("correlation")
    assert abs(r) < 4 * error / np.sqrt(19)
    assert error == pytest.approx(N**-0.5, rel=0.1)  # independent samples; the spectra scatter
    assert scatter == pytest.approx(error, rel=4 / np.sqrt(2 * 18))
    np.testing.assert_allclose(found.bias, 1 / found.segments, rtol=0.5)


@pytest.mark.parametrize("gain", [0.9, -2.0])
def test_a_gain_is_recovered(make_observation, data, gain):
    """x = g y + noise of half its rms: r = g / (g^2 + 1/4)^1/2, coherence r^2."""
    made = streams(6)
    made["signal"] = gain * made["sky"] + 0.5 * made["signal"]
    found = compare(make_observation(N), data, made, reference="sky")
    value, scatter, error = found.over_detectors("gain")
    assert value == pytest.approx(gain, abs=4 * error / np.sqrt(19))
    assert error == pytest.approx(0.5 * N**-0.5, rel=0.1)
    assert scatter == pytest.approx(error, rel=4 / np.sqrt(2 * 18))
    r = gain / np.hypot(gain, 0.5)
    value, scatter, error = found.over_detectors("correlation")
    assert value == pytest.approx(r, abs=4 * error / np.sqrt(19))
    assert error == pytest.approx((1 - r * r) * N**-0.5, rel=0.1)
    assert scatter == pytest.approx(error, rel=4 / np.sqrt(2 * 18))
    bias = (1 - r * r) ** 2 / found.segments
    # one value of C has the variance 2 C (1 - C)^2 / n (Bendat & Piersol 2010, table 9.6)
    sigma = np.sqrt(2 * r * r * (1 - r * r) ** 2 / found.segments * 2 / (19 * 250))
    assert found.coherence.mean() - bias == pytest.approx(r * r, abs=4 * sigma)


def test_the_errors_hold_for_coloured_noise():
    """Streams with spectra of f^-1 (pole at 0.5 Hz): scatter over 400 series against the standard
    errors (3.5 %; 4 sigma).
    """
    rng = np.random.default_rng(3)
    poles = ([1.0], [1.0, -np.exp(-2 * np.pi * 0.5 / RATE)])
    found, welch = [], Welch(8000, RATE, LENGTH)
    for _ in range(400):
        y, e = scipy.signal.lfilter(*poles, rng.normal(size=(2, 8000)))
        found.append(values_of(pair(0.7 * y + 0.5 * e, y, welch), RATE / LENGTH, welch.independent))
    values, errors = (np.array(rows) for rows in zip(*found, strict=True))
    scatter = values[:, 3:].std(axis=0, ddof=1)
    np.testing.assert_allclose(np.sqrt((errors[:, 3:] ** 2).mean(axis=0)), scatter, rtol=0.14)


def test_a_mean_beside_the_stream_counts(make_observation, data):
    """The mean in the stream and beside it; on the calibrated sky as `PowerSpectrum` has it; blocks
    do not matter.
    """
    observation = make_observation(N)
    made = streams(8)
    slow = SmoothField(np.ones((19, 1)), 1e-3 * np.sin(np.arange(N // 100 + 3))[None, :], 100, N)
    beside = compare(observation, data, made, {"signal": slow}, reference="sky")
    whole = made | {"signal": made["signal"] + slow.evaluate(slice(0, 19), slice(0, N))}
    within = compare(observation, data, whole, reference="sky")
    np.testing.assert_allclose(beside.values, within.values, rtol=1e-9)
    np.testing.assert_allclose(beside.power, within.power, rtol=1e-6)
    again = compare(observation, data, made, {"signal": slow}, sizes=(1, 3, 7), reference="sky")
    assert scenes.differing(beside.power, again.power) == 0
    assert scenes.differing(beside.coherence, again.coherence) == 0


def test_a_run_and_its_files(tmp_path):
    """Spectra are those of `PowerSpectrum`; tables, pictures and the report; streams of other units
    have no difference.
    """
    steps = [
        zonda.AtmosphereLayers(pwv="5 mm", outputs=["pwv"], layer_response="column"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.CompareStreams(segment="2 s"),
        zonda.CompareStreams(stream="atmosphere", reference="pwv", segment="2 s", name="emission"),
        PowerSpectrum(streams=["signal", "atmosphere"], segment="2 s"),
        zonda.Plots(),
        zonda.Report(),
    ]
    data = scenes.run(steps, scenes.scan(7, 2000), output=tmp_path)
    found, spectrum = data.products["stream_comparison"], data.products["spectrum"]
    np.testing.assert_allclose(found.power[0], spectrum.psd["signal"], rtol=1e-9)
    np.testing.assert_allclose(
        found.power[1], spectrum.psd["atmosphere"], rtol=1e-6
    )  # 13 decades below the first
    table = Table.read(tmp_path / "stream_comparison.ecsv", format="ascii.ecsv")
    np.testing.assert_allclose(table["ratio"], found.power[0] / found.power[1], rtol=1e-7)
    assert str(table["power"].unit) == "K2 / Hz"
    detectors = Table.read(tmp_path / "stream_comparison_detectors.ecsv", format="ascii.ecsv")
    np.testing.assert_allclose(detectors["gain"], found.values[:, VALUES.index("gain")], rtol=1e-7)
    assert list(detectors["detector"]) == found.names
    emission = data.products["emission"]
    assert (
        emission.over_detectors("correlation")[0] > 0.999
    )  # linear in the PWV but for the change of elevation
    assert np.isnan(emission.over_detectors("rms_difference")[0])
    assert {"stream_comparison", "emission"} <= {p.name for p in pictures(data, Plots())}
    assert (tmp_path / "stream_comparison.png").exists()
    page = (tmp_path / "report.html").read_text()
    assert "Streams compared" in page
    assert "rms of the difference" in page
    again = StreamComparison.of(found.arrays())
    again += StreamComparison.of(found.arrays())
    np.testing.assert_allclose(again.values, found.values)
    np.testing.assert_allclose(again.errors, found.errors / np.sqrt(2))
    again += StreamComparison.of(found.arrays() | {"names": ["another"]})
    assert (again.observations, again.of_another_length) == (2, 1)


def test_what_cannot_be_compared(tmp_path):
    with pytest.raises(ZondaError, match="are the same"):
        zonda.CompareStreams(reference="signal")
    steps = [zonda.WhiteNoise(), zonda.Efficiency(), zonda.CompareStreams(segment="2 s")]
    with pytest.raises(ZondaError, match="no stream 'atmosphere' at this step"):
        scenes.run(steps, scenes.scan(7, 2000))
    steps[-1] = zonda.CompareStreams(reference="white")
    data = scenes.run(steps, scenes.scan(7, 20))
    assert "stream_comparison" not in data.products
    assert ("CompareStreams", "scans too short to compare streams", "1") in [
        tuple(row) for row in data.log.told()
    ]


def signals(reference, runs):
    daisy = zonda.PointingDaisy(radius="1 arcmin", scan_duration="20 s")
    made = [
        zonda.AtmosphereLayers(),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="0.2 Hz"),
    ]
    compared = zonda.CompareStreams(stream="signal", reference=reference, segment="2 s")
    pipeline = zonda.Pipeline([daisy, *made, compared], runs=runs)
    return pipeline.run(
        scenes.scene(scenes.camera(7)),
        keep=["signal", *([reference] if "/" in reference else [])],
        threads=1,
    )


def test_the_stream_of_a_signal_as_it_is_filtered():
    """Of both, behind the filter: their difference is the atmosphere's, whatever the noise."""
    data = signals("signal/quiet", {"quiet": {"only": ["white"]}})
    found, (x, y) = (
        data.products["stream_comparison"],
        (data.tod(name) for name in ("signal", "signal/quiet")),
    )
    assert (found.stream, found.reference) == ("signal", "signal/quiet")
    rate = scenes.camera(7).sample_rate
    welch = Welch(x.shape[1], rate, round(rate / found.frequency[0]))
    expected = [pair(a, b, welch) for a, b in zip(x, y, strict=True)]
    # tod() holds the float32 streams that the step read, whose means are zero behind the filter:
    # the same spectra
    for row, name in ((0, "power"), (1, "reference")):
        np.testing.assert_allclose(
            found.power[row], np.mean([getattr(p, name) for p in expected], axis=0), rtol=1e-6
        )
    assert found.power[0].mean() > found.power[1].mean()  # the atmosphere is in one of them alone


@pytest.mark.parametrize(
    ("reference", "runs", "said"),
    [
        (
            "signal/quite",
            {"quiet": {"only": ["white"]}},
            "no stream 'signal/quite'(.|\\n)*did you mean 'signal/quiet'",
        ),
        ("signal/none", {}, "streams of signals: signal; of a remainder there are maps alone"),
    ],
)
def test_a_signal_that_there_is_not(reference, runs, said):
    daisy = zonda.PointingDaisy(radius="1 arcmin", scan_duration="4 s")
    steps = [
        daisy,
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.CompareStreams(reference=reference, segment="1 s"),
    ]
    with pytest.raises(ZondaError, match=said):
        zonda.Pipeline(steps, runs=runs).run(scenes.scene(scenes.camera(7)), threads=1)


def test_the_plan_keeps_a_signal_that_is_compared(tmp_path):
    from zonda import plan
    from zonda.core.configuration.pipeline_file import parse

    text = """
site: green_bank
instrument: {like: mustang2, detectors: 7}
time: 2024-11-25T07:00
target: 05h00m00s +20d00m00s
runs: {quiet: {only: [white]}, other: {only: [atmosphere]}}
operators:
  - PointingDaisy: {radius: 1 arcmin, speed: 50 arcsec/s, scan_duration: 10 s}
  - AtmosphereLayers
  - WhiteNoise
  - Efficiency
  - CompareStreams: {reference: signal/quiet, segment: 1 s}
  - Report
"""
    file = parse(text)
    applied = plan(file).apply(file)
    assert list(applied.pipeline().runs) == ["quiet"]  # nothing reads the other
    data = applied.pipeline().run(applied.scene(), output=tmp_path, threads=1)
    assert data.products["stream_comparison"].reference == "signal/quiet"
