"""`AtmosphereScreens` shows the turbulence that the detectors saw."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import zonda
import zonda.testing
from zonda.core.assembly.checks import run_checks
from zonda.core.canvas import Drawable
from zonda.core.errors import PipelineError
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.atmosphere.model import ExpectedLoad
from zonda.operators.atmosphere.screens import AtmosphereScreens, pwv_at, screens
from zonda.operators.diagnostics.plot_operators import Plots
from zonda.plugins.checks import scenes


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A field of 12 arcmin, 15 s."""
    folder = tmp_path_factory.mktemp("screens")
    observation = scenes.scan(instrument=scenes.camera(19, field="12 arcmin"), samples=1500)
    steps = [
        AtmosphereLayers(pwv="5 mm", layers=3, outputs=["pwv"]),
        AtmosphereScreens(moments=3, pixels=12),
        Plots(),
    ]
    return scenes.run(steps, observation, keep=("pwv",), output=folder), folder


def test_contract():
    zonda.testing.check_operator(AtmosphereScreens())


def test_it_is_what_the_detectors_saw(run):
    """The PWV along each detector's line of sight is its stream's within the errors that are
    allowed for nodes and step.
    """
    data, _ = run
    (o,) = data.observations
    assert isinstance(o.expected_load, ExpectedLoad)
    model = o.expected_load.model()
    step = model.resolution().step
    samples = np.arange(5, 1400, 200) // step * step
    direct = pwv_at(model, o.focalplane.xi, o.focalplane.eta, samples)
    stream = o.detdata["pwv"][:, samples]
    rms = model.fluctuation.before_and_after()[1] * model.pwv
    error = np.sqrt(np.mean((direct - stream) ** 2))
    assert error < 3 * model.resolution().tolerance * rms + 1e-9
    assert error < 0.2 * stream.std()  # it tells detectors and times apart


def test_the_field_has_the_streams_value_in_the_middle(run):
    data, _ = run
    found = data.products["screens"]
    (o,) = data.observations
    centre = int(np.hypot(o.focalplane.xi, o.focalplane.eta).argmin())
    seconds = np.asarray(o.seconds)
    for second, pwv in zip(found.seconds, found.pwv, strict=True):
        sample = int(np.abs(seconds - seconds[0] - second).argmin())
        middle = pwv[5:7, 5:7].mean()  # four points about the middle, half a point away from it
        slope = np.nanmax(np.abs(np.diff(pwv, axis=1)))
        assert middle == pytest.approx(o.detdata["pwv"][centre, sample], abs=slope)
    assert np.isnan(found.pwv[:, 0, 0]).all()


def test_layers_have_their_variance_and_wind(run):
    data, _ = run
    found, model = data.products["screens"], data.observations[0].expected_load.model()
    assert [layer.height for layer in found.layers] == [layer.height for layer in model.layers]
    for screen, layer in zip(found.layers, model.layers, strict=True):
        assert screen.wind == tuple(layer.wind)
        assert screen.values.shape[0] == screen.values.shape[1]
        ensemble = model.pwv * model.fluctuation.scale * layer.amplitude
        assert 0 < np.abs(screen.values).max() < 5 * ensemble  # g has unit variance before the beam
        moment = np.abs(screen.track).sum(axis=1).min()
        assert moment < 2 * screen.spacing  # the track passes through the middle


