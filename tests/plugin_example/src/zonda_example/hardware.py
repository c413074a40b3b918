"""An instrument and a site."""

from zonda import Band, Instrument, Site, Telescope


def example_camera() -> Instrument:
    """19 detectors at 150 GHz on a 12 m dish."""
    return Instrument(
        name="example_camera",
        description="19 detectors at 150 GHz on a 12 m dish",
        telescope=Telescope(name="Example 12 m", diameter="12 m", elevation_min="20 deg"),
        band=Band(name="example_150", low="140 GHz", high="160 GHz"),
        detectors=19,
        field_of_view="5 arcmin",
        main_beam_efficiency=0.6,
        illumination_efficiency=0.9,
        net="500 uK s(1/2)",
        knee="0.2 Hz",
        sample_rate="50 Hz",
    )


def example_peak() -> Site:
    """A hill near Green Bank, under the same air."""
    return Site(
        name="example_peak",
        latitude="38.5 deg",
        longitude="-79.5 deg",
        altitude="1200 m",
        climatology="green_bank",
    )
