"""Data of a run: the scene, its observations, the blocks of operators, and the products."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from .block import STREAMS, Block
from .canvas import shown_axes
from .configuration.diagnostics import nearest
from .errors import InputError, PipelineError
from .log import Log, percent
from .observation import Observation
from .product import Product
from .stream import Stream, in_order, unit_of_stream
from .tables import html_table
from .types import Floats

if TYPE_CHECKING:
    from .scene import Scene

__all__ = [
    "STREAMS",
    "Block",
    "Data",
    "Log",
    "Observation",
    "Stream",
    "html_table",
    "in_order",
    "percent",
]


@dataclass
class Data:
    """The scene, its observations, and what came out of them.

    ``products`` maps names to whatever operators made (maps, spectra, file paths); products of
    another signal than the complete one (see `core.signal`) carry its name and a slash:
    ``noiseless/map``.
    """

    scene: Scene
    observations: list[Observation] = field(default_factory=list)
    products: dict[str, Any] = field(default_factory=dict)
    log: Log = field(default_factory=Log)
    provenance: dict[str, Any] = field(default_factory=dict)
    output: Any = None
    """Folder (Path) that products are written to; None: nothing is written."""
    pipeline: Any = field(default=None, repr=False)
    """The `Pipeline` that made all of it; None where several runs did."""
    threads: int = 1
    """Threads that the run may use."""
    progress: Callable[[int, int, str], None] = field(
        default=lambda done, total, what: None, repr=False
    )
    """Called in `Operator.finalize` of long work: so many of ``total`` steps of it are done."""
    files: Any = field(default=None, repr=False)
    """`core.run.streams.Files`, for arrays of products that do not fit in memory; None: all fit."""
    band: str = ""
    """Name of the band that these are the data of, where the camera has several."""
    n_bands: int = 1
    """Bands of the camera that this is one of (`band`); 1 in the data of the whole camera."""
    bands: dict[str, Data] = field(default_factory=dict, repr=False)
    """By name, the data of each band of a camera with several: its scans, and its products under
    the names that they have in a camera of one band.
    """

    pointed: list[Observation] = field(default_factory=list)
    """The scans of several bands before each of these got its detectors; empty where there is one
    band.
    """
    partial: dict[str, Product] = field(default_factory=dict)
    """Partial products that steps have added up so far, by label."""
    layouts: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    """By label: what all observations have in common (the grid of a map), as plain values and
    arrays; ``fixed: True`` says that further observations cannot change it. `Operator.observe`
    makes it, or extends what earlier parts of a campaign made. In `Operator.check` the ``kind`` of
    a map (its projection, HEALPix, or hits) and the ``product`` that it will be."""
    made: frozenset[str] = frozenset()
    """In `Operator.check` what the steps of the pipeline make: streams and products. Empty: not
    known.
    """
    laid_out: bool = False
    """The layouts are those of all parts of a campaign: `Operator.observe` takes them as they are.
    """

    @property
    def n_scans(self) -> int:
        """Number of scans; in `Operator.check`, which sees some of them, that of the last one and
        those before it.
        """
        return (
            max(len(self.observations), self.observations[-1].index + 1) if self.observations else 0
        )

    def check_scan(self, number: int, place: str) -> None:
        """Refuse the number of a scan that is not there (PipelineError)."""
        if number >= self.n_scans:
            there = f"choose 0 to {self.n_scans - 1}" if self.n_scans > 1 else "leave it out"
            text = (
                f"there is no observation {number}: the pipeline makes {self.n_scans}, counted"
                " from 0"
            )
            raise PipelineError(text, place=place, cure=f"{there}, or make more scans")

    def add(self, label: str, product: Product) -> None:
        """Add an observation's share to the partial product of a step."""
        whole = self.partial.setdefault(label, product)
        if type(whole) is not type(product):
            cure = "a step adds up products of one class"
            raise PipelineError(
                f"added a {type(product).__name__} to a {type(whole).__name__}",
                place=label,
                cure=cure,
            )
        if whole is not product:
            whole += product
            self.partial[label] = whole

    @property
    def scans(self) -> list[Observation]:
        """Scans as they were pointed; with several bands, each has the detectors of every band.

        Of a campaign of several bands those of the first, which is all that its folder tells.
        """
        bands = len(self.scene.instrument.bands) if not self.band else 0
        return self.pointed or self.observations[:: bands or 1]

    def use_recorded(self, label: str, own: Mapping[str, Any]) -> None:
        """Give the scene the instrument and the site of recorded data (`WithScene.own_scene`) that
        the step of this label reads.
        """
        for what in ("instrument", "site"):
            one = own[what].name
            other = getattr(self.scene, what).name
            text = f"{one}, the file's"
            if one != other:
                use = "is not used" if what == "site" else "gives what it does not state"
                text += f"; the scene's {other} {use}"
            self.log.state(label, what, text)
        self.scene = self.scene.model_copy(
            update={what: own[what] for what in ("site", "instrument")}
        )

    def split(self) -> list[Data]:
        """Make the data of each band (`bands`); none where the camera has one."""
        instrument = self.scene.instrument
        self.bands = {
            name: Data(
                self.scene.model_copy(update={"instrument": camera}),
                provenance=dict(self.provenance),
                output=self.output,
                threads=self.threads,
                progress=self.progress,
                files=self.files,
                laid_out=self.laid_out,
                band=name,
                n_bands=len(instrument.bands),
            )
            for name, camera in (instrument.cameras.items() if instrument.bands else ())
        }
        return list(self.bands.values())

    def hand_out(self, scans: Sequence[Observation] = ()) -> None:
        """Give each band its views of the scans as they were pointed, or the ``scans`` that are
        its views; and its part of what is laid out and added up (`gather`).
        """
        for scan in () if scans else self.observations:
            common: dict[Hashable, Any] = {}
            for own, view in zip(self.bands.values(), scan.of_each_band(), strict=True):
                view.common = common
                own.observations.append(view)
        self.pointed = [] if scans else self.observations
        for own in self.bands.values():
            own.observations += [s for s in scans if s.instrument == own.scene.instrument]
            both: Any = (self.partial, own.partial), (self.layouts, own.layouts)
            for whole, part in both:
                for label in [key for key in whole if key.endswith(f" {own.band}")]:
                    part[label.removesuffix(f" {own.band}")] = whole.pop(label)

    def gather(self) -> None:
        """Put together what the bands made: products, labels and entries of the log bear the band's
        name; nothing where there is one band.

        What pointing counted in the scans is added once, not for each band.
        """
        for scan in self.pointed:
            self.log.update(scan.log)
        scans = zip(*(own.observations for own in self.bands.values()), strict=True)
        self.observations = [s for views in scans for s in views] or self.observations
        for band, own in self.bands.items():
            for name, product in own.products.items():
                if isinstance(product, list):  # of files
                    self.products.setdefault(name, []).extend(product)
                    continue
                signal, slash, plain = name.rpartition("/")
                key = f"{signal}{slash}{own.named(plain)}"
                if key in self.products:
                    cure = "rename the band, or give the step another product name"
                    raise PipelineError(
                        f"two steps make the product {key!r}",
                        place=f"band {band}",
                        cure=cure,
                    )
                self.products[key] = product
            self.partial |= {f"{label} {band}": part for label, part in own.partial.items()}
            self.layouts |= {f"{label} {band}": part for label, part in own.layouts.items()}
            self.log.update(own.log, suffix=f" {band}")

    def named(self, key: str) -> str:
        """The name of a product or file of these data, the band's behind it where the camera has
        several.
        """
        return f"{key}_{self.band}" if self.band else key

    def take(self, label: str) -> Any:
        """The partial product of a step, None where it has none; it is not held here any longer."""
        return self.partial.pop(label, None)

    def __getitem__(self, name: str) -> Any:
        """The product of this name: ``data["map"]``, ``data["noiseless/map"]``. Raises InputError
        where there is none.
        """
        return product_of(self.products, name)

    def __contains__(self, name: object) -> bool:
        """True if there is a product of this name."""
        return name in self.products

    def __iter__(self) -> Iterator[str]:
        """Names of the products."""
        return iter(self.products)

    def tod(self, stream: str = "signal", scan: str | int | None = None) -> KeptStream:
        """(n_det, n_samp) float64: all of a stream that ``Pipeline.run(..., keep=["signal"])``
        kept, its mean emission included. ``data.tod("signal").plot()`` draws it.

        Parameters
        ----------
        stream
            ``signal`` or ``signal/noiseless`` as they stand after the last step, or a component as
            it was made, before efficiencies and calibration (``atmosphere``, ``white``, ``sky``
            ...); K_RJ.
        scan
            Name (``scan-001``) or number of the scan; needed where there are several.

        Raises
        ------
        InputError
            For a scan or a stream that there is not; the message says what was kept.
        """
        observation = one_scan(self.observations, scan)
        found = kept(observation, stream).view(KeptStream)
        found.stream, found.scan = stream, observation
        return found

    def blocks(
        self,
        stream: str = "signal",
        scan: str | int | None = None,
        detectors: int = 64,
    ) -> Iterator[tuple[Observation, slice, Floats]]:
        """(observation, detectors, part of `tod`) of one scan, or of all, at most so many
        ``detectors`` at a time.
        """
        if detectors < 1:
            raise PipelineError(
                f"{detectors} detectors at a time",
                place="data.blocks",
                cure="take 1 or more",
            )
        scans = self.observations if scan is None else [one_scan(self.observations, scan)]
        for observation in scans:
            for first in range(0, observation.n_detectors, detectors):
                rows = slice(first, min(first + detectors, observation.n_detectors))
                yield observation, rows, kept(observation, stream, rows)

    def __repr__(self) -> str:
        number = len(self.observations)
        return (
            f"<Data: {number} observation{'s' * (number != 1)}, products {sorted(self.products)}>"
        )

    def _repr_html_(self) -> str:
        return html_table(
            "Data",
            [(o.name, f"{o.n_detectors} x {o.n_samples}") for o in self.observations]
            + [("products", ", ".join(sorted(self.products)))],
        )