def test_the_boresight_sees_the_sum_of_the_layers(run):
    """What the layers' pictures show where the boresight is adds up to the stream there, but for
    the airmass.

    Between lattice points, 0.8 of a beam apart, the pictures are interpolated by cubic splines: 0.2
    % from what the streams' interpolation gives. The airmass of a curved atmosphere is smaller than
    1 / sin(elevation) by less than 0.1 % at 60 deg.
    """
    from scipy.ndimage import map_coordinates

    (o,) = run[0].observations
    model = o.expected_load.model()
    step = model.resolution().step
    sample = o.n_samples // 2 // step * step
    seconds = np.asarray(o.seconds) - o.seconds[0]
    found = screens(model, float(seconds[sample]), 1, 4)
    assert found.moment == seconds[sample]
    total = 0.0
    for screen in found.layers:
        across, along = screen.track[np.abs(screen.track).sum(axis=1).argmin()]
        at = [[screen.values.shape[0] // 2 + place / screen.spacing] for place in (along, across)]
        total += map_coordinates(screen.values, at, order=3)[0]
    direct = pwv_at(model, np.zeros(1), np.zeros(1), np.array([sample]))[0, 0]
    assert not model.fluctuation.log_normal
    assert total / np.sin(o.elevation[sample]) == pytest.approx(direct, rel=0.01)


def test_files_and_pictures(run):
    data, folder = run
    found = data.products["screens"]
    assert isinstance(found, Drawable)
    with fits.open(folder / "screens.fits") as hdus:
        np.testing.assert_array_equal(hdus[0].data, found.pwv)
        assert [hdu.name for hdu in hdus] == ["PWV", "LAYER0", "LAYER1", "LAYER2"]
        assert hdus[0].header["TIME2"] == found.seconds[1]
    table = Table.read(folder / "screens.ecsv")
    np.testing.assert_allclose(table["height"], [layer.height for layer in found.layers])
    assert (folder / "screens_layers.png").is_file()
    assert (folder / "screens_field.png").is_file()


def test_a_scan_that_is_not_there_is_told_before_any_is_simulated(tmp_path):
    daisy = zonda.PointingDaisy(scan_duration="2 s", scans=20)
    simulated = []

    @zonda.operator(linear=True)
    def count(block):
        simulated.append(block)

    def pipeline(observation):
        more = [
            zonda.WhiteNoise(),
            zonda.Efficiency(),
            count,
            AtmosphereScreens(observation=observation),
        ]
        return zonda.Pipeline([daisy, zonda.AtmosphereLayers(), *more])

    run_checks(pipeline(19), scenes.scene(), saved=False)  # looks at some of the scans alone
    text = (
        "AtmosphereScreens: there is no observation 20: the pipeline makes 20(.|\n)*choose 0 to 19"
    )
    with pytest.raises(PipelineError, match=text):
        run_checks(pipeline(20), scenes.scene(), saved=False)
    with pytest.raises(PipelineError, match=text):
        pipeline(20).run(scenes.scene(), output=tmp_path, threads=1)
    assert not simulated


def test_refusals():
    data = zonda.Data(scenes.scene())
    with pytest.raises(PipelineError, match="there is no observation 0: the pipeline makes 0"):
        AtmosphereScreens().finalize(data)
    data.observations.append(scenes.scan(samples=100))
    with pytest.raises(PipelineError, match="no atmosphere to show"):
        AtmosphereScreens().finalize(data)


def test_the_field_of_one_detector_is_its_beam():
    instrument = scenes.camera(1)
    steps = [
        zonda.PointingDaisy(scan_duration="2 s"),
        zonda.AtmosphereLayers(pwv="5 mm"),
        AtmosphereScreens(moments=2, pixels=8),
    ]
    found = zonda.Pipeline(steps).run(scenes.scene(instrument), threads=1)["screens"]
    assert found.side == instrument.beam_fwhm
    assert np.isfinite(found.pwv[:, 3:5, 3:5]).all()


def test_the_log_of_a_campaign_says_that_there_is_no_scan(tmp_path):
    steps = [
        zonda.PointingDaisy(scan_duration="2 s"),
        zonda.AtmosphereLayers(pwv="5 mm"),
        zonda.Efficiency(),
        zonda.BinMap(pixel="4 arcsec", width="2 arcmin"),
        AtmosphereScreens(),
        zonda.SaveMap(),
    ]
    scene = zonda.Scene(
        site="green_bank",
        instrument={"like": "mustang2", "detectors": 7},
        time="2024-11-25T07:00",
        target="05h +20d",
    )
    made = zonda.campaign(
        zonda.Pipeline(steps), scene, output=tmp_path / "out", realizations=2, engine="serial"
    )
    assert ("AtmosphereScreens", "not drawn") in {row[1:3] for row in made.log}
    assert (tmp_path / "out" / "map.fits").is_file()
