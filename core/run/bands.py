"""A camera of several bands: the telescope is pointed once, and each band observes the scans as a
camera that has no other.

Every band has the bits that it has alone. What bands share is keyed without them: pointing, and the
turbulence above the telescope. What belongs to detectors is keyed by instrument and band
(`Observation.detector_key`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..data import Data
from ..errors import InputError, PipelineError
from ..observation import Observation
from ..operator import Operator
from ..output import Progress
from ..scene import WithScene
from ..signal import MAIN, product_name, stream_of
from ..tally import Tally
from .schedule import Chain


@dataclass(frozen=True)
class Band:
    """One band that observes, or a camera that has one: the steps, the data, and who is told when a
    scan is done.
    """

    chain: Chain
    data: Data
    watch: Callable[[Data, Progress], None]

    @property
    def longest(self) -> Observation:
        """The scan of most samples."""
        return max(self.data.observations, key=lambda o: o.n_detectors * o.n_samples)


def looks_alike(bands: Sequence[Band]) -> bool:
    """Tell whether the detectors of all bands look through the same pixels."""
    scans = zip(*(band.data.observations for band in bands), strict=True)
    return all(one.looks_as(scan[0]) for scan in scans for one in scan)


def data_of_bands(data: Data) -> dict[str, Data]:
    """Give data a part for each band (`Data.bands`); none where the camera has one band."""
    instrument = data.scene.instrument
    data.bands = {
        name: Data(
            data.scene.model_copy(update={"instrument": camera}),
            provenance=dict(data.provenance),
            output=data.output,
            threads=data.threads,
            laid_out=data.laid_out,
            band=name,
        )
        for name, camera in (instrument.cameras.items() if instrument.bands else ())
    }
    return data.bands


def points(operator: Operator) -> bool:
    """Tell whether a step points the telescope, which is done once for all bands."""
    return "boresight" in operator.provides


def of_one_band(operator: Operator) -> bool:
    """Tell whether a step acts on each band's data: all do but those that only point, which is
    done once for all bands.

    A step that points and reads streams too observes the scans of all bands first, and then each
    band's data (`Data.band`); so does one that reads recorded pointing, whose flags differ from
    band to band.
    """
    return operator.provides != {"boresight"} or isinstance(operator, WithScene)


def use_recorded(data: Data, operators: Sequence[Operator]) -> None:
    """Give the scene the instrument and the site of recorded data that a step reads."""
    for operator in operators:
        if isinstance(operator, WithScene):
            given, own = data.scene, operator.own_scene(data.scene.instrument)
            data.scene = given.model_copy(
                update={what: own[what] for what in ("site", "instrument")}
            )
            for what in ("instrument", "site"):
                one, other = own[what].name, getattr(given, what).name
                text = f"{one}, the file's" + (
                    "" if one == other else f"; the scene's {other} is not used"
                )
                data.tally.state(operator.label, what, text)


def distribute(data: Data, bands: Sequence[Data]) -> None:
    """Give each band its detectors of all scans, and what is laid out for it."""
    common: list[dict[Hashable, Any]] = [{} for _ in data.observations]
    for number, own in enumerate(bands):
        own.observations = [
            _of_band(scan, number, own, part)
            for scan, part in zip(data.observations, common, strict=True)
        ]
        own.layouts = _of(data.layouts, own.band)
    data.pointed = data.observations


def hand_over(data: Data, bands: Sequence[Data]) -> None:
    """Give each band its scans, layouts and partial products of combined data (`gather`); nothing
    where there is one band.
    """
    if bands[0] is data:
        return
    for own in bands:
        own.observations = [
            scan for scan in data.observations if scan.instrument == own.scene.instrument
        ]
        own.partial, own.layouts = _of(data.partial, own.band), _of(data.layouts, own.band)
    data.partial, data.layouts = {}, {}


def _of(whole: Mapping[str, Any], band: str) -> dict[str, Any]:
    """Select by label, of the entries that `gather` put together, those of a band."""
    return {
        key.removesuffix(_key(band)): value
        for key, value in whole.items()
        if key.endswith(_key(band))
    }


def gather(data: Data, bands: Sequence[Data]) -> None:
    """Put together what the bands made: products and entries of the log bear the band's name;
    nothing where there is one band.

    What pointing counted in the scans is added once, not for each band.
    """
    if bands[0] is data:
        return
    for scan in data.pointed:
        data.tally.update(scan.tally)
    scans = zip(*(own.observations for own in bands), strict=True)
    data.observations = [scan for together in scans for scan in together]
    for own in bands:
        band = own.band
        for name, product in own.products.items():
            if isinstance(product, list):  # of files
                data.products.setdefault(name, []).extend(product)
                continue
            signal, _, plain = name.rpartition("/")
            key = product_name(stream_of(signal) if signal else MAIN, own.named(plain))
            if key in data.products:
                cure = "rename the band, or give the step another product name"
                raise PipelineError(
                    f"two steps make the product {key!r}", place=f"band {band}", cure=cure
                )
            data.products[key] = product
        data.partial |= {label + _key(band): part for label, part in own.partial.items()}
        data.layouts |= {label + _key(band): layout for label, layout in own.layouts.items()}
        data.tally.update(own.tally, suffix=f" {band}")


def _key(band: str) -> str:
    return f"@{band}"


def _of_band(scan: Observation, number: int, own: Data, common: dict[Hashable, Any]) -> Observation:
    """A scan with one band's detectors."""
    band = own.band
    plane = scan.focalplane.of_band(number)
    if not len(plane):
        raise InputError(
            f"the focal plane has no detector of the band {band}",
            place=f"instrument {own.scene.instrument.name}",
            cure=(
                "a class that lays out detectors of several bands joins them with"
                " Focalplane.of_bands"
            ),
        )
    return replace(
        scan,
        name=f"{scan.name}-{band}",
        instrument=own.scene.instrument,
        focalplane=plane,
        flags=scan.flags.copy(),
        detector_flags=scan.detector_flags[scan.focalplane.band == number],
        intervals=dict(scan.intervals),
        smooth={},
        detdata={},
        noise_levels={},
        closed_forms={},
        windows={},
        quoted_net=None,
        expected_load=None,
        load_spectra=None,
        tally=Tally(),
        common=common,
    )
