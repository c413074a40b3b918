"""Campaigns that co-add entries of several beams, instruments and sites: the map's beam and
header.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from zonda.core.instrument import Band
from zonda.core.maps.map_file import listed
from zonda.core.numerics.radiation import to_kelvin_rj

from ...scenes import camera
from .conftest import command

YAML = """\
{camera}campaign:
  observations:
    - {first}
    - {second}
operators:
  - PointingDaisy: {{radius: 2 arcmin, speed: 30 arcsec/s, scan_duration: 300 s}}
  - PointSources: {{catalogue: source.ecsv}}
  - Efficiency
  - BinMap: {{pixel: 3 arcsec, width: 2 arcmin}}
  - SaveMap
"""
UNITS = {"ra": "deg", "dec": "deg", "flux": "Jy"}
WIDE = "{instrument.fwhm: 1.4 arcmin, instrument.name: wide, instrument.telescope.name: near}"
NARROW = "{instrument.fwhm: 40 arcsec, instrument.name: narrow, instrument.telescope.name: far}"


def header(tmp_path, first, second):
    from astropy.io import fits

    columns = "".join(
        f"# - {{name: {name}, unit: {unit}, datatype: float64}}\n" for name, unit in UNITS.items()
    )
    (tmp_path / "source.ecsv").write_text(
        f"# %ECSV 1.0\n# ---\n# datatype:\n{columns}ra dec flux\n75 20 0.5\n"
    )
    file, out = tmp_path / "p.yaml", tmp_path / f"out_{first[12:18]}_{len(second)}"
    file.write_text(YAML.format(camera=camera(1), first=first, second=second))
    with pytest.warns(UserWarning, match="beams of 40″ to 1.4′ are in one map"):
        status = command(
            "run", file, "--output", out, "--engine", "serial", "--threads", 1, "--no-prune"
        )
    assert status == 0
    with fits.open(out / "map.fits") as hdus:
        return dict(hdus[0].header), np.array(hdus[0].data)


def test_names_that_a_card_does_not_hold_stand_in_the_history():
    assert listed(["b", "a", "b"]) == ("a, b", [])
    many = [f"camera number {k:02d}" for k in range(9)]
    assert listed(many) == ("9 of them, see HISTORY", many)


def test_beams_and_names_of_all_entries(tmp_path):
    """1.4 arcmin and 40 arcsec: BMAJ was that of the first entry, and the flux of 0.5 Jy 0.95 or
    0.22 Jy by their order.
    """
    (one, signal), (other, again) = header(tmp_path, WIDE, NARROW), header(tmp_path, NARROW, WIDE)
    np.testing.assert_array_equal(signal, again)
    assert (
        one["BMAJ"]
        == other["BMAJ"]
        == pytest.approx(math.sqrt(2 / (1.4**-2 + 1.5**2)) / 60, rel=1e-6)
    )
    for found in (one, other):
        assert found["INSTRUME"] == "narrow, wide"
        assert found["TELESCOP"] == "far, near"
        assert found["BEAMLOW"] == pytest.approx(40 / 3600)
        assert found["BEAMHIGH"] == pytest.approx(1.4 / 60)
    beam = math.pi / math.log(16) * math.radians(one["BMAJ"]) ** 2
    band = Band(name="b", low="80 GHz", high="100 GHz")
    # the brightest pixel's centre is within 2.2 arcsec of the source: 0.992 of the narrower beam;
    # as much is averaged away
    assert np.nanmax(signal) / to_kelvin_rj(
        "Jy/beam", band, beam_solid_angle=beam
    ) == pytest.approx(0.5, rel=0.02)
