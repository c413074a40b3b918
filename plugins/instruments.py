"""Built-in instruments."""

from __future__ import annotations

from zonda.core.instrument import Instrument, Telescope


def green_bank_telescope() -> Telescope:
    """The 100 m Robert C. Byrd Green Bank Telescope."""
    return Telescope(
        name="GBT",
        diameter="100 m",
        elevation_min="5 deg",
        elevation_max="88 deg",
    )


def mustang2() -> Instrument:
    """MUSTANG-2 on the 100 m Green Bank Telescope.

    223 detectors fill 4.2 arcmin, which makes the pitch about 16 arcsec; 1.9 f-lambda as quoted (12.6 arcsec) would span
    only 3.3 arcmin. Count and field are kept, the pitch follows.
    """
    return Instrument(
        name="mustang2",
        description="MUSTANG-2, 223 detectors at 78-108 GHz on the 100 m Green Bank Telescope",
        telescope=green_bank_telescope(),
        band="mustang2_90ghz",
        detectors=223,
        field_of_view="4.2 arcmin",
        fwhm="8.5 arcsec",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1.7 mK s(1/2)",
        knee="0.5 Hz",
        slope=1.0,
        pink_minimum_frequency="1 mHz",
        sample_rate="100 Hz",
        provenance="van Marrewijk, Morris et al. 2024, Table 1; it gives no pink-noise level: knee and slope are our choice",
    )


def hexagonal_array() -> Instrument:
    """A generic camera: 61 hexagonally packed, diffraction-limited detectors at 150 GHz on a 6 m telescope."""
    return Instrument(
        name="hexagonal_array",
        description="generic 61-detector hexagonal array at 150 GHz on a 6 m telescope",
        telescope=Telescope(name="generic 6 m", diameter="6 m"),
        band="flat_150ghz",
        detectors=61,
        field_of_view="0.5 deg",
        main_beam_efficiency=0.7,
        illumination_efficiency=0.95,
        net="400 uK s(1/2)",
        knee="0.1 Hz",
        sample_rate="200 Hz",
        provenance="round numbers, for tests and as a pattern to copy",
    )
