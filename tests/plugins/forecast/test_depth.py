"""The forecast against closed forms, against the definition of the noise evaluated sample by
sample, and against simulations.
"""

import math

import numpy as np
import pytest

import zonda
from zonda.core.configuration.pipeline_file import parse
from zonda.core.errors import ZondaError
from zonda.core.instrument import SPEED_OF_LIGHT, Band
from zonda.core.numerics.radiation import BOLTZMANN, cmb_slope
from zonda.core.numerics.sphere import ARCMIN, ARCSEC, FWHM_PER_SIGMA
from zonda.operators.filters.brick_wall import plan_highpass
from zonda.operators.noise.one_over_f import power_law_filter
from zonda.plugins.forecast import detector_noise
from zonda.plugins.forecast.depth import PARTS, Depth, factors
from zonda.plugins.forecast.survey import survey_of

NET, RATE, FWHM = 2e-3, 25.0, 20 * ARCSEC
CAMERA = """
name: test
seed: 3
site: green_bank
time: 2024-11-25T07:00
target: 75 deg 20 deg
instrument:
  name: test
  telescope: {name: dish, diameter: 30 m}
  band: {name: band, low: 85 GHz, high: 95 GHz}
  detectors: DETECTORS
  field_of_view: FIELD
  fwhm: 20 arcsec
  main_beam_efficiency: 0.6
  illumination_efficiency: 0.9
  net: 2 mK s(1/2)
  knee: 0.5 Hz
  pink_minimum_frequency: 10 mHz
  sample_rate: 25 Hz
operators:
"""
DAISY = "PointingDaisy: {radius: 2 arcmin, speed: 60 arcsec/s, scan_duration: 80 s}"
FILTERS = "HighpassFilter: {frequency: 0.1 Hz}", "CommonModeFilter"


def pipeline(*steps, detectors=37, field="3 arcmin"):
    text = CAMERA.replace("DETECTORS", str(detectors)).replace("FIELD", field)
    return parse(
        text
        + "".join(
            f"  - {step}\n"
            for step in [*steps, "BinMap: {pixel: 5 arcsec, half_difference: false}"]
        )
    )


def test_dead_detectors_are_none(tmp_path):
    """A table with dead detectors has the depth of the same table without them, of all noises."""
    rng = np.random.default_rng(5)
    rows = [
        f"d{k}, {x:.4f}, {y:.4f}, {dead}"
        for k, ((x, y), dead) in enumerate(
            zip(rng.uniform(-1, 1, (12, 2)), 6 * [0, 1], strict=True)
        )
    ]
    depths = []
    for name, kept in (("all", rows), ("alive", rows[::2])):
        path = tmp_path / f"{name}.csv"
        path.write_text("\n".join(["name, xi [arcmin], eta [arcmin], dead", *kept]) + "\n")
        text = CAMERA.replace("  detectors: DETECTORS\n  field_of_view: FIELD\n", "")
        text = text.replace("  net: ", f"  focalplane: {path}\n  net: ")
        steps = (DAISY, "WhiteNoise", "PinkNoise", "Efficiency", *FILTERS)
        made = "".join(f"  - {s}\n" for s in [*steps, "BinMap: {half_difference: false}"])
        found = zonda.sensitivity(parse(text + made))
        depths.append([found.rms(part=part) for part in ("white", "1/f")])
    assert depths[0] == pytest.approx(depths[1], rel=1e-9)


def test_one_detector_that_stares_has_its_net_over_the_root_of_the_time():
    file = pipeline(
        "PointingStare: {scan_duration: 80 s}",
        "WhiteNoise",
        "Efficiency",
        detectors=1,
        field="0 deg",
    )
    found = zonda.sensitivity(file, radius="5 arcsec")
    # every sample has the same weight, whatever the beam; the field's rotation does not move a
    # detector on the boresight
    assert found.rms(part="white") == pytest.approx(NET / math.sqrt(80), rel=1e-3)
    assert found.rms(320.0, part="white") == pytest.approx(NET / math.sqrt(320), rel=1e-3)
    assert found.rms(part="1/f") == found.rms(part="atmosphere") == 0


