"""Cameras of several bands: each name in `CAMERAS` is an attribute of this module, for an entry
point.

Where each number in `NUMBERS` comes from stands in `provenance`: a source, or what stands for a
number that is not published or that we could not look up ("stand-in: "). Sources that say
"abstract" were read no further. NETs are published as those of the CMB's temperature (K_CMB) and
turned into K_RJ at the centre of the band. `zonda show instrument NAME` prints it all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from zonda.core.instrument import Instrument
from zonda.core.numerics.radiation import cmb_slope

from .instruments import TELESCOPES

NUMBERS = (
    "detectors",
    "band edges",
    "passbands",
    "NET",
    "knee and slope",
    "beams",
    "field of view",
    "layout",
    "polarization angles",
    "sample rate",
    "efficiencies",
)
"""What has a source, or a stand-in that is named, in each camera."""
STAND_IN = "stand-in: "
"""Begins the source of a number that is not published or could not be looked up."""


class Channel(NamedTuple):
    """A band: name, edges [GHz], detectors, FWHM, NET of one detector.

    ``net``: [uK s(1/2)], of the CMB's temperature where ``cmb``, else Rayleigh-Jeans.
    """

    name: str
    low: float
    high: float
    detectors: int
    fwhm: str
    net: float
    cmb: bool = True

    def written(self) -> dict[str, Any]:
        """As configuration."""
        centre = (self.low + self.high) / 2
        net = self.net * (float(cmb_slope(centre * 1e9)) if self.cmb else 1.0)
        found = {
            "name": self.name,
            "low": f"{self.low} GHz",
            "high": f"{self.high} GHz",
            "detectors": self.detectors,
        }
        return found | {"net": f"{net:.4g} uK s(1/2)", "fwhm": self.fwhm}


class Survey(NamedTuple):
    """What the channels of a camera share; ``sources`` of `NUMBERS`."""

    description: str
    telescope: str
    field_of_view: str
    channels: tuple[Channel, ...]
    sources: Mapping[str, str]
    layout: str = "hexagon"
    wafers: int = 1
    pixels: str = "shared"
    knee: str = "0.05 Hz"
    sample_rate: str = "200 Hz"
    efficiencies: tuple[float, float] = (0.7, 0.95)

    @property
    def provenance(self) -> str:
        """The sources of all numbers, then the stand-ins, each with its number's name."""
        parts = {number: self.sources[number] for number in NUMBERS}
        named = {
            number: text.removeprefix(STAND_IN)
            for number, text in parts.items()
            if text.startswith(STAND_IN)
        }
        published = [f"{number}: {text}" for number, text in parts.items() if number not in named]
        return "; ".join(
            [*published, *(f"{STAND_IN}{number}: {text}" for number, text in named.items())]
        )


COMMON = {
    "passbands": STAND_IN + "flat between the edges",
    "sample rate": STAND_IN + "assumed",
    "efficiencies": STAND_IN + "main beam and illumination assumed",
    "knee and slope": STAND_IN + "assumed",
    "polarization angles": STAND_IN + "pairs at 0 and 45 deg in turn",
}
"""Of most cameras."""


def _model(files: str, layout: str) -> dict[str, str]:
    """Sources of a camera whose hardware model is public."""
    return COMMON | {
        "detectors": f"pixels of a wafer, less two, and wafers: {files}",
        "band edges": files,
        "NET": f"{files}, K_CMB of one detector without the model's correlation factor",
        "knee and slope": f"{files}, 50 mHz and 1 (flat below 1 mHz here, below 0.01 mHz there)",
        "beams": files,
        "field of view": f"that of the layout, whose scale is {files}",
        "layout": f"every place as {layout}",
        "polarization angles": f"alternate rows of a rhombus, as {layout}",
    }


SOTODLIB = "sotodlib/sim_hardware.py (simonsobs/sotodlib, cfe6397)"
SO = _model(SOTODLIB, "sotodlib/toast/sim_focalplane.py makes it (simonsobs/sotodlib, cfe6397)")
S4SIM = "s4sim/hardware/config.py (CMB-S4/s4sim, 3a15318), telescope LAT0 in Chile"
S4 = _model(S4SIM, "s4sim/hardware/sim.py makes it (CMB-S4/s4sim, 3a15318)")
ROWS = {"polarization angles": STAND_IN + "0 and 45 deg in alternate rows of a wafer"}

