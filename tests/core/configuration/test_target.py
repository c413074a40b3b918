import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from zonda.core.configuration.target import Target

longitudes = st.floats(0, 2 * math.pi, exclude_max=True)
latitudes = st.floats(-math.pi / 2, math.pi / 2)
frames = st.sampled_from(["icrs", "galactic", "horizontal"])


class Model(BaseModel):
    target: Target


@pytest.mark.parametrize(
    ("given_", "frame", "longitude", "latitude"),
    [
        ("05h00m00s +20d00m00s", "icrs", 75, 20),
        ("13:47:30.6 -11:45:09", "icrs", 206.8775, -11.7525),
        ("13h47m30.6s, -11d45m09s", "icrs", 206.8775, -11.7525),
        ("75 deg 20 deg", "icrs", 75, 20),
        ("ICRS 75deg -0d30m", "icrs", 75, -0.5),
        ("12.5h \N{MINUS SIGN}3.2 deg", "icrs", 187.5, -3.2),
        ("ra=75 deg, dec=20 deg", "icrs", 75, 20),
        ("galactic 120.5 deg -30 deg", "galactic", 120.5, -30),
        ("galactic 120:30:00 -30:00:00", "galactic", 120.5, -30),
        ("l 120.5 deg b -30 deg", "galactic", 120.5, -30),
        ("az 180 deg el 60 deg", "horizontal", 180, 60),
        ("horizontal 180 deg 3600 arcmin", "horizontal", 180, 60),
        ({"ra": "5h", "dec": "20 deg"}, "icrs", 75, 20),
        ({"l": "120.5 deg", "b": "-30 deg"}, "galactic", 120.5, -30),
        ({"az": "-90 deg", "el": "60 deg"}, "horizontal", 270, 60),
        ("0h -90 deg", "icrs", 0, -90),
    ],
)
def test_every_way_to_write_it(
    given_: object, frame: str, longitude: float, latitude: float
) -> None:
    target = Model(target=given_).target  # type: ignore[arg-type]
    assert target.frame == frame
    assert np.degrees([target.longitude, target.latitude]) == pytest.approx(
        [longitude, latitude], rel=1e-15, abs=1e-15
    )


def test_quantities() -> None:
    import astropy.units as u

    target = Target.parse({"ra": 5 * u.hourangle, "dec": 20 * u.deg})
    assert np.degrees([target.longitude, target.latitude]) == pytest.approx([75, 20], rel=1e-15)


@given(frames, longitudes, latitudes)
def test_text_round_trip_keeps_the_bits(frame: str, longitude: float, latitude: float) -> None:
    target = Target(frame, longitude, latitude)  # type: ignore[arg-type]
    assert Target.parse(str(target)) == target
    assert eval(repr(target)) == target
    assert Model.model_validate_json(Model(target=target).model_dump_json()).target == target


@given(st.integers(-720, 720), st.integers(-3, 3))
def test_a_whole_turn_of_right_ascension_moves_nothing(degrees: int, turns: int) -> None:
    assert Target.parse(f"{degrees + 360 * turns} deg 20 deg") == Target.parse(
        f"{degrees} deg 20 deg"
    )


def test_galactic_is_astropys() -> None:
    from astropy.coordinates import SkyCoord

    rng = np.random.default_rng(3)
    for longitude, latitude in zip(
        rng.uniform(0, 2 * np.pi, 50), np.arcsin(rng.uniform(-1, 1, 50)), strict=True
    ):
        ra, dec = Target("galactic", longitude, latitude).icrs()
        theirs = SkyCoord(longitude, latitude, unit="rad", frame="galactic").icrs
        assert abs(dec - theirs.dec.rad) < 1e-14
        assert abs((ra - theirs.ra.rad + math.pi) % (2 * math.pi) - math.pi) * math.cos(dec) < 1e-14


def test_icrs_of_icrs_is_itself_and_horizontal_has_none() -> None:
    assert Target.parse("75 deg 20 deg").icrs() == (math.radians(75), math.radians(20))
    with pytest.raises(ValueError, match="no fixed ICRS position"):
        Target.parse("az 180 deg el 60 deg").icrs()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("Crab", "names of objects are not looked up"),
        ("75 20", "ra '75' has no unit; write an angle such as '75 deg'"),
        ("75 deg", "'75 deg' is one angle; a position needs two"),
        (
            "+25:00",
            "'+25:00' is one angle; a position needs two, a right ascension and a declination",
        ),
        ("05h00m00s", "is one angle"),
        ("05 00 +20 00", "cannot read"),
        (
            "05:00:00 +20:00:00 J2000",
            "positions are ICRS (FK5 J2000 to 0.1 arcsec); 'J2000' is not read",
        ),
        ("B1950 05:00:00 +20:00:00", "'B1950' is not read"),
        ("25:00 +20:00", "the hours of ra '25:00' must be below 24"),
        ("24h00m00s +20d", "the hours of ra '24h00m00s' must be below 24"),
        (["75 deg"], "expected a position such as"),
        (["75 deg", "2 K"], "unknown unit 'k' in dec"),
        ("5h 95 deg", "dec must lie between -90 deg and 90 deg, got 95 deg"),
        ("az 10 deg el -91 deg", "el must lie between"),
        ("05h61m00s 20 deg", "must be below 60"),
        ("az 10 deg dec 20 deg", "do not belong together"),
        ("galactic ra 10 deg dec 20 deg", "do not belong together"),
        ("10 Hz 20 deg", "unknown unit 'hz'"),
        ({"ra": "5h"}, "exactly the keys ra and dec, l and b, or az and el, not ra"),
        ({"ra": 75, "dec": "2 deg"}, "has no unit"),
        ({"ra": None, "dec": "2 deg"}, "must be an angle"),
        (75.0, "expected a position such as"),
    ],
)
def test_bad_positions_say_what_is_expected(bad: object, message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Model(target=bad)  # type: ignore[arg-type]
    (error,) = caught.value.errors()
    assert error["loc"] == ("target",)
    assert message in error["msg"]


def test_forms_that_people_bring_along() -> None:
    from astropy.coordinates import SkyCoord

    wanted = Target.parse("13:47:30.6 -11:45:09")
    for form in (
        "13 47 30.6 -11 45 09",
        "13 47 30.6, -11 45 09",
        ["13:47:30.6", "-11:45:09"],
        {"ra": "13:47:30.6", "dec": "-11:45:09"},
    ):
        assert Target.parse(form) == wanted
    there = Target.parse(SkyCoord("13h47m30.6s -11d45m09s"))
    assert there.frame == "icrs"
    assert (
        abs(there.longitude - wanted.longitude) < 1e-15 * 2 * math.pi
    )  # two roundings of astropy's own at most
    assert abs(there.latitude - wanted.latitude) < 1e-15


def test_schema_examples_parse() -> None:
    field = Model.model_json_schema()["properties"]["target"]
    assert all(Target.parse(example) for example in field["examples"])


def test_degrees_beyond_all_numbers():
    with pytest.raises(ValueError, match="must be below 1e6"):
        Target.parse(f"{'9' * 400}d00m00s +20d00m00s")