class KeptStream(np.ndarray[Any, np.dtype[np.float64]]):
    """A stream (n_det, n_samp) of a run: a numpy array that can be drawn. Its parts, and what is
    computed of it, are plain arrays.

    Attributes
    ----------
    stream, scan
        Its name, and the scan that it belongs to.
    """

    stream = ""
    scan: Observation | None = None

    def plot(self, detectors: int | Sequence[int] = 3, ax: Any = None) -> Any:
        """Draw some detectors (their numbers, or how many, chosen evenly) into ``ax`` (default: a
        new figure), and return the matplotlib Axes. Raises InputError for a detector that there is
        not.
        """
        from .plots import draw_stream

        scan = self.scan
        n = len(self)
        if scan is None:
            cure = "draw data.tod(...) itself"
            raise InputError("a copy of a stream does not know its scan", place="plot", cure=cure)
        given = np.atleast_1d(detectors)
        if isinstance(detectors, int | np.integer):
            given = np.unique(np.linspace(0, n - 1, min(max(int(detectors), 1), n)).round())
        rows = [int(k) for k in given]
        if wrong := [k for k in rows if not -n <= k < n]:
            cure = f"choose from 0 to {n - 1}"
            raise InputError(f"there is no detector {wrong[0]}", place=scan.name, cure=cure)
        ax = shown_axes(ax, (8.0, 4.0))
        names = [scan.focalplane.names[k] for k in rows]
        draw_stream(
            ax,
            self.stream,
            unit_of_stream(self.stream),
            scan.seconds,
            self[rows],
            names,
            f"{self.stream}, {scan.name}",
        )
        return ax

    def __getitem__(self, at: Any) -> Any:
        return np.asarray(self)[at]

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return array if array is self else np.asarray(array)[()]


