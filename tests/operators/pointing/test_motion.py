"""Speed, acceleration and jerk of the axes, from the track: against derivatives in longer
arithmetic and closed forms.
"""

import math
import re
import warnings
from collections.abc import Callable
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from zonda.core.data import Data
from zonda.core.errors import PointingError
from zonda.core.numerics.sphere import unit_vectors
from zonda.operators.pointing.azimuth_scan import PointingBackAndForth
from zonda.operators.pointing.base import Aim, Pointing, PointingStare
from zonda.operators.pointing.daisy import PointingDaisy
from zonda.operators.pointing.motion import motion, peak_lost

ARCSEC = math.radians(1 / 3600)


def wave(amplitude: float, omega: float, elevation: float) -> Callable[[np.ndarray], np.ndarray]:
    """Directions whose azimuth swings by ``amplitude`` sin(omega t) and whose elevation by a tenth
    of it, cosine.
    """

    def track(t: np.ndarray) -> np.ndarray:
        return unit_vectors(
            -amplitude * np.sin(omega * t), elevation + 0.1 * amplitude * np.cos(omega * t)
        )

    return track


@settings(max_examples=40, deadline=None)
@example(0.25, 1.5703125, 1.0, 5.0)  # 20 samples in a period, none at a peak
@given(
    st.floats(1e-4, 0.3),
    st.floats(0.05, 20.0),
    st.floats(0.2, 1.3),
    st.sampled_from([5.0, 30.0, 100.0, 400.0, 3000.0]),
)
def test_figures_are_those_of_the_closed_form(
    amplitude: float, omega: float, elevation: float, rate: float
) -> None:
    track, length = wave(amplitude, omega, elevation), 20.0 / min(omega, 1.0)
    limits = {("azimuth", k): amplitude * omega**k for k in (1, 2)} | {
        ("elevation", k): 0.1 * amplitude * omega**k for k in (1, 2)
    }
    found = motion(
        track(np.arange(round(length * rate)) / rate),
        rate,
        limits,
        lambda step: track(np.arange(0, length, step)),
    )
    for (axis, order), true in limits.items():
        peak = found[axis, order]
        # difference quotients are means of the derivative; rounding: 2^order x 2 ulp of the angle
        # over step^order, step >= 1 ms
        rounding = 2**order * 4.4e-16 / 1e-3**order
        assert peak.figure <= true * (1 + 1e-9) + rounding
        assert peak.figure >= true * (1 - 0.012) - rounding
        assert true - peak.figure <= 2 * peak.error + 1e-3 * true + rounding
        value = {
            ("azimuth", 1): math.cos,
            ("azimuth", 2): math.sin,
            ("elevation", 1): math.sin,
            ("elevation", 2): math.cos,
        }
        assert abs(value[axis, order](omega * peak.second)) > 0.97


