"""Pictures, figures and the report of a polarized map show I, Q, U and P."""

import numpy as np

import zonda
from zonda.core.maps.noise_figures import maps_of


def test_pictures_and_report(tmp_path):
    camera = zonda.Instrument(
        name="pairs",
        telescope=zonda.Telescope(name="dish", diameter="6 m"),
        detectors=24,
        field_of_view="6 arcmin",
        band=zonda.Band(name="b", low="130 GHz", high="170 GHz"),
        fwhm="1.4 arcmin",
        polarization="pairs",
        net="1 mK s(1/2)",
        main_beam_efficiency=0.7,
        illumination_efficiency=0.9,
        sample_rate="20 Hz",
    )
    scene = zonda.Scene(
        site="green_bank", instrument=camera, time="2024-11-25T07:00", target="05h +20d", seed=3
    )
    steps = [
        zonda.PointingDaisy(radius="5 arcmin", speed="60 arcsec/s", scan_duration="20 s", scans=2),
        zonda.HalfWavePlate(frequency="1 Hz"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(pixel="60 arcsec", stokes="IQU", crosslinking=True),
        zonda.Plots(),
        zonda.Report(),
    ]
    data = zonda.Pipeline(steps).run(scene, output=tmp_path)
    made = {path.name for path in tmp_path.glob("*.png")}
    assert {
        "map.png",
        "map_Q.png",
        "map_U.png",
        "map_P.png",
        "noise_map_Q.png",
        "coverage.png",
        "crosslinking.png",
    } <= made
    assert not any(
        name.startswith(("coverage_", "crosslinking_")) for name in made
    )  # Q and U have the hits of I
    assert list(maps_of(data.products)) == ["map", "map_Q", "map_U"]
    assert list(maps_of(data.products, split=False)) == ["map"]
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "map_Q" in text
    assert "do not determine I, Q and U" in text
    assert "too few angles of polarization for I, Q and U" in text
    ax = data.products["map"].plot(plane="U")
    assert np.isfinite(ax.images[0].get_array().compressed()).all()
