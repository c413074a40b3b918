"""The transfer function of a noiseless run: what the filters leave of each angular scale."""

import numpy as np
import pytest

import zonda
from zonda.core import cli
from zonda.core.numerics.projection import rotation_matrices
from zonda.core.numerics.sphere import ARCSEC
from zonda.operators.diagnostics.transfer_function import compare, window_of

CUT = 0.08  # Hz
HIGHPASS = zonda.HighpassFilter(frequency=f"{CUT} Hz")
NOISE = (
    zonda.AtmosphereLayers(pwv="7.7 mm", layers=3),
    zonda.WhiteNoise(),
    zonda.PinkNoise(shared=0.8),
    zonda.Efficiency(),
)


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """A map of random structure on all scales, 17 arcmin wide."""
    from astropy.io import fits

    n, pixel = 512, 2.0
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(n, pixel), np.fft.fftfreq(n, pixel)))
    white = np.fft.fft2(np.random.default_rng(1).standard_normal((n, n)))
    values = np.fft.ifft2(white * np.where(k > 0, np.maximum(k, 1 / 600) ** -1.5, 0)).real
    image = fits.PrimaryHDU(1e-3 * values / values.std())
    image.header.update(
        CTYPE1="RA---TAN", CTYPE2="DEC--TAN", CRPIX1=256.5, CRPIX2=256.5, CRVAL1=75, CRVAL2=20
    )
    image.header.update(
        CDELT1=-pixel / 3600,
        CDELT2=pixel / 3600,
        CUNIT1="deg",
        CUNIT2="deg",
        BUNIT="K",
        TEMPSCAL="K_RJ",
    )
    path = tmp_path_factory.mktemp("sky") / "field.fits"
    image.writeto(path)
    return path


def steps(field, *filters, noise=(), duration="4.3 min"):
    return [
        zonda.PointingDaisy(
            radius="4 arcmin", speed="50 arcsec/s", scan_duration=duration, sample_rate="50 Hz"
        ),
        zonda.SkyMap(file=field),
        *noise,
        *filters,
        zonda.BinMap(pixel="4 arcsec", width="10 arcmin"),
    ]


def run(chain, **more):
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=1
    )
    return zonda.Pipeline(chain, **more).run(scene)


def transfer(data, scales):
    """(k, T) between these scales [arcsec], under a window of 3.5 arcmin."""
    before, after = data.products["_sky_unfiltered/map"], data.products["map"]
    window = window_of(before, np.radians(3.5 / 60))
    rings = compare(
        before.signal, after.signal, window, before.pixel, 1 / (np.array(scales) * ARCSEC)
    )
    return rings.wavenumber * ARCSEC, rings.transfer


def test_high_pass_and_common_mode(field):
    """A wave of k per arcsec, crossed at an angle phi, is seen at f = k v |cos phi| and is lost
    where f is below the cut.

    Averaged over phi, T(k) = 1 - (2 / pi) asin(cut / (k v)), and over the speeds v of the scan. The
    path bends within a cycle of the filter, so this holds to some percent below 100 arcsec. The
    common mode of 4.2 arcmin takes only what is larger.
    """
    high = run([*steps(field, HIGHPASS), zonda.TransferFunction()])
    both = run([*steps(field, HIGHPASS, zonda.CommonModeFilter(modes=1)), zonda.TransferFunction()])
    observation = high.observations[0]
    forward = rotation_matrices(observation.boresight_radec)[:, :, 2]
    speed = (
        np.degrees(np.linalg.norm(np.diff(forward, axis=0), axis=1))
        * 3600
        * observation.sample_rate
    )

    def expected(k):
        return 1 - 2 / np.pi * np.arcsin(np.minimum(1, CUT / (k * speed))).mean()

    scales = [400, 250, 120, 75, 55, 40, 30, 22]
    (k, of_high), (_, of_both) = transfer(high, scales), transfer(both, scales)
    for number, (found, with_mode) in enumerate(zip(of_high, of_both, strict=True)):
        assert with_mode < found + 0.01
        if number < 2:
            assert with_mode < found < 0.85
        else:
            assert abs(found - expected(k[number])) < 0.05
            assert abs(with_mode - found) < 0.02
    assert of_both[0] < 0.4  # beyond 250 arcsec most is lost
    assert of_both[-1] > 0.95  # at 25 arcsec nearly nothing
    product = high.products["transfer_function"]
    sure = product.rings.error < 0.02
    assert sure.sum() >= 4
    for scale, found in zip(product.scale[sure], product.rings.transfer[sure], strict=True):
        assert abs(found - expected(ARCSEC / scale)) < 0.03


def test_no_filter_leaves_everything(field):
    data = run([*steps(field, duration="2 min"), zonda.TransferFunction()])
    rings = data.products["transfer_function"].rings
    known = np.isfinite(rings.transfer)
    assert known.sum() >= 9
    np.testing.assert_allclose(
        rings.transfer[known], 1, atol=1e-14
    )  # the two spectra are of one map
    assert np.nanmax(rings.error) < 1e-14
    assert "_sky_unfiltered/map" not in data.products, "there is nothing to leave out"