@settings(max_examples=8, deadline=None, phases=[Phase.explicit, Phase.generate])
@example("throw", 0.0625, 2.0, 20.0, 1.0)  # no turnaround in 30 s
@given(
    st.sampled_from(["daisy", "throw"]),
    st.floats(0.05, 1.0),
    st.floats(0.2, 2.0),
    st.floats(20.0, 85.0),
    st.floats(0.0, 6.0),
)
def test_figures_equal_a_brute_force_derivative(
    which: str, speed: float, size: float, elevation: float, azimuth: float
) -> None:
    """Against central differences of the path in 30 digits, every 4 ms near where the figure is
    reached.
    """
    scan: Pointing
    if which == "daisy":
        scan = PointingDaisy(radius=f"{size} deg", speed=f"{speed} deg/s")
    else:
        scan = PointingBackAndForth(
            throw=f"{size} deg", speed=f"{speed} deg/s", acceleration=f"{2 * speed} deg/s2"
        )
    az0, el0 = azimuth, math.radians(elevation)
    target: Any = type("Target", (), {"frame": "horizontal", "longitude": az0, "latitude": el0})()

    def track(step: float) -> np.ndarray:
        return scan.directions(Aim(None, target, (0.0, 0.0)), np.arange(0, 30, step))  # type: ignore[arg-type]

    found = motion(
        track(0.01),
        100.0,
        {("azimuth", 1): 1e-9, ("azimuth", 2): 1e-9, ("elevation", 2): 1e-9},
        track,
    )
    mp.mp.dps = 30

    def angles(t: Any) -> tuple[Any, Any]:
        if which == "throw":  # equation (1) of azimuth_scan
            leg, turn = mp.mpf(scan.throw) / scan.speed, 4 * mp.mpf(scan.speed) / scan.acceleration  # type: ignore[attr-defined]
            count, within = divmod(t, leg + turn)
            u = max((within - leg) / turn, mp.mpf(0))
            x = min(within, leg) * scan.speed - mp.mpf(scan.throw) / 2  # type: ignore[attr-defined]
            x += scan.speed * turn * (u - u * u + (1 - mp.cos(2 * mp.pi * u)) / (2 * mp.pi**2))  # type: ignore[attr-defined]
            return az0 + (x if int(count) % 2 == 0 else -x) / mp.cos(el0), mp.mpf(el0)
        phi = scan.speed * t / mp.mpf(scan.radius)  # type: ignore[attr-defined]
        slow, fast = phi / scan.petals, mp.sqrt(2) * phi / scan.petals  # type: ignore[attr-defined]
        a = mp.mpf(scan.inner)  # type: ignore[attr-defined]
        x = scan.radius * (mp.sin(phi) * mp.cos(slow) + a * mp.cos(phi) * mp.cos(fast))  # type: ignore[attr-defined]
        y = scan.radius * (mp.sin(phi) * mp.sin(slow) + a * mp.cos(phi) * mp.sin(fast))  # type: ignore[attr-defined]
        north, across, up = mp.cos(el0) - y * mp.sin(el0), x, mp.sin(el0) + y * mp.cos(el0)
        return az0 + mp.atan2(across, north), mp.atan2(up, mp.hypot(north, across))

    for axis, order in (("azimuth", 1), ("azimuth", 2), ("elevation", 2))[
        : 3 if which == "daisy" else 2
    ]:
        peak, k, h = found[axis, order], 0 if axis == "azimuth" else 1, mp.mpf("1e-6")
        largest = mp.mpf(0)
        for j in range(-5, 6):
            t = max(mp.mpf(peak.second) + j * mp.mpf("0.004"), 2 * h)
            minus, here, plus = (angles(t + s * h)[k] for s in (-1, 0, 1))
            value = (plus - minus) / (2 * h) if order == 1 else (plus - 2 * here + minus) / h**2
            largest = max(largest, abs(value))
        assert peak.figure == pytest.approx(
            float(largest), rel=0.02, abs=2**order * 8.9e-16 / 1e-3**order
        )  # an ulp of 4 to 8 rad


def test_a_coarse_sampling_does_not_hide_an_acceleration(observe: Callable[..., Data]) -> None:
    """At 0.05 Hz the samples of this daisy are 20 s apart, its period is 30 s: the track itself is
    looked at.
    """
    scan = {
        "radius": "4 arcmin",
        "speed": "50 arcsec/s",
        "scan_duration": "10 min",
        "sample_rate": "0.05 Hz",
    }
    with pytest.raises(
        PointingError, match=r"acceleration of the elevation axis of 12\.\d+ arcsec/s2"
    ):
        observe(
            PointingDaisy(**scan),
            target="az 0 deg el 40 deg",
            telescope={"elevation_acceleration_max": "10 arcsec/s2"},
        )
    fine = {"elevation_acceleration_max": "14 arcsec/s2"}
    observe(PointingDaisy(**scan), target="az 0 deg el 40 deg", telescope=fine)


