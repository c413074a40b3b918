"""Built-in instruments: each name in `names()` is an attribute of this module, for an entry point.

A camera of several bands is one instrument per band, ``act_98ghz`` and ``act_150ghz``; ``act`` is
its first.
"""

from __future__ import annotations

from typing import NamedTuple

from zonda.core.instrument import Instrument, Telescope

PAPER = "van Marrewijk, Morris et al. 2024, Table 1"
ROUND = (
    "stand-in: every number is round, after public descriptions of the instrument; efficiencies,"
    " NET and knee are assumed"
)
NO_PINK = "it gives no pink-noise level: knee and slope are our choice"

# Limits of the axes. AtLAST: "3 deg/s scanning and 1 deg/s2 acceleration" (Mroczkowski et al. 2025,
# A&A 694, A142), taken on the sky, as the paper's own scans need them. GBT: 36 deg/min in azimuth
# (17 in the cold; Minter, GBT keyhole memo). APEX: an ALMA antenna, 6 and 3 deg/s (Saito et al.
# 2011 for the ACA's). FYST: limits of its control system, 3 deg/s and 6 deg/s2 in azimuth, 1.5
# deg/s in elevation (ccatobs/fyst-trajectories, src/fyst_trajectories/site.py); the same for the SO
# LAT, which is one design (Parshley et al. 2018). Round values after public descriptions: GBT's
# elevation and accelerations, LMT, ACT, SPT, SO SAT, CMB-S4's (3 deg/s2 of its reference scans).
# None is known to us where none stands.
TELESCOPES = {
    "GBT": Telescope(
        name="GBT",
        diameter="100 m",
        site="green_bank",
        elevation_min="5 deg",
        elevation_max="88 deg",
        azimuth_speed_max="0.6 deg/s",
        azimuth_acceleration_max="0.05 deg/s2",
        elevation_speed_max="0.3 deg/s",
        elevation_acceleration_max="0.05 deg/s2",
    ),
    "AtLAST": Telescope(
        name="AtLAST",
        diameter="50 m",
        site="llano_de_chajnantor",
        speed_max="3 deg/s",
        acceleration_max="1 deg/s2",
    ),
    "LMT": Telescope(
        name="LMT",
        diameter="50 m",
        site="sierra_negra",
        azimuth_speed_max="1 deg/s",
        elevation_speed_max="1 deg/s",
    ),
    "ACT": Telescope(name="ACT", diameter="6 m", site="cerro_toco", azimuth_speed_max="2 deg/s"),
    "SO LAT": Telescope(
        name="SO LAT",
        diameter="6 m",
        site="cerro_toco",
        azimuth_speed_max="3 deg/s",
        azimuth_acceleration_max="6 deg/s2",
        elevation_speed_max="1.5 deg/s",
    ),
    "SO SAT": Telescope(
        name="SO SAT",
        diameter="0.42 m",
        site="cerro_toco",
        azimuth_speed_max="3 deg/s",
        azimuth_acceleration_max="3 deg/s2",
        elevation_speed_max="1 deg/s",
    ),
    "SPT": Telescope(
        name="SPT",
        diameter="10 m",
        site="amundsen_scott",
        azimuth_speed_max="4 deg/s",
        azimuth_acceleration_max="4 deg/s2",
        elevation_speed_max="2 deg/s",
    ),
    "FYST": Telescope(
        name="FYST",
        diameter="6 m",
        site="cerro_chajnantor",
        azimuth_speed_max="3 deg/s",
        azimuth_acceleration_max="6 deg/s2",
        elevation_speed_max="1.5 deg/s",
    ),
    "CMB-S4 LAT": Telescope(
        name="CMB-S4 LAT",
        diameter="6 m",
        site="cerro_toco",
        azimuth_speed_max="3 deg/s",
        azimuth_acceleration_max="3 deg/s2",
    ),
    "APEX": Telescope(
        name="APEX",
        diameter="12 m",
        site="llano_de_chajnantor",
        azimuth_speed_max="6 deg/s",
        elevation_speed_max="3 deg/s",
    ),
    "generic 6 m": Telescope(name="generic 6 m", diameter="6 m"),
}


class Channel(NamedTuple):
    """One band of a camera; without ``fwhm`` the beam is the diffraction limit 1.22 lambda / D."""

    band: str
    detectors: int
    net: str
    fwhm: str | None = None