def test_modes_of_the_complete_data(field):
    """Modes of the sky alone follow the sky and take more of it, on the scales of the array; small
    scales are alike.
    """
    filters = HIGHPASS, zonda.CommonModeFilter(modes=1)
    chain = [
        *steps(field, *filters, noise=NOISE, duration="2 min"),
        zonda.TransferFunction(),
        zonda.TransferFunction(modes="full"),
    ]
    data = run(chain)
    assert data.products["TransferFunction.2"].modes == "full"
    sky, full = (
        data.products[name].rings.transfer for name in ("transfer_function", "TransferFunction.2")
    )
    scale = data.products["transfer_function"].scale / ARCSEC
    large, small = (scale > 170) & np.isfinite(sky), (scale > 20) & (scale < 100)
    assert (full[large] > sky[large] + 0.01).all()
    assert abs(full[small] - sky[small]).max() < 0.02
    alone = run([*steps(field, *filters, duration="2 min"), zonda.TransferFunction()])
    np.testing.assert_allclose(
        alone.products["transfer_function"].rings.transfer[small], sky[small], atol=1e-5
    )  # float32


def test_without_filters_nothing_is_lost(field):
    """The unfiltered map is the beam-smoothed input at each pixel, whatever was on other scales."""
    from astropy.io import fits
    from astropy.wcs import WCS
    from scipy.ndimage import gaussian_filter, map_coordinates

    product = run(steps(field)).products["map"]
    with fits.open(field) as file:
        smooth = gaussian_filter(file[0].data.astype(float), 8.5 / 2.3548 / 2.0)
        y, x = np.indices(product.signal.shape)
        world = WCS(product.header).pixel_to_world_values(x, y)
        column, row = WCS(file[0].header).world_to_pixel_values(*world)
    expected = map_coordinates(smooth, [row, column], order=3)
    use = (product.hits > 100) & (product.distance() < np.radians(3 / 60))
    # a pixel's samples are spread over it, not at its centre: 4 arcsec of a field whose gradient is
    # 1e-5 K/arcsec
    assert np.sqrt(np.mean((product.signal - expected)[use] ** 2)) < 0.03 * expected[use].std()
    slope = (product.signal[use] * expected[use]).sum() / (expected[use] ** 2).sum()
    assert abs(slope - 1) < 0.01


FILE = """
seed: 7
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
operators:
  - PointingDaisy: {{scan_duration: 30 s, sample_rate: 50 Hz}}
  - SkyMap: {{file: {file}}}
{air}  - HighpassFilter
  - CommonModeFilter
  - BinMap: {{pixel: 4 arcsec}}
{end}"""
AIR = (
    "  - AtmosphereLayers: {pwv: 7.7 mm, layers: 2}\n  - WhiteNoise\n  - PinkNoise\n  -"
    " Efficiency\n"
)
END = "  - TransferFunction\n"


def written(tmp_path, field, air, end, *options):
    """(steps that ran, tables and other files) of `zonda run`."""
    (tmp_path / "p.yaml").write_text(FILE.format(file=field, air=air, end=end))
    out = tmp_path / "out"
    assert cli.main(["run", str(tmp_path / "p.yaml"), "--output", str(out), *options]) == 0
    ran = [step.key for step in zonda.load(out / "resolved.yaml").steps]
    return ran, {p.name: p.read_bytes() for p in out.iterdir()}


def rows(table):
    return [line for line in table.decode().splitlines() if not line.startswith("#")]


def test_a_transfer_function_alone_draws_nothing(field, tmp_path):
    """A complete file whose only output is the transfer function of the sky runs as the sky alone;
    so does --only sky.
    """
    folders = [tmp_path / n for n in "abc"]
    for folder in folders:
        folder.mkdir()
    asked, files = written(folders[0], field, AIR, END)
    alone, same = written(folders[1], field, "", END)
    only, again = written(folders[2], field, AIR, END, "--only", "sky")
    assert asked == [*alone[:2], "Efficiency", *alone[2:]]
    assert [
        label for label in only if label in asked
    ] == asked  # it keeps what steps prepare: levels, load, flags
    assert "WhiteNoise" not in asked
    assert (
        rows(files["transfer_function.ecsv"])
        == rows(same["transfer_function.ecsv"])
        == rows(again["transfer_function.ecsv"])
    )


def test_modes_of_the_complete_data_keep_what_determines_them(field, tmp_path, capsys):
    end = "  - TransferFunction: {modes: full}\n"
    ran, files = written(tmp_path, field, AIR, end)
    assert {"AtmosphereLayers", "WhiteNoise", "PinkNoise"} <= set(ran)
    assert "map.fits" not in files
    assert (
        cli.main(
            ["run", str(tmp_path / "p.yaml"), "--only", "sky", "--output", str(tmp_path / "x")]
        )
        == 2
    )
    assert "singular modes of the complete data" in capsys.readouterr().err


def test_only_the_sky_of_a_complete_file_is_its_noiseless_run(field, tmp_path):
    """The same bits as the companion run of the whole."""
    from astropy.io import fits

    end = "  - SaveMap\n"
    (tmp_path / "p.yaml").write_text(
        FILE.format(file=field, air=AIR, end=end) + "runs: {noiseless: {only: [sky]}}\n"
    )
    for options in ((), ("--only", "sky")):
        folder = tmp_path / str(len(options))
        assert cli.main(["run", str(tmp_path / "p.yaml"), "--output", str(folder), *options]) == 0
    assert not (tmp_path / "2" / "noiseless_map.fits").exists()
    with (
        fits.open(tmp_path / "0" / "noiseless_map.fits") as a,
        fits.open(tmp_path / "2" / "map.fits") as b,
    ):
        assert np.array_equal(a[0].data, b[0].data, equal_nan=True)
    assert (
        cli.main(
            ["run", str(tmp_path / "p.yaml"), "--only", "skye", "--output", str(tmp_path / "x")]
        )
        == 2
    )
    assert (
        cli.main(
            [
                "run",
                str(tmp_path / "p.yaml"),
                "--only",
                "sky",
                "--verify",
                "--output",
                str(tmp_path / "x"),
            ]
        )
        == 2
    )