def test_pink_noise_of_a_stare_is_that_of_the_mean_of_its_samples():
    file = pipeline(
        "PointingStare: {scan_duration: 80 s}",
        "PinkNoise",
        "Efficiency",
        detectors=1,
        field="0 deg",
    )
    n = round(80 * RATE)
    law = power_law_filter(0.01 / RATE, 1.0, 8)
    grid = 1 << 18
    covariance = np.fft.irfft(law.response(np.fft.rfftfreq(grid)))[:n] * (0.5 / 0.01)
    weight = np.r_[1.0, 2 * (1 - np.arange(1, n) / n)] / n
    expected = NET * math.sqrt(RATE * float(weight @ covariance))
    # bins of 1 / (2 T), each with the mean of the spectrum: |W|^2 varies over them by some per cent
    # of the lowest, which has most
    assert zonda.sensitivity(file, radius="5 arcsec").rms(part="1/f") == pytest.approx(
        expected, rel=0.03
    )


def test_white_noise_falls_with_the_hits_of_a_beam():
    """Where the coverage is even, the variance is NET^2 / (2 Omega x seconds per solid angle)."""
    one = zonda.sensitivity(
        pipeline(DAISY, "WhiteNoise", "Efficiency", detectors=397, field="6 arcmin"),
        radius="20 arcsec",
    )
    survey = one.survey
    o = survey.observations[0]
    path = survey.track(0, RATE)
    h = path.matrices
    xi, eta = survey.offsets.T
    x, y = (
        (h[:, k : k + 1] * xi + h[:, k + 1 : k + 2] * eta + h[:, k + 2 : k + 3]) / h[:, 8:]
        for k in (0, 3)
    )
    near = np.hypot(x, y) < 60 * ARCSEC
    density = near.sum() / RATE / (math.pi * (60 * ARCSEC) ** 2)
    omega = 2 * math.pi * (FWHM / FWHM_PER_SIGMA) ** 2
    assert o.n_samples == len(path.index)
    # the coverage falls by some per cent over 1 arcmin, and beams are sampled at a pitch of 18
    # arcsec
    assert one.rms(part="white") == pytest.approx(NET / math.sqrt(2 * omega * density), rel=0.05)


def exact(file, points, law):
    """White and 1/f variance behind the beam, by weights of every sample and the filters as the run
    applies them.
    """
    survey = survey_of(file)
    o = survey.observations[0]
    h = survey.track(0, RATE).matrices
    xi, eta = survey.offsets.T
    x, y = (
        (h[:, k : k + 1] * xi + h[:, k + 1 : k + 2] * eta + h[:, k + 2 : k + 3]) / h[:, 8:]
        for k in (0, 3)
    )
    plan = plan_highpass(o.n_samples, 0.1 / RATE, 3, 24.0)
    white, pink, weights = [], [], []
    for a, b in points:
        k = np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * survey.sigma**2)).T.copy()
        w = (k / k.sum()).astype(np.float32)  # as the streams of a run
        plan.apply(w)
        w -= w.mean(axis=0)
        energy = abs(np.fft.rfft(w, 4 * o.n_samples, axis=1)) ** 2
        energy[:, 1:-1] *= 2
        frequency = np.fft.rfftfreq(4 * o.n_samples)
        white.append(NET**2 * RATE * (w**2).sum())
        pink.append(NET**2 * RATE * (energy @ law(frequency)).sum() / (4 * o.n_samples))
        weights.append(k.sum())
    return np.average(white, weights=weights), np.average(pink, weights=weights)


def test_filtered_noise_is_that_of_the_filtered_weights():
    file = pipeline(DAISY, "WhiteNoise", "PinkNoise", "Efficiency", *FILTERS)
    law = power_law_filter(0.01 / RATE, 1.0, 8)
    grid = np.linspace(-0.5, 0.5, 5) * ARCMIN
    points = [(a, b) for a in grid for b in grid if math.hypot(a, b) <= 0.5 * ARCMIN]
    white, pink = exact(file, points, lambda f: 50 * law.response(np.maximum(f, 1e-9)))
    found = zonda.sensitivity(file, radius="0.5 arcmin")
    # the stated 5 % of the rms: 24 of 37 detectors stand for all, 16 probes for the circle
    assert found.rms(part="white") == pytest.approx(math.sqrt(white), rel=0.05)
    assert found.rms(part="1/f") == pytest.approx(math.sqrt(pink), rel=0.05)


