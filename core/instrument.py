"""A telescope with its camera."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    Field,
    ModelWrapValidatorHandler,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError

from .array_table import OF_INSTRUMENT, ArrayTable, read_array, stated_by
from .band import NO_BAND, PER_BAND, SPEED_OF_LIGHT, Band, BandOfCamera, CameraBand, with_yield
from .configuration.diagnostics import mistake, nearest, refusal
from .configuration.input_paths import InputPath, find
from .configuration.parameters import Parameters, named, named_or_written, quantity
from .configuration.units import (
    Angle,
    AngularAcceleration,
    AngularJerk,
    AngularSpeed,
    Fraction,
    Hertz,
    KelvinRootSecond,
    Metres,
    SampleRate,
)
from .errors import InputError, ZondaError
from .focalplane import Focalplane
from .layouts import Layout, hexagonal_packing, rings, wafers
from .numerics.random import stream_key, uniforms
from .registry import RegistryError, bands, instruments, layouts
from .types import Floats, Integers
from .variants import LIKE, is_variant, variant

__all__ = ["SPEED_OF_LIGHT", "Band", "CameraBand", "Instrument", "Telescope", "hexagonal_packing"]


LATTICES = {"hexagon": hexagonal_packing, "rings": rings}
"""Layouts without wafers, by name: functions of the number of pixels that return their places."""

ARRAY = 0.475
"""Radius of an array of one of several bands, in units of the distance between the centres of two
that are neighbours.
"""


STAND_INS: dict[str, Any] = {
    "detectors": 1,
    "net": "0 K s(1/2)",
    "main_beam_efficiency": 1.0,
    "illumination_efficiency": 1.0,
}
"""Keys that bands or a table may state in the instrument's place: if these are mistaken, only their
mistakes are told.
"""


STAND_IN = "stand-in: "
"""Begins the source of a number that is not published or could not be looked up."""


class Telescope(Parameters):
    """The dish and its mount."""

    name: str
    """E.g. GBT."""
    diameter: Metres = Field(gt=0, examples=["12 m"])
    """Primary diameter."""
    site: str = Field("", exclude=True)
    """Registered name of the site where it stands; `zonda check` says so where the scene has
    another.
    """
    elevation_min: Angle = quantity("5 deg", ge=0)
    """Lowest elevation the mount reaches."""
    elevation_max: Angle = quantity("90 deg", gt=0)
    """Highest elevation the mount reaches."""
    speed_max: AngularSpeed | None = Field(None, gt=0, examples=["2 deg/s"])
    """Fastest motion on the sky, where there is a limit."""
    acceleration_max: AngularAcceleration | None = Field(None, gt=0)
    """Largest acceleration on the sky, where there is a limit."""
    azimuth_speed_max: AngularSpeed | None = Field(None, gt=0, examples=["3 deg/s"])
    """Fastest turn of the azimuth axis: the speed on the sky over the cosine of the elevation."""
    azimuth_acceleration_max: AngularAcceleration | None = Field(None, gt=0)
    """Largest acceleration of the azimuth axis."""
    azimuth_jerk_max: AngularJerk | None = Field(None, gt=0)
    """Fastest change of the azimuth axis' acceleration."""
    elevation_speed_max: AngularSpeed | None = Field(None, gt=0, examples=["1.5 deg/s"])
    """Fastest turn of the elevation axis."""
    elevation_acceleration_max: AngularAcceleration | None = Field(None, gt=0)
    """Largest acceleration of the elevation axis."""
    elevation_jerk_max: AngularJerk | None = Field(None, gt=0)
    """Fastest change of the elevation axis' acceleration."""

    def _as_argument(self) -> str:
        return repr(self)


if TYPE_CHECKING:

    class ParametersWithYield(Parameters):
        """Parameters with the field ``yield``."""

else:
    ParametersWithYield = with_yield(Parameters, 1.0)


