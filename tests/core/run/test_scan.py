"""Bands in step: `CommonModeFilter` with `group: all` finds the modes of the detectors of all bands
together.
"""

from typing import Any, ClassVar

import numpy as np
import pytest

import zonda
from zonda.core.flags import DEAD, OPAQUE

BANDS = (
    {"name": "f090", "low": "77 GHz", "high": "106 GHz", "net": "300 uK s(1/2)"},
    {"name": "f150", "low": "130 GHz", "high": "170 GHz", "net": "360 uK s(1/2)"},
)
PLANES = ("signal", "hits", "weights")


def scene(count: int = 2, **changes: Any) -> zonda.Scene:
    settings = {
        "name": "camera",
        "telescope": {"name": "dish", "diameter": "6 m"},
        "detectors": 19,
        "field_of_view": "20 arcmin",
        "main_beam_efficiency": 0.8,
        "illumination_efficiency": 0.9,
        "sample_rate": "50 Hz",
        **(
            {"bands": [dict(b) for b in BANDS]}
            if count > 1
            else {"band": {k: BANDS[0][k] for k in ("name", "low", "high")}, "net": BANDS[0]["net"]}
        ),
    } | changes
    return zonda.Scene(
        site="llano_de_chajnantor",
        instrument=zonda.Instrument(**settings),
        time="2022-08-01T23:00",
        target="260d -10d",
        seed=3,
    )


class Poison(zonda.Operator):
    """NaN in a detector of the second band alone."""

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})

    def exec(self, block: zonda.Block, state: Any) -> None:
        if block.observation.instrument.band.name == "f150":
            row = 3 - block.detectors.start
            if 0 <= row < block.shape[0]:
                block.detdata["signal"][row] = np.nan


class Opaque(zonda.Operator):
    """Flags samples of the second band alone, as `Efficiency` does where the atmosphere is opaque
    in it.
    """

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})

    def prepare(self, observation: zonda.Observation) -> None:
        if observation.instrument.band.name == "f150":
            observation.flags[500:600] |= OPAQUE

    def exec(self, block: zonda.Block, state: Any) -> None:
        pass


def pipeline(
    *filters: zonda.Operator, scans: int = 1, precision: Any = "float32"
) -> zonda.Pipeline:
    values = np.zeros((64, 64))
    values[30, 34] = 1e-4
    steps = [
        zonda.PointingDaisy(
            radius="15 arcmin", speed="10 arcmin/s", scan_duration="30 s", scans=scans
        ),
        zonda.SkyMap(map=values, unit="K_CMB", pixel_size="30 arcsec", centre="target"),
        zonda.AtmosphereLayers(pwv="1 mm", pwv_rms="2 %"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="0.2 Hz"),
        *filters,
        zonda.BinMap(pixel="1 arcmin", crosslinking=True),
    ]
    return zonda.Pipeline(
        steps, runs={"noiseless": {"only": ["sky"], "modes": "full"}}, precision=precision
    )


def streams(data: Any, name: str = "signal") -> list[Any]:
    """By band, (n_det, n_samp) of the first scan."""
    return [o.detdata[name] for o in data.observations[:2]]


@pytest.fixture(scope="module")
def before() -> Any:
    return pipeline(precision="float64").run(scene(), keep=["signal", "signal/noiseless"])


@pytest.mark.parametrize("method", ["svd", "mean"])
def test_the_mode_is_that_of_all_detectors(before: Any, method: str) -> None:
    """Equation (1) on the streams of both bands, one above the other, by numpy; equation (3) on the
    signal of the sky alone.

    The iteration ends at a residual of 1e-9 sigma^2, so that u errs by less than 1e-9 sigma_1^2 /
    (sigma_1^2 - sigma_2^2), here below 1e-8, and the streams by this share of the mode, 0.1 K: 1e-9
    K.
    """
    step = zonda.CommonModeFilter(
        group="all", method=method, **({"residual": 1e-9} if method == "svd" else {})
    )
    found = pipeline(step, precision="float64").run(scene(), keep=["signal", "signal/noiseless"])
    good = before.observations[0].good_samples
    whole = np.concatenate(streams(before))
    if method == "svd":
        u = np.linalg.svd(whole[:, good], full_matrices=False)[0][:, 0]
    else:
        u = np.ones(len(whole)) / np.sqrt(len(whole))
    for name in ("signal", "signal/noiseless"):
        a = np.concatenate(streams(before, name))
        expected = a - np.outer(u, u @ a)
        here = np.concatenate(streams(found, name))
        assert np.abs(np.outer(u, u @ a)).max() > 1e-7  # there is something to remove
        np.testing.assert_allclose(here[:, good], expected[:, good], atol=1e-9)
    assert any("all bands: modes removed" in key[1] for key in found.log)


def test_bits_depend_neither_on_threads_nor_on_memory() -> None:
    """Streams of 4 MB are kept, or spilled and made again."""
    run, fast = (
        pipeline(zonda.CommonModeFilter(group="all"), scans=2).run,
        scene(detectors=169, sample_rate="200 Hz"),
    )
    first, tight = run(fast, threads=1), run(fast, threads=1, memory=24_000_000)
    assert any("spilled" in key[1] or "made again" in key[1] for key in tight.log)
    assert not any("spilled" in key[1] or "made again" in key[1] for key in first.log)
    for other in (run(fast, threads=2), tight):
        for name in ("map_f090", "map_f150", "noiseless/map_f150"):
            for plane in PLANES:
                np.testing.assert_array_equal(
                    getattr(first[name], plane), getattr(other[name], plane)
                )
    by_band = pipeline(zonda.CommonModeFilter(), scans=2).run(fast, threads=1)
    assert not np.array_equal(first["map_f150"].signal, by_band["map_f150"].signal, equal_nan=True)