EDGES = {
    "lf": (("f030", 21.7, 29.7), ("f040", 30.9, 46.9)),
    "mf": (("f090", 79, 105), ("f150", 130, 165)),
    "uhf": (("f220", 196.7, 254.7), ("f280", 258.4, 312.4)),
}
"""Bands of the Simons Observatory [GHz]."""
PIXELS = {"lf": 37, "mf": 430, "uhf": 430}
"""Pixels of its wafers."""


def _so(where: str, array: str, wafers: int, field: str, *each: tuple[str, float]) -> Survey:
    """``each`` band's FWHM and NET [uK_CMB s(1/2)]."""
    bands = zip(EDGES[array], each, strict=True)
    channels = tuple(
        Channel(*band, 2 * wafers * PIXELS[array], fwhm, net) for band, (fwhm, net) in bands
    )
    words = {"lf": "low", "mf": "middle", "uhf": "ultra-high"}[array]
    tubes = (
        f"{wafers // 3} optics tube{'s' * (wafers > 3)} of 3 wafers"
        if where == "LAT"
        else f"{wafers} wafers"
    )
    own = {} if array != "lf" else ROWS
    if where == "LAT" and array != "mf":
        place = (
            "the tube stands off the boresight there"
            if array == "lf"
            else "the two tubes stand off the boresight there"
        )
        own = own | {
            "field of view": (
                STAND_IN + f"about the boresight, where {place}, its scale is {SOTODLIB}"
            )
        }
    layout = f"so_{where.lower()}" + ("" if where == "SAT" and array != "lf" else f"_{array}")
    text = f"Simons Observatory {where}, {words} frequencies: {tubes}"
    return Survey(text, f"SO {where}", field, channels, SO | own, layout)


def _s4(
    array: str, text: str, field: str, *channels: Channel, own: dict[str, str] | None = None
) -> Survey:
    text = f"CMB-S4's Large Aperture Telescope in Chile, {text} of one wafer"
    return Survey(text, "CMB-S4 LAT", field, channels, S4 | (own or {}), f"cmb_s4_lat_{array}")


ACT = COMMON | {
    "detectors": (
        "2012 in PA4, 1716 in PA5 and in PA6: a page after Gallardo et al. 2019, second hand "
        "(emergentmind.com/topics/advanced-act-camera), half of them in each band"
    ),
    "band edges": (
        STAND_IN
        + "round, about 98, 150 and 220 GHz (Naess et al. 2025, arXiv:2503.14451, abstract)"
    ),
    "NET": STAND_IN + "300 uK_CMB s(1/2), of the order of photon noise in these bands at the site",
    "beams": STAND_IN + "2.1, 1.4 and 1 arcmin, not verified",
    "field of view": STAND_IN + "0.9 deg, one array, not verified",
    "layout": (
        STAND_IN
        + "a hexagonal lattice on one wafer (150 mm: Choi et al. 2018, arXiv:1711.04841, abstract)"
    ),
}


def _act(array: str, *channels: Channel) -> Survey:
    text = f"{array} of the Advanced ACT camera: one wafer of dichroic pixels"
    return Survey(text, "ACT", "0.9 deg", channels, ACT, knee="0.1 Hz", sample_rate="400 Hz")


MID = (
    Channel("f090", 80, 116, 858, "2.1 arcmin", 300.0),
    Channel("f150", 126, 172, 858, "1.4 arcmin", 300.0),
)

SPT = COMMON | {
    "detectors": (
        "10 wafers of 269 pixels, two detectors in each of three bands: Dutcher et al. 2018, SPIE"
        " 10708, abstract"
    ),
    "band edges": (
        "93.5, 146.9 and 220 GHz, 23.3, 30.7 and 46.4 GHz wide: notebook of figures for the"
        " instrument paper (adamanderson/spt_analysis, 20190701_instrument_paper_figures, 16352eb)"
    ),
    "NET": STAND_IN + "round values in K_RJ",
    "beams": STAND_IN + "1.6, 1.2 and 1 arcmin, not verified",
    "field of view": STAND_IN + "1.9 deg, not verified (Sobrin et al. 2022, ApJS 258, 42)",
    "layout": STAND_IN + "ten hexagonal wafers edge to edge",
    "sample rate": STAND_IN + "not verified",
}