LIMITED = [
    (
        PointingDaisy(radius="1 deg", speed="1 deg/s", scan_duration="60 s"),
        45,
        {"acceleration_max": "1 deg/s2"},
    ),
    (
        PointingDaisy(radius="1 deg", speed="1 deg/s", scan_duration="60 s"),
        70,
        {"azimuth_acceleration_max": "1 deg/s2"},
    ),
    (
        PointingDaisy(radius="1 deg", speed="1 deg/s", scan_duration="60 s"),
        60,
        {"elevation_jerk_max": "1 deg/s3"},
    ),
    (
        PointingDaisy(radius="20 arcmin", speed="1 deg/s", scan_duration="30 s"),
        85,
        {"azimuth_speed_max": "3 deg/s"},
    ),
    (
        PointingBackAndForth(
            throw="5 deg", speed="2 deg/s", acceleration="4 deg/s2", scan_duration="30 s"
        ),
        60,
        {"azimuth_speed_max": "3 deg/s"},
    ),
    (
        PointingBackAndForth(
            throw="5 deg", speed="2 deg/s", acceleration="4 deg/s2", scan_duration="30 s"
        ),
        60,
        {"azimuth_acceleration_max": "6 deg/s2"},
    ),
    (
        PointingBackAndForth(
            throw="5 deg", speed="2 deg/s", acceleration="4 deg/s2", scan_duration="30 s"
        ),
        60,
        {"azimuth_acceleration_max": "6 deg/s2", "azimuth_speed_max": "3 deg/s"},
    ),
]


@pytest.mark.parametrize(("scan", "elevation", "limits"), LIMITED)
def test_what_the_error_advises_fits(
    scan: Pointing, elevation: float, limits: dict[str, str], observe: Callable[..., Data]
) -> None:
    target = f"az 100 deg el {elevation} deg"
    with pytest.raises(PointingError) as caught:
        observe(scan, target=target, telescope=limits)
    message, cure = caught.value.message, caught.value.cure
    assert re.search(
        r"the scan reaches an? \w+ (of the \w+ axis|on the sky) of [\d.]+ deg/s\d? \([\d.]+ s after"
        r" its start",
        message,
    )
    assert "this would fit: " in cure
    assert "check_limits: warn" in cure
    advice = re.findall(
        r"(speed|radius|acceleration) ([\d.]+ (?:deg|arcsec)(?:/s2?)?)", cure.split("(check")[0]
    )
    together = " with " in cure
    changes = [dict(advice)] if together else [dict([pair]) for pair in advice]
    assert changes
    for change in changes:
        observe(changed(scan, change), target=target, telescope=limits)
        if together:
            continue
        # and it is no more than needed: a twentieth of the way back does not fit
        ((name, text),) = change.items()
        value, unit = float(text.split()[0]), text.split()[1]
        back = value * (0.95 if name == "radius" else 1.05)
        with pytest.raises(PointingError):
            observe(changed(scan, {name: f"{back} {unit}"}), target=target, telescope=limits)
    if found := re.search(r"an elevation below ([\d.]+) deg", cure):
        observe(scan, target=f"az 100 deg el {found[1]} deg", telescope=limits)


def changed(scan: Pointing, change: dict[str, str]) -> Pointing:
    values = scan.model_dump(mode="json", exclude_unset=True) | change
    return type(scan)(**values)


def test_a_warning_instead_is_repeated_in_the_report(observe: Callable[..., Data]) -> None:
    scan = PointingDaisy(
        radius="1 deg", speed="1 deg/s", scan_duration="60 s", scans=2, check_limits="warn"
    )
    with pytest.warns(
        UserWarning,
        match=(
            r"scan-000 reaches an acceleration on the sky of 1\.23\d* deg/s2 .*largest .* is 1"
            r" deg/s2"
        ),
    ):
        data = observe(
            scan,
            target="az 0 deg el 45 deg",
            telescope={"acceleration_max": "1 deg/s2", "name": "AtLAST"},
        )
    for o in data.observations:
        said = {what: text for _, what, text in o.log}
        assert "1 deg/s2" in said["over the limit of sky acceleration (check_limits: warn)"]
        assert re.search(
            r"sky 1\.23\d* deg/s2 \(124 % of 1 deg/s2\)", said["largest acceleration of the axes"]
        )


