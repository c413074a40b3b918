"""A pipeline file with some of its values changed, and a run of it at a seed."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..configuration.files import paths_in

if TYPE_CHECKING:
    from ..accuracy.metrics import Metric
    from ..configuration.pipeline_file import PipelineFile
    from ..data import Data
    from ..operator import Operator


@dataclass(frozen=True)
class Variant:
    """A pipeline with changed values.

    Attributes
    ----------
    pipeline
        Path, or a shipped pipeline's name.
    overrides
        Changes as ``--set`` takes them.
    text
        YAML in place of a file's, whose name in messages is then ``pipeline``.
    """

    pipeline: str | Path
    overrides: tuple[str, ...] = ()
    text: str | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Leave the file that was read out of the pickle."""
        return Variant, (self.pipeline, self.overrides, self.text)

    def changed(self, overrides: Sequence[str]) -> Variant:
        """The variant with further changes."""
        return replace(self, overrides=(*self.overrides, *overrides))

    def __str__(self) -> str:
        return " ".join([Path(self.pipeline).stem, *self.overrides])

    @cached_property
    def file(self) -> PipelineFile:
        """The checked pipeline file. Raises `ConfigurationError`."""
        from ..configuration.pipeline_file import load, parse

        if self.text is None:
            return load(self.pipeline, self.overrides)
        return parse(self.text, name=str(self.pipeline), overrides=self.overrides)

    @cached_property
    def key(self) -> str:
        """Hash of all that its values depend on: every parameter, input files, and the sources of
        zonda and of the plugins whose steps it has.
        """
        from ..versions import fingerprint

        found = hashlib.blake2b(fingerprint().encode(), digest_size=12)
        found.update(self.file.resolved_yaml().encode())
        for module in sorted({type(o).__module__ for o in self.file.operators}):
            with suppress(OSError, AttributeError, TypeError):
                stat = os.stat(str(sys.modules[module].__file__))
                found.update(f"{module} {stat.st_mtime_ns} {stat.st_size}\n".encode())
        for path in paths_in([self.file.scene(), *self.file.operators]):
            found.update(path.read_bytes() if path.is_file() else b"")
        return found.hexdigest()

    def run(self, metrics: Sequence[Metric] = (), **how: Any) -> Data:
        """Run the variant; ``how`` are the arguments of `run_file`."""
        return run_file(self.file, metrics, **how)


def run_file(
    file: PipelineFile,
    metrics: Sequence[Metric] = (),
    *,
    seed: int | None = None,
    operators: Sequence[Operator] | None = None,
    threads: int | None = None,
    output: Path | None = None,
) -> Data:
    """Run a pipeline file with the steps and signals that metrics need beside its own.

    Parameters
    ----------
    seed
        That of the scene; None: the file's.
    operators
        Steps in place of the file's; None: `steps_for` the metrics.
    output
        Folder of products; None: one that is gone afterwards.
    """
    from ..pipeline import Pipeline

    steps, runs = list(steps_for(file, metrics) if operators is None else operators), file.runs
    for number, metric in enumerate(metrics):
        steps = metric.steps(steps)
        for name, signal in metric.signals(file.runs).items():
            runs = {**runs, (name if name not in runs else f"{name}_{number}"): signal}
    header, scene = file.header, file.scene()
    pipeline = Pipeline(
        steps, runs=runs, only=header.only, name=header.name, precision=header.precision
    )
    if seed is not None:
        scene = scene.model_copy(update={"seed": seed})
    folder = nullcontext(output) if output else tempfile.TemporaryDirectory(prefix="zonda-run-")
    with folder as place:
        return pipeline.run(scene, output=place, threads=threads)


def steps_for(file: PipelineFile, metrics: Sequence[Metric]) -> list[Operator]:
    """The steps of a file without what acts at its end, but for those whose products metrics
    read.
    """
    from ..output import Output

    read = frozenset[str]().union(*(getattr(metric, "reads", ()) for metric in metrics))
    whole = any(metric.needs_end for metric in metrics)
    return [o for o in file.operators if whole or not isinstance(o, Output) or o.provides & read]
