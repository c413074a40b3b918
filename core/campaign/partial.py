"""The results of tasks that are not yet combined: partial products, counts, and scans with a subset
of their directions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..configuration.time import Instant
from ..data import Data
from ..errors import InputError, PipelineError
from ..focalplane import Focalplane
from ..log import Log
from ..observation import Observation
from ..product import Product
from ..run.streams import Files
from ..scene import Scene
from . import trees

POINTS = 512
"""Boresight directions that are kept of a scan for pictures and tables; of those beyond `SCANS`,
16.
"""
SCANS = 32
LEVELS = ("main_beam_efficiency", "illumination_efficiency", "net", "knee", "slope")
"""What the steps made of the focal plane, for the report."""


class NotCombined(PipelineError):
    """A product that cannot be added to those of other observations."""


@dataclass
class Partial:
    """Results of one task or of several, in the order of their scans.

    Attributes
    ----------
    products
        By the label of the step.
    scans
        What `Thinned` is made of.
    """

    products: dict[str, Product]
    log: Log
    scans: list[dict[str, Any]]

    @classmethod
    def of(cls, data: Data, before: int, prefix: str) -> Partial:
        """Partial product of the scans of a task. ``before``: number of scans before them;
        ``prefix``: of their names.

        Raises `NotCombined` for a product that no campaign can add up.
        """
        kinds = {label: type(product) for label, product in data.partial.items()}
        place = str(data.provenance["name"])
        for label, kind in kinds.items():
            if kind.__module__ == "__main__" or "<locals>" in kind.__qualname__:
                raise NotCombined(
                    f"{label} adds up a {kind.__name__}, a class of this session: other processes"
                    " cannot find it",
                    place=place,
                    cure="move the class, and the step that makes it, to a module",
                )
        for name in data.products:
            raise NotCombined(
                f"the product {name!r} cannot be combined with those of other observations",
                place=place,
                cure=(
                    "its operator must hand a zonda.Product to data.add(), see docs/plugins.md; or"
                    " run them one by one"
                ),
            )
        # figures of scans of one number share a row, whatever the entry: there may be a million
        # entries
        log = _log_of(
            {
                **_rows(data.log),
                "figures": [(a, b.removeprefix(prefix), c) for a, b, c in data.log.figures()],
            }
        )
        bands = max(1, len(data.scene.instrument.bands))
        return cls(
            data.partial,
            log,
            [_thinned(o, k // bands + before) for k, o in enumerate(data.observations)],
        )

    def __iadd__(self, other: Partial) -> Partial:
        """Add what follows."""
        for label, product in other.products.items():
            if label in self.products:
                self.products[label] += product
            else:
                self.products[label] = product
        self.log.update(other.log)
        self.scans += other.scans
        return self

    def write(self, path: Path, identity: str, made: Mapping[str, Any]) -> None:
        """Write it to a file; ``made``: how it was made (`trees.head`)."""
        products = {
            label: {"kind": p.identity(), "arrays": p.arrays()}
            for label, p in self.products.items()
        }
        tree = {"products": products, "scans": self.scans, "tally": _rows(self.log)}
        trees.write(path, identity, tree, made)

    @classmethod
    def read(cls, path: Path, identity: str, files: Files | None = None) -> Partial:
        """Read it from a file; ``files``: for products that may be there. Raises `InputError` where
        that is missing or damaged.
        """
        tree = trees.read(path, identity)
        products = {}
        for label, product in tree["products"].items():
            kind = Product.kinds.get(product["kind"])
            if kind is None:
                raise InputError(
                    f"{label} adds up a {product['kind']}, which no step of the pipeline imports",
                    place=str(path),
                    cure="import the class in the module of the step that makes it",
                )
            arrays = product["arrays"]
            products[label] = kind.of(files.put(arrays) if files and kind.in_files else arrays)
        return cls(products, _log_of(tree["tally"]), tree["scans"])

    def observations(self, scene: Scene) -> list[Observation]:
        """Thinned scans, each of its bands in turn; the focal plane is as the steps left it in the
        very first one.
        """
        whole = scene.instrument.focalplane()
        cameras = list(scene.instrument.cameras.values())
        planes = [whole.of_band(k) if len(cameras) > 1 else whole for k in range(len(cameras))]
        for plane, first in zip(planes, self.scans, strict=False):
            for name, values in first["focal_plane"].items():
                setattr(plane, name, values)
        bands = [
            (scene.model_copy(update={"instrument": c}), plane)
            for c, plane in zip(cameras, planes, strict=True)
        ]
        return [
            Thinned.made(scan, k // len(bands), *bands[k % len(bands)])
            for k, scan in enumerate(self.scans)
        ]


@dataclass
class Thinned(Observation):
    """A scan with a subset of its boresight directions: `seconds`, `boresight_azel` and
    `boresight_radec` hold those alone.

    ``flags`` and ``detector_flags`` hold as many ones as there are flagged samples and detectors.
    """

    samples: int = 0
    detectors: int = 0
    emission: dict[str, float] = field(default_factory=dict)
    names: tuple[str, str, str] = ("", "", "")

    def __post_init__(self) -> None:
        """No flags are made for the samples that are not here."""

    @property
    def n_samples(self) -> int:
        return self.samples

    @property
    def n_detectors(self) -> int:
        return self.detectors

    @property
    def origin(self) -> tuple[str, str, str]:
        return self.names

    @property
    def mean_emission(self) -> dict[str, float]:
        return self.emission

    @classmethod
    def made(cls, scan: dict[str, Any], index: int, scene: Scene, plane: Focalplane) -> Thinned:
        """Restore a scan from what `_thinned` kept."""
        samples, detectors = (np.ones(number, np.uint8) for number in scan["flagged"])
        own = {
            k: v
            for k, v in scan.items()
            if k not in ("start", "centre", "origin", "focal_plane", "flagged")
        }
        return cls(
            index=index,
            site=scene.site,
            instrument=scene.instrument,
            focalplane=plane,
            start=Instant(scan["start"]),
            centre=(scan["centre"][0], scan["centre"][1]),
            seed=scene.seed,
            flags=samples,
            detector_flags=detectors,
            names=tuple(scan["origin"]),
            **own,
        )


def _rows(log: Log) -> dict[str, list[Any]]:
    return {"counts": log.counts(), "totals": log.totals(), "figures": log.figures()}


def _log_of(rows: Mapping[str, Any]) -> Log:
    log = Log()
    totals = {(who, what): total for who, what, total in rows["totals"]}
    for who, what, count in rows["counts"]:
        log.count(who, what, count, totals.get((who, what), 0))
    for who, what, text in rows["figures"]:
        log.state(who, what, text)
    return log


def _thinned(observation: Observation, number: int) -> dict[str, Any]:
    """A scan as a report shows it, with a subset of its boresight directions. ``number``: its place
    in the campaign.
    """
    n = observation.n_samples
    elevation = observation.elevation
    kept = np.linspace(0, n - 1, min(n, POINTS if number < SCANS else 16)).round().astype(int)
    kept = np.unique([*kept, elevation.argmin(), elevation.argmax()])
    return {
        "name": observation.name,
        "start": observation.start.nanoseconds,
        "samples": n,
        "detectors": observation.n_detectors,
        "sample_rate": observation.sample_rate,
        "seconds": observation.seconds[kept],
        "boresight_azel": observation.boresight_azel[kept],
        "boresight_radec": observation.boresight_radec[kept],
        "centre": list(observation.centre),
        "origin": list(observation.origin),
        "emission": observation.mean_emission,
        "focal_plane": (
            {name: getattr(observation.focalplane, name) for name in LEVELS} if number == 0 else {}
        ),
        "flagged": [
            int(np.count_nonzero(~observation.good_samples)),
            int(np.count_nonzero(~observation.good_detectors)),
        ],
    }