EMISSION = "atmosphere"
"""The component that is kept without its mean, which stands in `Observation.smooth`."""


def product_of(products: Mapping[str, Any], name: str) -> Any:
    """A product by its name. Raises InputError where there is none."""
    if name not in products:
        have = (
            f"there are: {', '.join(sorted(products))}"
            if products
            else "the pipeline made none: add a step that makes one"
        )
        cure = "\n".join(filter(None, (nearest(name, products), have)))
        raise InputError(f"there is no product {name!r}", place="data", cure=cure)
    return products[name]


def one_scan(observations: Sequence[Observation], scan: str | int | None) -> Observation:
    """The scan of a name or number; None: the only one. Raises InputError."""
    names = [observation.name for observation in observations]
    listed = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    if not names:
        raise InputError("there is no scan", place="data.tod", cure="run a pipeline")
    if scan is None:
        if len(names) > 1:
            cure = f"name one: scan={names[0]!r} or scan=0; data.blocks() goes through all"
            raise InputError(f"there are {len(names)} scans: {listed}", place="data.tod", cure=cure)
        return observations[0]
    if isinstance(scan, str) and scan in names:
        return observations[names.index(scan)]
    if not isinstance(scan, str) and -len(names) <= scan < len(names):
        return observations[scan]
    cure = (nearest(scan, names) if isinstance(scan, str) else "") or f"there are: {listed}"
    raise InputError(f"there is no scan {scan!r}", place="data.tod", cure=cure)


def kept(observation: Observation, stream: str, rows: slice = slice(None)) -> Floats:
    """These detectors of a kept stream, with the mean that belongs to it. Raises InputError where
    it was not kept.
    """
    if stream not in observation.detdata:
        have = sorted(observation.detdata)
        what = f"only {' and '.join(have)}" if have else "no stream was"
        cure = (
            f"run it again with pipeline.run(scene, keep={[*have, stream]!r}): 4 bytes for each"
            " sample of each stream"
        )
        raise InputError(
            f"the stream {stream!r} was not kept, {what}",
            place=observation.name,
            cure=cure,
        )
    found = observation.detdata.rows(stream, rows)
    if stream == EMISSION and EMISSION in observation.smooth:
        first, stop, _ = rows.indices(observation.n_detectors)
        found += observation.smooth[EMISSION].evaluate(
            slice(first, stop),
            slice(0, observation.n_samples),
        )
    return found