class Camera(NamedTuple):
    """What its channels share."""

    description: str
    telescope: str
    field_of_view: str
    main_beam_efficiency: float
    illumination_efficiency: float
    knee: str
    sample_rate: str
    channels: tuple[Channel, ...]
    provenance: str


CAMERAS = {
    "mustang2": Camera(
        # 223 detectors fill 4.2 arcmin, which makes the pitch about 16 arcsec; 1.9 f-lambda as
        # quoted (12.6 arcsec) would span only 3.3 arcmin. Count and field are kept, the pitch
        # follows. The observatory's page says 223 feedhorns, 4.2 arcmin, 75 to 105 GHz and 9 arcsec
        # (greenbankobservatory.org, MUSTANG-2).
        "MUSTANG-2 on the 100 m Green Bank Telescope",
        *("GBT", "4.2 arcmin", 0.3, 0.8, "0.5 Hz", "100 Hz"),
        (Channel("mustang2_90ghz", 223, "1.7 mK s(1/2)", "8.5 arcsec"),),
        f"{PAPER}; {NO_PINK}",
    ),
    "atlast": Camera(
        "the paper's reduced camera on the 50 m AtLAST",
        *("AtLAST", "0.25 deg", 0.3, 0.8, "0.5 Hz", "225 Hz"),
        (Channel("atlast_92ghz", 3000, "0.266 mK s(1/2)", "16 arcsec"),),
        f"{PAPER}; {NO_PINK}",
    ),
    "atlast_full": Camera(
        "the full camera on the 50 m AtLAST",
        *("AtLAST", "2 deg", 0.3, 0.8, "0.5 Hz", "900 Hz"),
        (Channel("atlast_92ghz", 200_000, "0.266 mK s(1/2)", "16 arcsec"),),
        f"{PAPER} (full design); {NO_PINK}",
    ),
    "lmt": Camera(
        "a camera like TolTEC on the 50 m Large Millimeter Telescope",
        *("LMT", "4 arcmin", 0.4, 0.9, "0.2 Hz", "122 Hz"),
        (
            Channel("toltec_150ghz", 1172, "0.3 mK s(1/2)", "9.5 arcsec"),
            Channel("toltec_220ghz", 2534, "0.4 mK s(1/2)", "6.3 arcsec"),
            Channel("toltec_280ghz", 4012, "0.5 mK s(1/2)", "5 arcsec"),
        ),
        ROUND,
    ),
    "act": Camera(
        "an Advanced ACT array on the 6 m Atacama Cosmology Telescope",
        *("ACT", "0.9 deg", 0.7, 0.95, "0.1 Hz", "400 Hz"),
        (
            Channel("act_150ghz", 860, "0.2 mK s(1/2)", "1.4 arcmin"),
            Channel("act_98ghz", 860, "0.2 mK s(1/2)", "2.1 arcmin"),
            Channel("act_220ghz", 1000, "0.2 mK s(1/2)", "1 arcmin"),
        ),
        ROUND,
    ),
    "so_lat": Camera(
        "the Simons Observatory's 6 m Large Aperture Telescope",
        *("SO LAT", "7.8 deg", 0.7, 0.95, "0.1 Hz", "200 Hz"),
        (
            Channel("so_145ghz", 10_320, "0.2 mK s(1/2)", "1.4 arcmin"),
            Channel("so_93ghz", 10_320, "0.2 mK s(1/2)", "2.2 arcmin"),
            Channel("so_225ghz", 5_160, "0.2 mK s(1/2)", "1 arcmin"),
            Channel("so_280ghz", 5_160, "0.2 mK s(1/2)", "0.9 arcmin"),
        ),
        ROUND,
    ),
    "so_sat": Camera(
        "a Simons Observatory Small Aperture Telescope, 0.42 m",
        *("SO SAT", "35 deg", 0.7, 0.95, "0.1 Hz", "200 Hz"),
        (
            Channel("so_145ghz", 6_000, "0.2 mK s(1/2)", "17 arcmin"),
            Channel("so_93ghz", 6_000, "0.2 mK s(1/2)", "30 arcmin"),
            Channel("so_225ghz", 6_000, "0.2 mK s(1/2)", "11 arcmin"),
            Channel("so_280ghz", 6_000, "0.2 mK s(1/2)", "9 arcmin"),
        ),
        f"aperture: van Marrewijk, Morris et al. 2024; {ROUND}",
    ),
    "spt": Camera(
        "SPT-3G on the 10 m South Pole Telescope",
        *("SPT", "1.9 deg", 0.7, 0.95, "0.05 Hz", "152.6 Hz"),
        (
            Channel("spt3g_150ghz", 5_380, "0.4 mK s(1/2)", "1.2 arcmin"),
            Channel("spt3g_95ghz", 5_380, "0.5 mK s(1/2)", "1.6 arcmin"),
            Channel("spt3g_220ghz", 5_380, "0.7 mK s(1/2)", "1 arcmin"),
        ),
        ROUND,
    ),
    "ccat": Camera(
        "a Prime-Cam module on the 6 m Fred Young Submillimeter Telescope (CCAT)",
        *("FYST", "1.3 deg", 0.6, 0.95, "0.1 Hz", "200 Hz"),
        (
            Channel("ccat_280ghz", 10_368, "0.2 mK s(1/2)"),
            Channel("ccat_350ghz", 10_368, "0.4 mK s(1/2)"),
        ),
        ROUND,
    ),
    "cmb_s4": Camera(
        "a camera like CMB-S4's on a 6 m telescope",
        *("CMB-S4 LAT", "7.8 deg", 0.7, 0.95, "0.1 Hz", "200 Hz"),
        (
            Channel("cmb_s4_150ghz", 52_000, "0.2 mK s(1/2)", "1.4 arcmin"),
            Channel("cmb_s4_95ghz", 52_000, "0.2 mK s(1/2)", "2.2 arcmin"),
        ),
        ROUND,
    ),
    "apex": Camera(
        "a camera like LABOCA on the 12 m Atacama Pathfinder Experiment",
        *("APEX", "11.4 arcmin", 0.6, 0.9, "0.1 Hz", "25 Hz"),
        (Channel("laboca_345ghz", 295, "2 mK s(1/2)", "19 arcsec"),),
        "detectors: 295 bolometers, Siringo et al. 2009, A&A 497, 945, abstract; layout: a"
        " hexagonal lattice, 37 arcsec between neighbours, 38 to 40 in maps of the beams"
        " (crush/config/laboca/*.rcp, attipaci/crush, 982ba3f), its outline round here; stand-in:"
        " field of view, beam (19.2 arcsec), band of 60 GHz about 345 GHz: Siringo et al. 2009, not"
        " verified; stand-in: NET: about 75 mJy s(1/2) in this beam, not verified; stand-in:"
        " efficiencies, knee and sample rate: assumed",
    ),
    "hexagonal_array": Camera(
        "a generic hexagonal array on a 6 m telescope",
        *("generic 6 m", "0.5 deg", 0.7, 0.95, "0.1 Hz", "200 Hz"),
        (Channel("flat_150ghz", 61, "400 uK s(1/2)"),),
        "round numbers, for tests and as a pattern to copy",
    ),
}
"""By name; efficiencies are the main beam's and the illumination's."""