def test_a_dead_detector_of_one_band_is_flagged_there() -> None:
    data = pipeline(Poison(), zonda.CommonModeFilter(group="all")).run(scene())
    one, other = data.observations
    assert not (one.detector_flags & DEAD).any()
    np.testing.assert_array_equal(np.flatnonzero(other.detector_flags & DEAD), [3])
    assert np.isfinite(data["map_f150"].signal[data["map_f150"].hits > 0]).all()


def test_samples_that_one_band_flags_are_no_data_of_the_other_which_would_keep_its_common_mode() -> (
    None
):
    unfiltered = pipeline(Opaque()).run(scene(), keep=["signal"]).observations[0].detdata["signal"]
    data = pipeline(Opaque(), zonda.CommonModeFilter(group="all")).run(scene(), keep=["signal"])
    one, other = data.observations
    np.testing.assert_array_equal(one.good_samples, other.good_samples)
    assert not one.good_samples[500:600].any()
    changed = (one.detdata["signal"] != unfiltered).any(axis=0)
    assert changed[one.good_samples].all()
    assert not changed[500:600].any()  # the mode is still there
    told = {who: number for who, what, number in data.log.counts() if "another band" in what}
    assert told == {"CommonModeFilter f090": 100, "CommonModeFilter f150": 0}


def test_a_camera_of_one_band_is_that_band() -> None:
    found = [
        pipeline(zonda.CommonModeFilter(group=group)).run(scene(1))["map"].signal
        for group in ("all", "band")
    ]
    np.testing.assert_array_equal(*found)


class Watched(zonda.Operator):
    """Notes what it is given: (band, first detector, first sample)."""

    provides = frozenset({"watched"})
    seen: ClassVar[list[tuple[str, int, int]]] = []
    discarded: ClassVar[list[str]] = []
    fail: str = ""

    def exec(self, block: zonda.Block, state: Any) -> None:
        name = block.observation.instrument.band.name
        self.seen.append((name, block.detectors.start, block.samples.start))
        if name == self.fail and (block.samples.start or block.detectors.start):
            raise ValueError("on purpose")
        block.new("watched")

    def discard(self, observation: zonda.Observation, state: Any) -> None:
        self.discarded.append(observation.instrument.band.name)


def watched(
    scene: zonda.Scene, fail: str = "", filters: Any = (), nside: int = 512, **options: Any
) -> list[str]:
    """Names of the bands in the order in which they worked on blocks."""
    Watched.seen.clear()
    Watched.discarded.clear()
    pointing = zonda.PointingDaisy(radius="15 arcmin", speed="10 arcmin/s", scan_duration="100 s")
    grid = {"nside": nside} if nside else {"pixel": "1 arcmin"}
    steps = [
        pointing,
        zonda.WhiteNoise(),
        Watched(fail=fail),
        zonda.Efficiency(),
        *filters,
        zonda.BinMap(**grid),
    ]
    zonda.Pipeline(steps).run(scene, threads=1, keep=["watched"], **options)
    return [name for name, *_ in Watched.seen]


def test_bands_that_share_pixels_take_turns_block_by_block() -> None:
    names = watched(scene(), memory=16_000_000)
    assert len(names) > 2
    assert names[:4] == ["f090", "f150", "f090", "f150"]
    assert [part[1:] for part in Watched.seen[::2]] == [part[1:] for part in Watched.seen[1::2]]


def test_bands_with_pixels_of_their_own_follow_each_other() -> None:
    names = watched(scene(pixels="separate"), memory=16_000_000)
    assert names == sorted(names)


def test_bands_follow_each_other_where_their_streams_would_not_be_kept_side_by_side() -> None:
    """Both streams of a band, each 19 x 40000 x 4 bytes = 3 MB, are kept where half of the memory
    is 10 MB; beside 15 MB of blocks there is no room for them in a band's share of 10 MB."""
    fast = scene(sample_rate="400 Hz")
    filters = [zonda.HighpassFilter(frequency="0.2 Hz"), zonda.CommonModeFilter()]
    names = watched(fast, filters=filters, memory=21_000_000)
    assert names == sorted(names)
    names = watched(fast, filters=filters, memory=60_000_000)
    assert names != sorted(names)


def test_where_a_band_fails_all_discard_what_they_began() -> None:
    with pytest.raises(Exception, match="on purpose"):
        watched(scene(), fail="f150", memory=16_000_000)
    assert sorted(Watched.discarded) == ["f090", "f150"]


@pytest.mark.parametrize("threads", [1, 2])
def test_bands_in_step_have_the_bits_that_they_have_alone(threads: int) -> None:
    """Two scans: the second is prepared while the first is executed, with two threads."""
    both = pipeline(scans=2).run(scene(), threads=threads)
    for number, band in enumerate(BANDS):
        alone = pipeline(scans=2).run(
            scene(1, band={k: band[k] for k in ("name", "low", "high")}, net=band["net"]),
            threads=threads,
        )
        for plane in PLANES:
            np.testing.assert_array_equal(
                getattr(both[f"map_{band['name']}"], plane),
                getattr(alone["map"], plane),
                str(number),
            )
