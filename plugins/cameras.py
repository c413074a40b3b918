"""Cameras of several bands: each name in `CAMERAS` is an attribute of this module, for an entry point.

Published numbers and their sources stand in `provenance`; a part that begins with "stand-in:" says what is not published, or not
known to us, and what stands for it. NETs are published as those of the CMB's temperature (K_CMB) and turned into K_RJ at the
centre of the band. `zonda show instrument NAME` shows an instrument with its sources.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from zonda.core.instrument import Instrument
from zonda.core.numerics.radiation import cmb_slope

from .instruments import TELESCOPES


class Channel(NamedTuple):
    """A band: name, edges [GHz], detectors, FWHM (None: the diffraction limit), NET of one detector, its source.

    ``net``: [uK s(1/2)], of the CMB's temperature where ``cmb``, else Rayleigh-Jeans.
    """

    name: str
    low: float
    high: float
    detectors: int
    fwhm: str | None
    net: float
    cmb: bool = True

    def written(self) -> dict[str, Any]:
        """As configuration."""
        centre = (self.low + self.high) / 2
        net = self.net * (float(cmb_slope(centre * 1e9)) if self.cmb else 1.0)
        found = {"name": self.name, "low": f"{self.low} GHz", "high": f"{self.high} GHz", "detectors": self.detectors}
        return found | {"net": f"{net:.4g} uK s(1/2)"} | ({"fwhm": self.fwhm} if self.fwhm else {})


class Survey(NamedTuple):
    """What the channels of a camera share; its sources and its stand-ins."""

    description: str
    telescope: str
    field_of_view: str
    channels: tuple[Channel, ...]
    sources: tuple[str, ...]
    stand_ins: tuple[str, ...]
    wafers: int = 1
    pixels: str = "shared"
    knee: str = "0.05 Hz"
    sample_rate: str = "200 Hz"
    efficiencies: tuple[float, float] = (0.7, 0.95)
    polarization: str = "pairs"


SO = (
    "wafers, pixels, band edges, NETs and knee: sotodlib's hardware model (sotodlib/sim_hardware.py, simonsobs/sotodlib)",
    "beams: The Simons Observatory Collaboration 2019, JCAP 02, 056, Table 1",
)
S4 = (
    "wafers, pixels, band edges, NETs, knee, slope and beams: CMB-S4's hardware model (s4sim/hardware/config.py, CMB-S4/s4sim), "
    "of one Chilean telescope",
)
ACT = (
    "detectors: 1716 in PA5 and in PA6, 2012 in PA4 (arXiv:1607.06064, arXiv:1711.04841)",
    "bands about 98, 150 and 220 GHz: Naess et al. 2025, arXiv:2503.14451",
)
EFFICIENCIES = "main-beam and illumination efficiency: assumed"
FLAT = "passbands: flat between edges"
SLOPE = "slope of 1/f noise: 1 (the hardware model has 3.5, an instrument may have up to 3 here)"
TUBES = "layout and field of view: wafers edge to edge (in the telescope they stand by threes in optics tubes, 1.78 deg apart)"
ACT_OWN = (
    "NET: 300 uK_CMB s(1/2), of the order of photon noise in these bands at the site",
    "knee and sample rate: assumed",
    "band edges: round, flat",
    "field of view: 0.9 deg, one array",
    "layout: one hexagonal patch",
    "beams: 2.1, 1.4 and 1 arcmin, rounded",
)


def _so(array: str, telescope: str, field: str, wafers: int, channels: tuple[Channel, ...], where: str) -> Survey:
    text = f"Simons Observatory {telescope[3:]}, {array}: {wafers} wafers"
    stand_ins = (where, SLOPE, EFFICIENCIES, FLAT)
    return Survey(text, telescope, field, channels, SO, stand_ins, wafers)


def _act(array: str, *channels: Channel) -> Survey:
    text = f"{array} of the Advanced ACT camera: one wafer of dichroic pixels"
    return Survey(text, "ACT", "0.9 deg", channels, ACT, (*ACT_OWN, EFFICIENCIES), knee="0.1 Hz", sample_rate="400 Hz")


SAT = "layout: wafers edge to edge in 35 deg"
PLATE = "layout and field of view: wafers edge to edge in 7.8 deg"

CAMERAS = {
    "so_lat_lf": _so("low frequencies", "SO LAT", "1.3 deg", 3, (
        Channel("f030", 21.7, 29.7, 222, "7.4 arcmin", 435.1),
        Channel("f040", 30.9, 46.9, 222, "5.1 arcmin", 281.5),
    ), "field of view: 1.3 deg, of three wafers of 0.64 deg"),
    "so_lat_mf": _so("middle frequencies", "SO LAT", "4.9 deg", 12, (
        Channel("f090", 79, 105, 10_368, "2.2 arcmin", 361.0),
        Channel("f150", 130, 165, 10_368, "1.4 arcmin", 352.4),
    ), TUBES),
    "so_lat_uhf": _so("ultra-high frequencies", "SO LAT", "3.1 deg", 6, (
        Channel("f220", 196.7, 254.7, 5_184, "1.0 arcmin", 724.4),
        Channel("f280", 258.4, 312.4, 5_184, "0.9 arcmin", 1803.9),
    ), TUBES),
    "so_sat_lf": _so("low frequencies", "SO SAT", "35 deg", 7, (
        Channel("f030", 21.7, 29.7, 518, "91 arcmin", 314.1),
        Channel("f040", 30.9, 46.9, 518, "63 arcmin", 225.8),
    ), SAT),
    "so_sat_mf": _so("middle frequencies", "SO SAT", "35 deg", 7, (
        Channel("f090", 79, 105, 6_048, "30 arcmin", 245.1),
        Channel("f150", 130, 165, 6_048, "17 arcmin", 250.2),
    ), SAT),
    "so_sat_uhf": _so("ultra-high frequencies", "SO SAT", "35 deg", 7, (
        Channel("f220", 196.7, 254.7, 6_048, "11 arcmin", 540.3),
        Channel("f280", 258.4, 312.4, 6_048, "9 arcmin", 1397.5),
    ), SAT),
    "act_pa4": _act(
        "PA4", Channel("f150", 126, 172, 1_006, "1.4 arcmin", 300.0), Channel("f220", 185, 265, 1_006, "1 arcmin", 300.0)
    ),
    "act_pa5": _act(
        "PA5", Channel("f090", 80, 116, 858, "2.1 arcmin", 300.0), Channel("f150", 126, 172, 858, "1.4 arcmin", 300.0)
    ),
    "act_pa6": _act(
        "PA6", Channel("f090", 80, 116, 858, "2.1 arcmin", 300.0), Channel("f150", 126, 172, 858, "1.4 arcmin", 300.0)
    ),
    "spt3g_trichroic": Survey(
        "SPT-3G on the 10 m South Pole Telescope: 10 wafers of 269 trichroic pixels", "SPT", "1.9 deg",
        (
            Channel("f095", 82, 108, 5_380, "1.6 arcmin", 500.0, False),
            Channel("f150", 130, 168, 5_380, "1.2 arcmin", 400.0, False),
            Channel("f220", 194, 246, 5_380, "1 arcmin", 700.0, False),
        ),
        ("10 wafers of 269 pixels, each with two detectors in each of three bands: Dutcher et al. 2018, SPIE 10708",
         "field of view, 1.9 deg: Sobrin et al. 2022, ApJS 258, 42"),
        ("sample rate: after public descriptions",
         "NET: round values in K_RJ", "beams: rounded to 0.1 arcmin", "knee: assumed", "band edges: round, flat", EFFICIENCIES,
         "layout: wafers edge to edge"),
        wafers=10, sample_rate="152.6 Hz",
    ),
    "toltec_3band": Survey(
        "TolTEC on the 50 m Large Millimeter Telescope: three arrays that look at the same field", "LMT", "4 arcmin",
        (
            Channel("a2000", 128, 170, 1_172, "11 arcsec", 300.0, False),
            Channel("a1400", 195, 245, 2_534, "7 arcsec", 400.0, False),
            Channel("a1100", 245, 310, 4_012, "5 arcsec", 500.0, False),
        ),
        ("beams: Wilson et al. 2020, SPIE 11453", "field of view, 4 arcmin: Bryan et al. 2018, SPIE 10708",
         "detectors: public descriptions of the instrument"),
        ("NET: round values in K_RJ", "knee: assumed", "band edges: round, flat", EFFICIENCIES,
         "layout: one hexagonal patch for each array"),
        pixels="overlaid", knee="0.2 Hz", sample_rate="122 Hz", efficiencies=(0.4, 0.9),
    ),
    "ccat_primecam": Survey(
        "three modules of Prime-Cam on the 6 m Fred Young Submillimeter Telescope (CCAT)", "FYST", "2.88 deg",
        (
            Channel("f280", 250, 310, 10_368, None, 200.0, False),
            Channel("f350", 330, 370, 10_368, None, 400.0, False),
            Channel("f850", 790, 910, 41_400, None, 2000.0, False),
        ),
        ("detectors: three arrays of 3456 at 280 GHz (arXiv:2410.21396), 41 400 at 850 GHz (arXiv:2208.09560)",
         "a field of 1.3 deg for each module: CCAT-Prime Collaboration 2023, ApJS 264, 7"),
        ("detectors at 350 GHz: as many as at 280 GHz", "beams: the diffraction limit 1.22 lambda / D",
         "NET: round values in K_RJ, 2 mK at 850 GHz", "knee: assumed", "band edges: round, flat", EFFICIENCIES,
         "layout: each module has three wafers edge to edge, the modules stand next to each other in 2.88 deg"),
        wafers=3, pixels="separate", knee="0.1 Hz", efficiencies=(0.6, 0.95),
    ),
    "cmb_s4_lat_lf": Survey(
        "CMB-S4's Large Aperture Telescope, low frequencies: 8 wafers", "CMB-S4 LAT", "7.8 deg",
        (Channel("f030", 21.5, 30, 768, "7.4 arcmin", 307.7), Channel("f040", 30, 47.5, 768, "5.1 arcmin", 240.7)),
        S4, (PLATE, EFFICIENCIES, FLAT), wafers=8,
    ),
    "cmb_s4_lat_mf": Survey(
        "CMB-S4's Large Aperture Telescope, middle frequencies: 54 wafers", "CMB-S4 LAT", "7.8 deg",
        (Channel("f090", 77, 106, 46_656, "2.2 arcmin", 278.1), Channel("f150", 128, 169, 46_656, "1.4 arcmin", 309.6)),
        S4, (PLATE, EFFICIENCIES, FLAT), wafers=54,
    ),
    "cmb_s4_lat_hf": Survey(
        "CMB-S4's Large Aperture Telescope, high frequencies: 23 wafers", "CMB-S4 LAT", "7.8 deg",
        (Channel("f220", 197.9, 256.1, 21_574, "1.0 arcmin", 683.2), Channel("f280", 256, 315, 21_574, "0.9 arcmin", 1679.7)),
        S4, (PLATE, EFFICIENCIES, FLAT), wafers=23,
    ),
}  # fmt: skip
"""By name."""


def __getattr__(name: str) -> Instrument:
    if name not in CAMERAS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    camera = CAMERAS[name]
    zeta, epsilon = camera.efficiencies
    given = {
        "name": name,
        "description": camera.description,
        "telescope": TELESCOPES[camera.telescope],
        "bands": [channel.written() for channel in camera.channels],
        "pixels": camera.pixels,
        "field_of_view": camera.field_of_view,
        "layout": "wafers" if camera.wafers > 1 else "hexagon",
        "wafers": camera.wafers,
        "polarization": camera.polarization,
        "main_beam_efficiency": zeta,
        "illumination_efficiency": epsilon,
        "knee": camera.knee,
        "sample_rate": camera.sample_rate,
        "provenance": "; ".join([*camera.sources, *(f"stand-in: {text}" for text in camera.stand_ins)]),
    }
    return Instrument.model_validate(given)


def __dir__() -> list[str]:
    return sorted(CAMERAS)