ALIASES = {"gbt": "mustang2", "fyst": "ccat", "toltec": "lmt", "spt3g": "spt", "laboca": "apex"}
"""Other names people use."""


def names() -> dict[str, tuple[str, int]]:
    """(camera, channel) of every name: each camera's, its aliases', and where it has several bands
    one for each.
    """
    found = {}
    for camera, entry in CAMERAS.items():
        for name in (camera, *(alias for alias, of in ALIASES.items() if of == camera)):
            found[name] = (camera, 0)
        if len(entry.channels) > 1:
            for k, channel in enumerate(entry.channels):
                found[f"{camera}_{channel.band.rpartition('_')[2]}"] = (camera, k)
    return found


def __getattr__(name: str) -> Instrument:
    try:
        key, k = names()[name]
    except KeyError:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
    camera = CAMERAS[key]
    channel = camera.channels[k]
    return Instrument(
        name=name if name not in ALIASES else key,
        description=(
            f"{camera.description}: {channel.detectors} detectors,"
            f" {channel.band.rpartition('_')[2]}"
        ),
        telescope=TELESCOPES[camera.telescope],
        band=channel.band,
        detectors=channel.detectors,
        field_of_view=camera.field_of_view,
        fwhm=channel.fwhm,
        main_beam_efficiency=camera.main_beam_efficiency,
        illumination_efficiency=camera.illumination_efficiency,
        net=channel.net,
        knee=camera.knee,
        slope=1.0,
        sample_rate=camera.sample_rate,
        provenance=camera.provenance,
    )


def __dir__() -> list[str]:
    return sorted(names())