def test_shared_pink_noise_is_gone_behind_the_common_mode():
    own, shared = (
        zonda.sensitivity(
            pipeline(DAISY, f"PinkNoise: {{shared: {s}}}", "Efficiency", *FILTERS)
        ).rms(part="1/f")
        for s in (0, 0.75)
    )
    assert shared == pytest.approx(own / 2, rel=1e-12)


def test_some_detectors_stand_for_a_large_array(monkeypatch):
    file = pipeline(DAISY, "WhiteNoise", "Efficiency", detectors=919, field="6 arcmin")
    survey = survey_of(file)
    every = detector_noise.variances(survey, 0.5 * ARCMIN)["white"]
    monkeypatch.setattr(detector_noise, "SAMPLES", 2e6)
    some = detector_noise.variances(survey, 0.5 * ARCMIN)["white"]
    # of the variance, twice what is stated for the rms: the chosen detectors lie unevenly
    assert some != every
    assert some == pytest.approx(every, rel=0.1)


def test_scans_of_other_noise_are_weighted_by_it():
    """Two scans at other loads: their weights are those of the map, 1 / NET^2, so the variances add
    inversely.
    """
    steps = "WhiteNoise: {model: background_limited}", "Efficiency"
    air = "AtmosphereLayers: {pwv_rms: 0 %}"
    daisy = DAISY.replace("}", ", scans: 2, gap: 6000 s}")
    both = zonda.sensitivity(pipeline(daisy, air, *steps, FILTERS[0]))
    levels = np.array([scan[0].sample for scan in both.survey.levels])
    assert levels.max() > 1.02 * levels.min()
    assert both.survey.weights == pytest.approx((levels[0] / levels) ** 2, rel=1e-3)
    first, second = both.depth.variance["white"]
    other = first * (levels[1] / levels[0]) ** 2
    # the sky turned between the scans, so that their detectors lie otherwise: 3 % of the variance
    assert 1 / second == pytest.approx(1 / first + 1 / other, rel=0.03)


@pytest.fixture(scope="module")
def two_scans():
    return pipeline(
        DAISY.replace("}", ", scans: 2, gap: 10 s}"),
        "AtmosphereLayers: {pwv_rms: 2 %}",
        "WhiteNoise",
        "PinkNoise",
        "Efficiency",
        *FILTERS,
    )


@pytest.fixture(scope="module")
def found(two_scans):
    return zonda.sensitivity(two_scans, radius="1.5 arcmin")


def test_depth_against_time(found):
    depth = found.depth
    assert depth.seconds == pytest.approx([80, 160])
    for part in PARTS:
        assert depth.part(part, 160.0) == pytest.approx(math.sqrt(depth.variance[part][-1]))
        assert depth.part(part, 16000.0) == pytest.approx(depth.part(part, 160.0) / 10)
    assert depth.total(1e4) ** 2 == pytest.approx(sum(depth.part(p, 1e4) ** 2 for p in PARTS))
    # two scans over the same field: half the variance, but for the field's rotation
    assert depth.variance["white"][1] == pytest.approx(depth.variance["white"][0] / 2, rel=0.02)
    for rms in (1e-3, 3e-4, 1e-5):
        assert depth.total(depth.reach(rms)) == pytest.approx(rms, rel=2e-3)
    assert found.reach("300 uK") == found.reach(3e-4) == pytest.approx(depth.reach(3e-4))


def test_time_before_and_between_scans():
    variance = np.array([4.0, 1.0])
    depth = Depth(np.array([10.0, 20.0]), dict.fromkeys(PARTS, variance), dict.fromkeys(PARTS, 0.1))
    assert depth.part("white", 2.5) == pytest.approx(4.0)  # as time^-1/2 from 2 after 10 s
    assert depth.part("white", 15.0) == pytest.approx(
        math.sqrt((40 + 20) / 2 / 15)
    )  # time x variance is linear between
    assert depth.total_error(20.0) == pytest.approx(0.1 / math.sqrt(3))


def test_the_same_figures_again(two_scans, found):
    again = zonda.sensitivity(two_scans, radius="1.5 arcmin").depth.variance
    assert all((again[p] == found.depth.variance[p]).all() for p in PARTS)


