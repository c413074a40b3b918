"""ASTE's antenna logs: the beam is where the programme wanted it, plus the error of tracking; only
scans are used.
"""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import zonda
from zonda.core.errors import InputError
from zonda.core.flags import IRREGULAR, TURNAROUND

pytestmark = pytest.mark.filterwarnings("ignore:PointingRecorded")

HEAD = (
    "#time ra-prg dec-prg az-prg el-prg az-real el-real x y z xt yt zt lst az-prg(no-cor)"
    " el-prog(no-cor) az-prog(center) type"
)
END = "20900909090909.9 " + 17 * " 999.00000" + " END\n"
SITE = {
    "name": "aste",
    "latitude": "-22.9715818 deg",
    "longitude": "-67.7033042 deg",
    "altitude": "4861.9 m",
}
STATES = ["GRAD"] * 5 + ["ACC"] * 3 + ["SCAN"] * 20 + ["TRAN"] * 4 + ["ON"] * 8


def rows() -> tuple[list[str], Any, Any]:
    """A log of 40 rows across north, with corrections of 0.3 deg and errors of tracking of arcsec;
    where the beam is, deg.
    """
    draw = np.random.default_rng(1)
    azimuth, elevation = 359.98 + 0.002 * np.arange(40), 55 + 0.001 * np.arange(40)
    errors = draw.normal(0, 1e-3, (40, 2))
    lines = []
    for k, state in enumerate(STATES):
        wanted = [(azimuth[k] + 0.3) % 360, elevation[k] - 0.2]
        real = [(azimuth[k] + 0.3 + errors[k, 0]) % 360, elevation[k] - 0.2 + errors[k, 1]]
        own = [azimuth[k] % 360, elevation[k]]
        numbers = [264.2, -22.3, *wanted, *real, 3.76, -0.43, -4.2, 0, 0, 0, 17.1, *own, *own]
        moment = datetime(2017, 11, 3, 23, 59, 59) + k * timedelta(seconds=0.1)  # across midnight
        lines.append(
            f"{moment:%Y%m%d%H%M%S.%f}"[:16] + "".join(f" {n:.5f}" for n in numbers) + f" {state}\n"
        )
    return lines, azimuth + errors[:, 0], elevation + errors[:, 1]


def observed(path: Path) -> Any:
    scene = zonda.Scene(
        site=zonda.Site(**SITE),
        instrument={"like": "laboca", "detectors": 7},
        time="2017-11-03T23:59:59",
    )
    data = zonda.Data(scene)
    zonda.PointingRecorded(file=path).observe(data)
    return data.observations


def test_the_beam_and_what_is_used(tmp_path: Path) -> None:
    lines, azimuth, elevation = rows()
    path = tmp_path / "20171103235959.ant"
    path.write_text(HEAD + "\n" + "".join(lines) + END)
    (o,) = observed(path)
    assert str(o.start) == "2017-11-03T23:59:59Z"
    assert o.n_samples == 40
    assert o.sample_rate == pytest.approx(10, rel=1e-9)
    # the log has five digits, each of three columns rounded to 5e-6 deg
    np.testing.assert_allclose(
        (np.degrees(o.azimuth) - azimuth + 180) % 360, 180, rtol=0, atol=1.6e-5
    )
    np.testing.assert_allclose(np.degrees(o.elevation), elevation, rtol=0, atol=1.6e-5)
    expected = {"SCAN": 0, "ON": 0, "ACC": TURNAROUND, "TRAN": TURNAROUND, "GRAD": IRREGULAR}
    np.testing.assert_array_equal(o.flags, [expected[state] for state in STATES])


def test_lost_rows_are_a_gap(tmp_path: Path) -> None:
    lines, *_ = rows()
    path = tmp_path / "gap.ant"
    path.write_text(HEAD + "\n" + "".join(lines[:12] + lines[15:]))
    (o,) = observed(path)
    assert o.n_samples == 40
    assert o.good_samples.sum() == 28 - 3


def with_elevation(line: str, degrees: str) -> str:
    """The row with another el-prog(no-cor)."""
    words = line.split()
    words[15] = degrees
    return " ".join(words) + "\n"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda lines: [*lines[:3], lines[3].replace("20171103", "2017111x")],
            "line 5: time",
        ),
        (lambda lines: [*lines[:3], lines[3][:60] + "\n"], "line 5: has "),
        (lambda lines: [], "has no row of a scan"),
        (
            lambda lines: [*lines[:3], with_elevation(lines[3], "140.00000")],
            "el is 1[34].* deg in row 3",
        ),
    ],
)
def test_bad_logs(tmp_path: Path, change: Any, message: str) -> None:
    lines, *_ = rows()
    path = tmp_path / "bad.ant"
    path.write_text(HEAD + "\n" + "".join(change(lines)) + END)
    with pytest.raises(InputError, match=message) as caught:
        observed(path)
    assert "bad.ant" in caught.value.place
    assert caught.value.cure


def test_a_log_of_other_columns(tmp_path: Path) -> None:
    """Its names are read: columns in another order are the same angles."""
    lines, azimuth, _ = rows()
    path = tmp_path / "other.ant"
    path.write_text(HEAD.replace("az-real", "az-rel") + "\n" + "".join(lines) + END)
    with pytest.raises(InputError, match="has no column 'az-real'"):
        observed(path)
    swapped = [line.split(" ") for line in lines]
    for words in swapped:
        words[5], words[6] = words[6], words[5]
    head = HEAD.replace("az-real el-real", "el-real az-real")
    head = head.replace("az-prg(no-cor)", "az-prog(no-cor)")
    path.write_text(head + "\n" + "".join(" ".join(words) for words in swapped) + END)
    (o,) = observed(path)
    np.testing.assert_allclose(
        (np.degrees(o.azimuth) - azimuth + 180) % 360, 180, rtol=0, atol=1.6e-5
    )
