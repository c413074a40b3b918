"""Variants: a pipeline with its scene, or a pipeline file with changed values; and their runs."""

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
from typing import Any

from ..accuracy.metrics import Metric
from ..configuration.input_paths import paths_in
from ..configuration.pipeline_file import PipelineFile
from ..data import Data
from ..operator import Operator
from ..output import Output
from ..pipeline import Part, Pipeline
from ..scene import Scene


@dataclass(frozen=True, eq=False)
class Variant:
    """A pipeline, and the scene that it observes.

    Attributes
    ----------
    name
        Shown for it; the pipeline's own name where it is empty.
    keep
        Streams that metrics read, as for `Pipeline.run`.
    """

    pipeline: Pipeline
    scene: Scene
    name: str = ""
    keep: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.name or self.pipeline.name

    @property
    def variant(self) -> Variant:
        """The variant itself: both kinds have this attribute."""
        return self

    def steps(self, metrics: Sequence[Metric]) -> list[Operator]:
        """The steps without outputs, except those whose products the metrics read."""
        read = frozenset[str]().union(*(metric.reads for metric in metrics))
        whole = any(metric.needs_end for metric in metrics)
        every = self.pipeline.operators
        return [o for o in every if whole or not isinstance(o, Output) or o.provides & read]

    def run(
        self,
        metrics: Sequence[Metric] = (),
        *,
        seed: int | None = None,
        operators: Sequence[Operator] | None = None,
        output: Path | None = None,
        part: Part | None = None,
        **how: Any,
    ) -> Data:
        """Run it with the steps and signals that metrics need beside its own.

        Parameters
        ----------
        seed
            That of the scene; None: the variant's.
        operators
            Steps in place of the pipeline's; None: `steps` for the metrics.
        output
            Folder of products; None: one that is gone afterwards.
        part
            Some of the scans, whose products stay unfinished: `Pipeline.run_part`.
        how
            Further arguments of `Pipeline.run`.
        """
        whole = self.pipeline
        scene = self.scene
        steps = list(self.steps(metrics) if operators is None else operators)
        runs = whole.asked
        for number, metric in enumerate(metrics):
            steps = metric.steps(steps)
            for name, signal in metric.signals(whole.asked).items():
                runs = {**runs, (name if name not in runs else f"{name}_{number}"): signal}
        about = {"name": whole.name, "description": whole.description}
        pipeline = Pipeline(steps, runs=runs, only=whole.only, precision=whole.precision, **about)
        if seed is not None:
            scene = scene.model_copy(update={"seed": seed})
        folder = nullcontext(output) if output else tempfile.TemporaryDirectory(prefix="zonda-run-")
        with folder as place:
            if part is not None:
                return pipeline.run_part(scene, part, output=place, **how)
            return pipeline.run(scene, output=place, keep=self.keep, **how)


@dataclass(frozen=True)
class FileVariant:
    """A pipeline file with changed values; it is read where it is needed, also in workers.

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
        return FileVariant, (self.pipeline, self.overrides, self.text)

    def changed(self, overrides: Sequence[str]) -> FileVariant:
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

    @property
    def variant(self) -> Variant:
        """Pipeline and scene of the file."""
        return Variant(self.file.pipeline(), self.file.scene(), str(self))

    @cached_property
    def key(self) -> str:
        """Hash of all that its values depend on: every parameter, input files, and the sources of
        zonda and of the plugins whose steps it has.
        """
        from ..machine import code_hash

        found = hashlib.blake2b(code_hash().encode(), digest_size=12)
        found.update(self.file.resolved_yaml().encode())
        for module in sorted({type(o).__module__ for o in self.file.operators}):
            with suppress(OSError, AttributeError, TypeError):
                stat = os.stat(str(sys.modules[module].__file__))
                found.update(f"{module} {stat.st_mtime_ns} {stat.st_size}\n".encode())
        for path in paths_in([self.file.scene(), *self.file.operators]):
            found.update(path.read_bytes() if path.is_file() else b"")
        return found.hexdigest()

    def run(self, metrics: Sequence[Metric] = (), **how: Any) -> Data:
        """Run the variant; the arguments are those of `Variant.run`."""
        return self.variant.run(metrics, **how)
