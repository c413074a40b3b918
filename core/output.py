"""Outputs: what shows or compares products once all of them are there (reports, plots, transfer
functions).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import PrivateAttr

from .errors import OutputError
from .operator import Operator
from .signal import Signal
from .storage.files import check_output_folder, product_path

if TYPE_CHECKING:
    from pathlib import Path

    from .data import Data, Observation
    from .storage.table_files import Column

Progress = Literal["pointing", "scan", "maps"]


class Output(Operator):
    """A step that acts in `finalize` alone, once, after all signals of all scans are mapped.

    Its `observe` is called before that of all other steps: what it refuses (an output folder) is
    refused at once.
    """

    one_band: ClassVar[bool] = False
    """It makes products of those of one band: of a camera with several bands it acts once for each,
    on that band's data (`Data.band`). Others act once, on all that there is; products there bear
    the band's name (``map_f090``)."""

    _shown: tuple[str, ...] = PrivateAttr(())

    def signals(self) -> tuple[Signal, ...]:
        """The signals whose products this step reads; empty: whatever signals there are.

        The pipeline adds one where none of the user's is like it. The products of such a signal are
        for this step alone: no other writes or draws them.
        """
        return ()

    def named_signals(self) -> tuple[str, ...]:
        """Names of signals of the pipeline that its parameters name; a name that `runs` does not
        have is refused.
        """
        return ()

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of what `signals` asks for, in its order; empty text: the complete signal."""
        return self._shown

    def reads(self, signal: str) -> bool:
        """True if it reads products of the signal of that name (empty: the complete one)."""
        return signal in self.shown if self.signals() or signal.startswith("_") else True

    def watch(self, data: Data, done: Progress) -> None:
        """Called once the telescope is pointed, after every scan, and when all maps are made: time
        to begin, in the background, with what `finalize` will do, as far as it depends on products
        that will not change."""


class StreamOutput(Operator):
    """A step that writes what its blocks hold, scan by scan: an output that acts before the end."""


def is_output(operator: Operator) -> bool:
    """True if a step says that it is an output: a run is there for what it reads."""
    return isinstance(operator, (Output, StreamOutput))


def changes_observations(operator: Operator) -> bool:
    """True if a step does nothing but change observations (a plate's angles): it provides nothing,
    and neither works on their data nor writes.
    """
    works = any(
        getattr(type(operator), step) is not getattr(Operator, step)
        for step in ("exec", "measure", "collect", "finalize")
    )
    return not operator.provides and not works and not is_output(operator)


def may_write(operator: Operator) -> bool:
    """True if a step may leave a file: an output, or one that works on the data and provides
    nothing of it.
    """
    return is_output(operator) or not (operator.provides or changes_observations(operator))


def output_folder(of: Data | Observation, place: str) -> Path:
    """The output folder of a run, which is there and can be written to; raises `OutputError` where
    it is not.
    """
    if of.output is None:
        raise OutputError(
            "there is no output folder",
            place=place,
            cure="give one: zonda run --output FOLDER, or run(scene, output=...)",
        )
    return check_output_folder(of.output)


def about(data: Data, **more: Any) -> dict[str, Any]:
    """Provenance of a table: pipeline, seed, version, and ``more``; without what is empty."""
    known = data.provenance
    meta = {
        "PIPELINE": known.get("name"),
        "SEED": data.scene.seed,
        "ZONDA": known.get("versions", {}).get("zonda"),
        **more,
    }
    return {key: value for key, value in meta.items() if value not in ("", None)}


def publish(
    data: Data, key: str, product: Any, tables: Mapping[str, Sequence[Column]], **more: Any
) -> None:
    """Make a product, and where there is an output folder write its ``tables``, by what stands
    behind its name; ``more``: beside their provenance.
    """
    data.products[key] = product
    for behind, columns in tables.items() if data.output is not None else ():
        from .storage.table_files import write_ecsv

        path = product_path(data.output, data.named(f"{key}{behind}"), ".ecsv")
        write_ecsv(path, columns, about(data, **more))
