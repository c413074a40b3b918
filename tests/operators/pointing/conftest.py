from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from zonda.core.data import Data
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.operator import Operator
from zonda.core.scene import Scene
from zonda.core.site import Site

SITE = Site(name="Green Bank", latitude="38.4331 deg", longitude="-79.8398 deg", altitude="818 m")
START = "2024-11-25T07:00:00.123456789Z"
TARGET = "05h00m00s +20d00m00s"


def instrument(**telescope: Any) -> Instrument:
    return Instrument(
        name="camera",
        telescope=Telescope(**{"name": "GBT", "diameter": "100 m", **telescope}),
        band=Band(name="b", low="78 GHz", high="108 GHz"),
        detectors=7,
        field_of_view="4.2 arcmin",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1.7 mK s(1/2)",
        sample_rate="100 Hz",
    )


@pytest.fixture
def observe() -> Callable[..., Data]:
    """Run one pointing operator: ``observe(operator, site=..., target=..., telescope={...})``."""

    def run(operator: Operator, *, telescope: dict[str, Any] | None = None, **scene: Any) -> Data:
        whole = {
            "site": SITE,
            "instrument": instrument(**telescope or {}),
            "time": START,
            "target": TARGET,
            **scene,
        }
        data = Data(Scene(**whole))
        operator.observe(data)
        return data

    return run


@pytest.fixture(scope="session")
def astropy_offline() -> Iterator[None]:
    """Let astropy use the same bundled table (IERS C04), and download nothing."""
    from astropy.utils import iers

    with (
        iers.conf.set_temp("auto_download", False),
        iers.earth_orientation_table.set(iers.IERS_B.open()),
    ):
        yield


class Reference:
    """astropy's full transformation at one site."""

    @staticmethod
    def frame(start: Any, seconds: Any, site: Site = SITE) -> Any:
        import astropy.units as u
        from astropy.coordinates import AltAz, EarthLocation
        from astropy.time import Time

        # by calendar: days with a leap second are longer
        date = f"{start.datetime:%Y-%m-%dT%H:%M:%S}.{start.nanoseconds % 10**9:09d}"
        time = Time(date, scale="utc") + np.asarray(seconds) * u.s
        location = EarthLocation.from_geodetic(
            site.longitude * u.rad, site.latitude * u.rad, site.altitude * u.m
        )
        return AltAz(obstime=time, location=location, pressure=0 * u.hPa)

    @classmethod
    def horizontal(cls, icrs: Any, start: Any, seconds: Any, site: Site = SITE) -> Any:
        """(n, 3) north, west, up of ICRS unit vectors (n, 3)."""
        from astropy.coordinates import SkyCoord, UnitSphericalRepresentation

        x, y, z = np.asarray(icrs).T
        sky = SkyCoord(np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), unit="rad", frame="icrs")
        there = sky.transform_to(cls.frame(start, seconds, site)).represent_as(
            UnitSphericalRepresentation
        )
        az, el = there.lon.rad, there.lat.rad
        return np.stack([np.cos(el) * np.cos(az), -np.cos(el) * np.sin(az), np.sin(el)], axis=-1)

    @classmethod
    def icrs(cls, horizontal: Any, start: Any, seconds: Any, site: Site = SITE) -> Any:
        """(n, 3) ICRS unit vectors of directions (n, 3) north, west, up."""
        from astropy.coordinates import SkyCoord

        x, y, z = np.asarray(horizontal).T
        frame = cls.frame(start, seconds, site)
        there = SkyCoord(
            np.arctan2(-y, x), np.arctan2(z, np.hypot(x, y)), unit="rad", frame=frame
        ).icrs
        ra, dec = there.ra.rad, there.dec.rad
        return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


@pytest.fixture
def reference(astropy_offline: None) -> type[Reference]:
    return Reference