def test_small_audit(found):
    audited = found.audited(8, threads=1)
    rows = {r.part: r for r in audited.audit.rows}
    assert list(rows) == [*PARTS, "together"]
    for row in rows.values():
        assert abs(row.z) < 4, row
    # 8 seeds x 56 beams in the circle: 5 % of the rms at four sigma leaves nothing that is wrong by
    # a third
    assert abs(rows["white"].difference) < 0.15
    assert abs(rows["1/f"].difference) < 0.25
    parts = sum(rows[p].mean ** 2 for p in PARTS)
    assert rows["together"].mean ** 2 == pytest.approx(parts, rel=0.2)
    assert "audit: 8 simulations" in str(audited)
    assert audited.as_dict()["audit"][-1]["part"] == "together"


def test_one_simulation_is_refused(found):
    with pytest.raises(ZondaError, match="no standard error"):
        found.audited(1)


@pytest.mark.parametrize(
    ("centre", "fwhm"), [(90e9, 20 * ARCSEC), (150e9, 84 * ARCSEC), (345e9, 19 * ARCSEC)]
)
def test_units_of_a_narrow_band(centre, fwhm):
    band = Band(name="narrow", low=f"{centre - 1e6} Hz", high=f"{centre + 1e6} Hz")
    found = factors(band, fwhm)
    brightness = 2 * BOLTZMANN * centre**2 / SPEED_OF_LIGHT**2
    omega = math.pi * fwhm**2 / (4 * math.log(2))
    assert found["K_RJ"] == 1
    assert found["K_CMB"] == pytest.approx(1 / float(cmb_slope(centre)), rel=1e-4)
    assert found["MJy/sr"] == pytest.approx(brightness * 1e20, rel=1e-4)
    assert found["Jy/beam"] == pytest.approx(brightness * omega * 1e26, rel=1e-4)
    assert found["Jy"] == pytest.approx(2 * found["Jy/beam"])


def test_a_point_source_is_seen_with_the_depth_that_is_stated(found):
    """A map with a source of 1 Jy, smoothed with the beam, peaks at 1 / (2 Omega) in surface
    brightness.
    """
    pixel = 2 * ARCSEC
    y, x = np.indices((201, 201)) - 100
    sigma = found.survey.sigma / pixel
    beam = np.exp(-(x**2 + y**2) / (2 * sigma**2))
    source = (
        beam
        / (beam.sum() * pixel**2)
        / found.factors["Jy/beam"]
        * (found.survey.fwhm**2 * math.pi / math.log(16))
    )  # K_RJ of 1 Jy
    peak = (source * beam).sum() / beam.sum()
    assert peak * found.factors["Jy"] == pytest.approx(1, rel=1e-3)


TURNED = """\
seed: 13
site: mauna_kea
instrument: {name: cam, telescope: {name: dish, diameter: 12 m}, detectors: 37, field_of_view: 0.6 arcmin,
  main_beam_efficiency: 0.6, illumination_efficiency: 0.9, net: 0.2 mK s(1/2), knee: 1 Hz, sample_rate: 50 Hz,
  band: {name: b80, low: 80 GHz, high: 105 GHz}}
time: 2022-08-09T16:00
target: az 49 deg el 75 deg
weather: {pwv: 1 mm}
operators:
- PointingDaisy: {radius: 3 arcmin, speed: 100 arcsec/s, scan_duration: 45 s, scans: 2, check_limits: warn}
- AtmosphereLayers: {pwv_rms: 1 %}
- WhiteNoise: {net: 0.2 mK s(1/2), reference: detector}
- PinkNoise
- Efficiency
- HighpassFilter: {frequency: 0.05 Hz}
- CommonModeFilter
- BinMap: {pixel: 20 arcsec, width: 8 arcmin}
- SaveMap
"""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("method", "forecast"), [("svd", False), ("mean", True)])
def test_a_mode_that_noise_turns_is_not_forecast(tmp_path, method, forecast):
    """The camera looks through one beam: what detectors see differently is far below what a turned
    mode leaves of the common mode, 92 uK of simulations where 9 were forecast. The detectors' mean
    does not turn."""
    (tmp_path / "p.yaml").write_text(TURNED)
    file = zonda.load(tmp_path / "p.yaml", overrides=[f"CommonModeFilter.method={method}"])
    found = zonda.sensitivity(file, radius="2.75 arcmin")
    assert np.isfinite(found.rms(part="atmosphere")) == forecast
    assert ("noise turns the singular mode" in str(found)) != forecast