TOLTECA = "(toltec-astro/tolteca, 3b24a31)"
TOLTEC = COMMON | {
    "detectors": f"tolteca/common/toltec/__init__.py {TOLTECA}",
    "band edges": (
        "toltec_noise.py (TolTEC-Camera/MappingSpeedModel, 3ba2ebf), within 3 GHz of tolteca's at"
        " half the peak"
    ),
    "NET": (
        "from the largest mapping speeds predicted, 69, 20 and 12 deg2 / mJy2 / h"
        " (toltec.astro.umass.edu/using_toltec.php), as in toltec_noise.py: NEFD^2 = N 3600 /"
        " (N_beams speed), K_RJ in the beam's solid angle"
    ),
    "beams": "9.5, 6.3 and 5 arcsec: toltec.astro.umass.edu/using_toltec.php",
    "field of view": (
        f"4 arcmin: tolteca/common/toltec/__init__.py {TOLTECA}, Bryan et al. 2018,"
        " arXiv:1807.00097"
    ),
    "layout": (
        STAND_IN
        + "a round patch of a hexagonal lattice that fills the field, its pitch within 3 % of that"
        " of the design (2.75, 3.364 and 4.9 mm at 4 arcmin per 127.049 mm, a*_prop.ecsv"
        f" {TOLTECA})"
    ),
    "polarization angles": f"places have 0 and 90 or 45 and 135 deg {TOLTECA}, in turn here",
    "sample rate": f"tolteca/data/examples {TOLTECA}",
}

CALCULATOR = "(ccatobs/Sensitivity-Calculator)"
PRIME_CAM = COMMON | {
    "detectors": f"10 368, 10 368 and 36 450: src/sensitivity_calculator/input.yaml {CALCULATOR}",
    "band edges": (
        "282.5, 348 and 850 GHz, 65, 36 and 96 GHz wide: src/sensitivity_calculator/input.yaml"
        f" {CALCULATOR}"
    ),
    "NET": (
        "a module's 12.7, 47.7 and 305 400.7 uK_CMB s(1/2), weighted over quartiles of weather"
        f" (CcatLatv2b in ccat_noise_200831.py {CALCULATOR}), times the root of its detectors and"
        " of input.yaml's yield of 0.8"
    ),
    "beams": f"47, 37 and 15 arcsec: ccat_noise_200831.py, CcatLatv2b {CALCULATOR}",
    "field of view": (
        "modules 1.78 deg apart (461.3 mm at 13.89 arcsec / mm, marked as not verified:"
        " ccatobs/fyst-trajectories, src/fyst_trajectories/primecam.py), 1.3 deg each"
        " (sim_data_primecam_mpi.py, ccatobs/primecam_sims_planetobs)"
    ),
    "layout": (
        STAND_IN
        + "three wafers of three rhombi of 24 x 24 (850 GHz: 45 x 45) horns in each module, as the"
        " counts suggest, placed as those of the SO LAT, three modules next to each other, that"
        " of 850 GHz as large as the others (1.1 deg: arXiv:2208.10634, abstract)"
    ),
    "sample rate": "488 Hz or 244 Hz: sim_data_primecam_mpi.py (ccatobs/primecam_sims_planetobs)",
    "polarization angles": STAND_IN + "those of the SO LAT",
}