def test_near_the_zenith_the_azimuth_axis_runs_away(observe: Callable[..., Data]) -> None:
    """A throw at el 88: the axis turns 1 / cos(el) = 28.65 times as fast as the beam."""
    scan = PointingBackAndForth(
        throw="1 deg", speed="0.2 deg/s", acceleration="0.2 deg/s2", scan_duration="20 s"
    )
    with pytest.raises(
        PointingError, match=r"speed of the azimuth axis of 5\.731 deg/s .*at elevation 88\.00 deg"
    ) as caught:
        observe(scan, target="az 0 deg el 88 deg", telescope={"azimuth_speed_max": "3 deg/s"})
    # arccos(5.731 cos(88 deg) / 3) = 86.18 deg
    assert "an elevation below 86.1 deg" in caught.value.cure
    said = {w: t for _, w, t in observe(scan, target="az 0 deg el 88 deg").observations[0].log}
    assert said["largest speed of the axes"].startswith("azimuth 5.731 deg/s")
    assert "states no limits" in said["largest speed of the axes"]


def test_tracking_through_the_zenith(observe: Callable[..., Data]) -> None:
    """A star that culminates d from the zenith turns the azimuth axis at 15 arcsec/s cos(dec) /
    d.
    """
    with pytest.raises(PointingError, match="speed of the azimuth axis") as caught:
        observe(
            PointingStare(scan_duration="40 min"),
            target="05h00m00s +38d26m00s",
            time="2024-11-25T05:50:00Z",
            telescope={"azimuth_speed_max": "0.5 deg/s"},
        )
    elevation = float(re.search(r"an elevation below ([\d.]+) deg", caught.value.cure)[1])  # type: ignore[index]
    # the star moves by 15.04 arcsec/s cos(38.43 deg) = 11.8 arcsec/s: arccos(11.8 / 1800) = 89.62
    # deg
    assert elevation == pytest.approx(89.6, abs=0.05)


# ---- samples per beam


@given(st.floats(0.3, 100.0))
@settings(max_examples=30, deadline=None)
def test_the_peak_that_integration_costs(samples: float) -> None:
    x = (np.arange(20000) + 0.5) / 20000 - 0.5  # of a sample's interval
    mean = np.exp(-4 * math.log(2) * (x / samples) ** 2).mean()
    assert peak_lost(samples) == pytest.approx(1 - mean, rel=1e-5, abs=1e-12)


def test_few_samples_per_beam_warn(observe: Callable[..., Data]) -> None:
    scan = {
        "throw": "2 deg",
        "speed": "0.2 deg/s",
        "acceleration": "0.2 deg/s2",
        "scan_duration": "9 s",
    }
    with pytest.warns(
        UserWarning, match=r"only 1\.\d+ samples per FWHM of 8\.11 arcsec in scan-000"
    ) as caught:
        (o,) = observe(PointingBackAndForth(**scan), target="az 0 deg el 45 deg").observations
    text = next(str(w.message) for w in caught if "samples per FWHM" in str(w.message))
    # 0.2 deg/s and the sky's own motion of up to 15 arcsec/s, at 100 Hz
    least = float(re.search(r"only ([\d.]+)", text)[1])  # type: ignore[index]
    assert 811 / (720 + 15) <= least <= 811 / (720 - 15)
    assert f"loses {100 * peak_lost(least):.2g} %" in text
    rate = float(re.search(r"read out at (\d+) Hz", text)[1])  # type: ignore[index]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        observe(
            PointingBackAndForth(**scan, sample_rate=f"{rate + 1} Hz"), target="az 0 deg el 45 deg"
        )
    assert any(what == "samples per FWHM of 8.11 arcsec" for _, what, _ in o.log)


def test_a_turning_field_counts(observe: Callable[..., Data]) -> None:
    """Near the zenith the field turns: its rim moves although the boresight tracks."""
    (o,) = observe(
        PointingStare(scan_duration="100 s"),
        target="05h00m00s +38d00m00s",
        time="2024-11-25T05:56:00Z",
    ).observations
    text = next(text for _, what, text in o.log if what.startswith("samples per FWHM"))
    speed = float(re.search(r"at ([\d.]+) arcsec/s", text)[1])  # type: ignore[index]
    psi = np.unwrap(o.derotate("boresight_radec")[2])
    assert speed == pytest.approx(
        np.abs(np.diff(psi)).max() * 100 * math.atan(o.focalplane.radius) / ARCSEC, rel=0.01
    )
    assert speed > 0.1