class Instrument(ParametersWithYield):
    """A camera on a telescope: detectors in a round field of view, laid out or from a table.
    Subclass to lay out others.
    """

    polarized_by: ClassVar[str] = "set polarization: pairs of the instrument"
    """What makes detectors polarized that are not those of a table."""

    name: str
    """Registered name."""
    description: str = ""
    """What it is, in one line."""
    telescope: Telescope
    """The dish it is mounted on."""
    band: BandOfCamera = NO_BAND
    """The passband: a registered name, or a Band. Not needed with `bands`; beside them the name of
    the one to observe with.
    """
    bands: list[CameraBand] = Field(default_factory=list, max_length=32)
    """Bands that are observed at the same time, each with what its detectors have of their own;
    what a band does not state holds as it is stated for the instrument. Maps and other products are
    made for each."""
    pixels: Literal["shared", "separate", "overlaid"] = "shared"
    """Of several bands: every pixel has detectors of every band; the bands have arrays side by
    side; or each has an array of its own that fills the field of view, as behind dichroic beam
    splitters."""
    detectors: int = Field(ge=1, le=1_000_000)
    """Number of detectors. Of several bands, that of each."""
    field_of_view: Angle = Field(ge=0, le=1.0)
    """Diameter of the circle that holds all detectors."""
    layout: str = "hexagon"
    """`hexagon`: pixels on a hexagonal lattice from the centre outward; `rings`; `wafers`: on
    hexagonal wafers that share them equally; or a registered layout (`zonda plugins`)."""
    wafers: int = Field(1, ge=1, le=1000)
    """Number of wafers, for `layout: wafers`."""
    focalplane_table: InputPath | None = Field(None, alias="focalplane")
    """Table of detectors in place of a layout: ECSV or CSV with columns `name`, `xi`, `eta`, and
    what they have of their own; TOAST's focal plane (HDF5); or sotodlib's hardware (TOML). The
    number of detectors and the field of view follow from it."""
    polarization: Literal["none", "pairs"] = "none"
    """`pairs`: each pixel has two detectors, A and B, polarized at right angles; A is at 0 and at
    45 deg in alternate pixels.
    """
    fwhm: Angle | None = Field(None, gt=0, examples=["9 arcsec"])
    """Main-beam FWHM; where absent, the diffraction limit 1.22 lambda / D at the band centre."""
    main_beam_efficiency: Fraction = Field(gt=0, le=1, examples=["0.6"])
    """zeta: share of an astronomical signal that the main beam delivers."""
    illumination_efficiency: Fraction = Field(gt=0, le=1, examples=["0.9"])
    """epsilon: share of the atmosphere's emission that reaches a detector."""
    net: KelvinRootSecond = Field(ge=0)
    """White noise on the sky after calibration, K_RJ sqrt(s): the rms of one second of integration.
    """
    knee: Hertz = quantity("0 Hz", ge=0, examples=["0.5 Hz"])
    """Frequency at which pink noise equals white noise (0: no pink noise)."""
    slope: float = Field(1.0, gt=0, le=3)
    """Pink noise falls as f^-slope."""
    pink_minimum_frequency: Hertz = quantity("1 mHz", gt=0)
    """Below this frequency pink noise is flat."""
    sample_rate: SampleRate = Field(gt=0, le=1e6)
    """Read-out rate."""
    provenance: str = ""
    """Sources of these numbers: a text, or a mapping of what a number is to its source."""

    @model_validator(mode="wrap")
    @classmethod
    def _or_variant(
        cls,
        value: Any,
        validate: ModelWrapValidatorHandler[Instrument],
        info: ValidationInfo,
    ) -> Instrument:
        made: Instrument = variant(value, info.context) if is_variant(value) else validate(value)
        return made

    def _as_argument(self) -> str:
        return named_or_written(self, instruments)

    @model_validator(mode="before")
    @classmethod
    def _one_or_several_bands(cls, value: Any, info: ValidationInfo) -> Any:
        """Take from `bands` a value that all of them state; ``band`` beside ``bands`` chooses one
        of them.
        """
        if isinstance(value, dict) and value.get("focalplane") is not None:
            value = _completed(value, info)
        if (
            not isinstance(value, dict)
            or not isinstance(value.get("bands"), list)
            or not value["bands"]
        ):
            return value
        if (chosen := value.get("band")) is not None:
            whole = cls.model_validate(
                {k: v for k, v in value.items() if k != "band"},
                context=info.context,
            )
            if not isinstance(chosen, str) or chosen not in whole.cameras:
                text = "band beside bands is the name of one of them"
                if isinstance(chosen, str):
                    text = f"{whole.name} has no band '{chosen}'"
                cure = f"write one of {', '.join(whole.cameras)}, or leave band or bands out"
                raise mistake(text, nearest(chosen, whole.cameras), cure, at=("band",))
            camera = whole.cameras[chosen]
            return camera.model_dump(mode="json") | {
                "telescope": camera.telescope,
                "band": camera.band,
            }
        own = [b.model_dump(mode="json") if isinstance(b, Band) else b for b in value["bands"]]
        own = [band if isinstance(band, dict) else {} for band in own]
        common = {
            key: own[0][key] for key in PER_BAND if all(band.get(key) is not None for band in own)
        }
        try:
            CameraBand.model_validate({"name": "first", "low": "1 Hz", "high": "2 Hz"} | common)
        except ValidationError:  # which the band's own validation tells, at its place
            common = {key: STAND_INS[key] for key in common if key in STAND_INS}
        return common | value

    @model_validator(mode="after")
    def _bands_fit(self) -> Instrument:
        for wrong, text, cure, at in self._mistakes():
            if wrong:
                raise mistake(text, "", cure, at=at)
        if self.focalplane_table is not None:
            self._check_table(self.focalplane_table)
        return self

    def _mistakes(self) -> Iterator[tuple[bool, str, str, tuple[str | int, ...]]]:
        """Mistakes of bands, pixels and wafers: (whether it is made, message, cure, place)."""
        names = [band.name for band in self.bands]
        for k, name in enumerate(names):
            cure = "give each a name of its own: products and files bear it"
            yield name in names[:k], f"two bands are called {name}", cure, ("bands", k, "name")
        none = self.band is None and not names
        cure = "name one with band, or several with bands"
        yield none, "a camera needs a band", cure, ("band",)
        if self.focalplane_table is not None:
            lost = any(getattr(part, "yield") not in (None, 1.0) for part in (self, *self.bands))
            cure = "leave it out: the column `dead` of the table tells which detectors give no data"
            yield lost, "yield is for layouts, not for a table of detectors", cure, ("yield",)
            return
        counts = self._counts
        wafers = self._wafers
        pairs = self.polarization == "pairs"
        listed = ", ".join(f"{name} has {number}" for name, number in counts.items())
        yield (
            self.pixels == "shared" and len(set(counts.values())) > 1,
            f"shared pixels need as many detectors in every band: {listed}",
            "give all bands the same number of detectors, or write pixels: separate",
            ("bands",),
        )
        yield (
            self.wafers > 1 and self.layout != "wafers",
            f"{self.wafers} wafers go with layout: wafers, not {self.layout}",
            "write layout: wafers, or leave out wafers",
            ("wafers",),
        )
        share = self._pair * wafers
        for k, (name, number) in enumerate(counts.items()):
            own = bool(names) and self.bands[k].detectors is not None
            at: tuple[str | int, ...] = ("bands", k, "detectors") if own else ("detectors",)
            told = f"detectors{f' of {name}' if names else ''} is {number}"
            below = number // share * share
            cure = f"write {below} or {below + share}" if below else f"write {share}"
            need = "polarization: pairs needs an even number of detectors, two in each pixel"
            yield pairs and number % 2 > 0, f"{need}; {told}", cure, at
            text = f"{wafers} wafers share their pixels equally; {told}, no multiple of {share}"
            yield number % share > 0, text, f"{cure}, or layout: hexagon", at

    def _check_table(self, path: Path) -> None:
        """Raise what a validator does if the table of detectors does not suit the instrument."""
        try:
            table = read_array(path)
            table.check(self._counts, several=bool(self.bands))
            message = ""
            if table.reach > math.tan(self.field_of_view / 2) * (1 + 1e-9):
                field = f"{math.degrees(2 * math.atan(table.reach)):.6g} deg"
                message = f"has detectors in a field of {field}, more than field_of_view"
                cure = f"leave out field_of_view, or write at least {field}"
            elif self.polarization == "pairs" and "polarization_angle" not in table.columns:
                message = "has no column 'polarization_angle'"
                cure = "add it, or leave out polarization: pairs, which belongs to layouts"
            if message:
                raise InputError(message, place=table.table.place, cure=cure)
        except ZondaError as err:
            raise refusal(err, at=("focalplane",)) from None

    @model_serializer(mode="wrap")
    def _by_the_keys_of_files(self, handler: SerializerFunctionWrapHandler) -> Any:
        """``focalplane`` in place of the field's name, which the method takes."""
        dumped = handler(self)
        if "focalplane_table" in dumped:
            dumped["focalplane"] = dumped.pop("focalplane_table")
        return dumped

    @property
    def _counts(self) -> dict[str, int]:
        """Detectors of each band."""
        return {band.name: band.detectors or self.detectors for band in self.bands} or {
            self.band.name: self.detectors
        }

    @property
    def _wafers(self) -> int:
        """Wafers that share the pixels of a band equally."""
        if self.layout in (*LATTICES, "wafers"):
            return self.wafers
        return int(getattr(layouts.get(self.layout), "wafers", 1))

    @property
    def _pair(self) -> int:
        """Detectors of a pixel in one band."""
        return 2 if self.polarization == "pairs" else 1

    @field_validator("focalplane_table")
    @classmethod
    def _readable(cls, path: Path | None) -> Path | None:
        if path is not None:
            try:
                read_array(path)
            except ZondaError as err:
                raise refusal(err) from None
        return path

    @field_validator("layout")
    @classmethod
    def _known_layout(cls, name: str) -> str:
        if name in (*LATTICES, "wafers"):
            return name
        try:
            layouts.get(name)
        except RegistryError as err:
            label = nearest(name, [*LATTICES, "wafers", *layouts], err.label)
            cure = f"write hexagon, rings, wafers or a registered layout: {', '.join(layouts)}"
            raise mistake(
                f"unknown layout {name!r}" if name not in layouts else err.message,
                label,
                cure,
            ) from None
        return layouts.registered(name)

    @field_validator("band", mode="before")
    @classmethod
    def _band_by_name(cls, value: Any) -> Any:
        return named(bands, value)

    @field_validator("provenance", mode="before")
    @classmethod
    def _sources_as_text(cls, value: Any) -> Any:
        """Join the sources of numbers to one text: published ones first, then stand-ins."""
        if not isinstance(value, dict):
            return value
        stand_ins = {k: v for k, v in value.items() if str(v).startswith(STAND_IN)}
        texts = [f"{k}: {v}" for k, v in value.items() if k not in stand_ins]
        texts += [f"{STAND_IN}{k}: {v.removeprefix(STAND_IN)}" for k, v in stand_ins.items()]
        return "; ".join(texts)

    def varied(self, **changes: Any) -> Instrument:
        """This instrument with fields changed, as ``{like: ..., ...}`` in a pipeline file
        (`core.variants.variant`).
        """
        made: Instrument = variant({LIKE: self, **changes})
        return made

    @property
    def cameras(self) -> dict[str, Instrument]:
        """Cameras with one band each, by name of the band.

        Of bands with arrays side by side the field of view is that of one array.
        """
        if not self.bands:
            return {self.band.name: self}
        field = 2 * math.atan(math.tan(self.field_of_view / 2) * self._arrays[2])
        apart = self.pixels == "separate" and self.focalplane_table is None
        common = {"bands": [], "field_of_view": field if apart else self.field_of_view}
        return {
            b.name: self.model_copy(update={**common, "band": b.alone, **b.stated})
            for b in self.bands
        }

    @property
    def _arrays(self) -> tuple[Floats, Floats, float]:
        """Centres of the arrays of separate bands, and their radius, in units of the radius of the
        field of view.
        """
        x, y = hexagonal_packing(len(self.bands))
        x = x - x.mean()
        y = y - y.mean()
        whole = float(np.hypot(x, y).max()) + ARRAY
        return x / whole, y / whole, ARRAY / whole

    @property
    def identity(self) -> tuple[str, ...]:
        """Names and passband, which tell its detectors' random numbers from those of another
        instrument or band.
        """
        return "instrument", self.name, "band", *self.band.identity

    @property
    def beam_fwhm(self) -> float:
        """`fwhm`, or the diffraction limit 1.22 lambda / D at the band centre, rad; of several
        bands the smallest.
        """
        if self.bands:
            return min(camera.beam_fwhm for camera in self.cameras.values())
        if self.fwhm is not None:
            return self.fwhm
        return 1.22 * SPEED_OF_LIGHT / self.band.centre / self.telescope.diameter

    def focalplane(self) -> Focalplane:
        """The detector table: that of a file, or pixels that are laid out so that they just fill
        `field_of_view`.

        A pixel has one detector, or two with ``polarization: pairs``: A and B, at right angles,
        next to each other in the table. A of every second pixel lies at 0, of the others at 45 deg.
        Several bands follow each other, in the order of `bands`.
        """
        if self.bands:
            return self._of_several_bands()
        stated = {key: getattr(self, key) for key in OF_INSTRUMENT} | {"fwhm": self.beam_fwhm}
        if self.focalplane_table is not None:
            return read_array(self.focalplane_table).plane(self.band.name, stated)
        pair = self._pair
        n = self.detectors
        pixels = n // pair
        layout = self._pixels(pixels)
        scale = math.tan(self.field_of_view / 2) / layout.reach if layout.reach > 0 else 0.0
        width = len(str(pixels - 1))
        stated["minimum_frequency"] = stated.pop("pink_minimum_frequency")
        axes = np.pi / 4 * (np.arange(pixels) % 2) if layout.angle is None else layout.angle
        angle = np.add.outer(axes, [0.0, np.pi / 2]).ravel() if pair == 2 else np.zeros(n)
        return Focalplane(
            names=[
                f"d{k:0{width}d}{side}"
                for k in range(pixels)
                for side in ("AB" if pair == 2 else ("",))
            ],
            xi=np.repeat(layout.x * scale, pair),
            eta=np.repeat(layout.y * scale, pair),
            polarization_angle=angle,
            polarization_efficiency=np.full(n, float(pair == 2)),
            wafer=np.repeat(layout.wafer, pair),
            dead=self._dead(n),
            **{key: np.full(n, value) for key, value in stated.items()},
        )

    def _dead(self, number: int) -> Integers:
        """1 for the detectors (number,) that give no data, by `yield`: the same in each run."""
        alive = max(1, round(number * getattr(self, "yield")))
        drawn = uniforms(stream_key(0, *self.identity, "yield"), 0, number)
        rank = drawn.argsort(kind="stable").argsort(kind="stable")
        return np.asarray(rank >= alive, np.int64)

    def plot(self, ax: Any = None) -> Any:
        """Draw the focal plane, and beside it the middle with beams and polarization angles; return
        the matplotlib Axes of all of it. ``ax``: axes for the former alone.
        """
        from .plots import draw_focal_plane, focal_plane_figure

        plane = self.focalplane()
        if ax is None:
            return focal_plane_figure(self, plane, notebook=True).axes[0]
        draw_focal_plane(ax, self, plane)
        return ax

    @property
    def notes(self) -> dict[str, str]:
        """Choices in reading the files that describe it, for the log and `zonda check`."""
        told = read_array(self.focalplane_table).notes if self.focalplane_table is not None else ()
        return {"focal plane": "; ".join(told)} if told else {}

    def _pixels(self, number: int) -> Layout:
        """Places and wafers of pixels."""
        if self.layout == "wafers":
            return Layout(*wafers(number, self.wafers))
        if self.layout in LATTICES:
            return Layout(*LATTICES[self.layout](number), np.zeros(number, np.int64))
        made: Layout = layouts.get(self.layout)(number)
        if not len(made.x) == len(made.y) == len(made.wafer) == number:
            raise InputError(
                f"the layout {self.layout} gives {len(made.x)} places for {number} pixels",
                place=self.name,
            )
        return made

    def _of_several_bands(self) -> Focalplane:
        planes = {name: camera.focalplane() for name, camera in self.cameras.items()}
        if self.focalplane_table is not None:
            return Focalplane.of_bands(planes, suffix=False)
        if self.pixels == "separate":
            radius = math.tan(self.field_of_view / 2)
            for plane, x, y in zip(planes.values(), *self._arrays[:2], strict=True):
                plane.xi, plane.eta = plane.xi + radius * x, plane.eta + radius * y
        return Focalplane.of_bands(planes)