CAMERAS = {
    "so_lat_lf": _so("LAT", "lf", 3, "1.26851 deg", ("7.4 arcmin", 435.1), ("5.1 arcmin", 281.5)),
    "so_lat_mf": _so("LAT", "mf", 12, "4.76908 deg", ("2.2 arcmin", 361.0), ("1.4 arcmin", 352.4)),
    "so_lat_uhf": _so(
        "LAT", "uhf", 6, "3.01724 deg", ("1.0 arcmin", 724.4), ("0.9 arcmin", 1803.9)
    ),
    "so_sat_lf": _so("SAT", "lf", 7, "34.2637 deg", ("91 arcmin", 314.1), ("63 arcmin", 225.8)),
    "so_sat_mf": _so("SAT", "mf", 7, "35.5974 deg", ("30 arcmin", 245.1), ("17 arcmin", 250.2)),
    "so_sat_uhf": _so("SAT", "uhf", 7, "35.5974 deg", ("11 arcmin", 540.3), ("9 arcmin", 1397.5)),
    "act_pa4": _act(
        "PA4",
        Channel("f150", 126, 172, 1_006, "1.4 arcmin", 300.0),
        Channel("f220", 185, 265, 1_006, "1 arcmin", 300.0),
    ),
    "act_pa5": _act("PA5", *MID),
    "act_pa6": _act("PA6", *MID),
    "spt3g_trichroic": Survey(
        "SPT-3G on the 10 m South Pole Telescope: 10 wafers of 269 trichroic pixels",
        "SPT",
        "1.9 deg",
        (
            Channel("f095", 81.85, 105.15, 5_380, "1.6 arcmin", 500.0, False),
            Channel("f150", 131.55, 162.25, 5_380, "1.2 arcmin", 400.0, False),
            Channel("f220", 196.8, 243.2, 5_380, "1 arcmin", 700.0, False),
        ),
        SPT,
        layout="wafers",
        wafers=10,
        sample_rate="152.6 Hz",
    ),
    "toltec_3band": Survey(
        "TolTEC on the 50 m Large Millimeter Telescope: three arrays that look at the same field",
        "LMT",
        "4 arcmin",
        (
            Channel("a2000", 128, 170, 1_172, "9.5 arcsec", 423.7, False),
            Channel("a1400", 195, 245, 2_534, "6.3 arcsec", 800.1, False),
            Channel("a1100", 245, 310, 4_012, "5 arcsec", 1029.6, False),
        ),
        TOLTEC,
        pixels="overlaid",
        knee="0.2 Hz",
        sample_rate="122 Hz",
        efficiencies=(0.4, 0.9),
    ),
    "ccat_primecam": Survey(
        "three modules of Prime-Cam on the 6 m Fred Young Submillimeter Telescope (CCAT)",
        "FYST",
        "3.7453 deg",
        (
            Channel("f280", 250, 315, 10_368, "47 arcsec", 1156.6),
            Channel("f350", 330, 366, 10_368, "37 arcsec", 4344.2),
            Channel("f850", 802, 898, 36_450, "15 arcsec", 5.215e7),
        ),
        PRIME_CAM,
        layout="prime_cam_module",
        pixels="separate",
        knee="0.1 Hz",
        sample_rate="244 Hz",
        efficiencies=(0.6, 0.95),
    ),
    "cmb_s4_lat_lf": _s4(
        "lf",
        "low frequencies: 8 tubes",
        "8.40647 deg",
        Channel("f030", 21.5, 28, 768, "7.8 arcmin", 384.0),
        Channel("f040", 28, 45, 768, "5.3 arcmin", 230.0),
        own={"detectors": f"pixels of a wafer and wafers: {S4SIM}"},
    ),
    "cmb_s4_lat_mf": _s4(
        "mf",
        "middle frequencies: 54 tubes",
        "8.43485 deg",
        Channel("f090", 77, 106, 46_440, "2.1 arcmin", 288.0),
        Channel("f150", 128, 169, 46_440, "1.3 arcmin", 313.0),
    ),
    "cmb_s4_lat_hf": _s4(
        "hf",
        "high frequencies: 19 tubes",
        "3.91625 deg",
        Channel("f220", 198, 256, 17_746, "0.95 arcmin", 670.0),
        Channel("f280", 256, 315, 17_746, "0.83 arcmin", 1615.0),
        own=ROWS
        | {
            "layout": S4["layout"]
            + ", but for two that pins take: the middle and one more there, two of the rim here"
        },
    ),
}
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
        "layout": camera.layout,
        "wafers": camera.wafers,
        "polarization": "pairs",
        "main_beam_efficiency": zeta,
        "illumination_efficiency": epsilon,
        "knee": camera.knee,
        "sample_rate": camera.sample_rate,
        "provenance": camera.provenance,
    }
    return Instrument.model_validate(given)


def __dir__() -> list[str]:
    return sorted(CAMERAS)