def _completed(given: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
    """Add to the keys ``given`` for an instrument those that its table of detectors states: number,
    field, medians.
    """
    rest = {key: value for key, value in given.items() if value is not None}
    try:
        table = read_array(find(given["focalplane"], info))
    except (
        ZondaError,
        PydanticCustomError,
    ):  # which the field's own validation tells, at its place
        return STAND_INS | {"field_of_view": "0 deg"} | rest
    found: dict[str, Any] = {"field_of_view": f"{2 * math.atan(table.reach)!r} rad"}
    if isinstance(several := given.get("bands"), list) and several:
        rest["bands"] = [_band_with(table, band, rest) for band in several]
    else:
        band = given.get("band")
        name = band.get("name") if isinstance(band, dict) else getattr(band, "name", band)
        found |= stated_by(table, str(name), rest)
    return found | rest


def _band_with(table: ArrayTable, band: Any, rest: dict[str, Any]) -> Any:
    """A band as it is given, with what the table states of it."""
    if isinstance(band, CameraBand):
        band = band.model_dump(mode="json")
    own = {"name": band} if isinstance(band, str) else band
    if not isinstance(own, dict) or "name" not in own:
        return band
    own = {key: value for key, value in own.items() if value is not None}
    return stated_by(table, str(own["name"]), rest | own) | own
