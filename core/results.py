"""Access to products and kept streams by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .configuration.diagnostics import nearest
from .errors import InputError
from .observation import Observation

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


def kept(observation: Observation, stream: str, rows: slice = slice(None)) -> NDArray[np.float64]:
    """These detectors of a kept stream, with the mean that belongs to it. Raises InputError where
    it was not kept.
    """
    if stream not in observation.detdata:
        have = sorted(observation.detdata)
        what = f"only {' and '.join(have)}" if have else "no stream was"
        cure = (
            f"run it again with pipeline.run(scene, keep={[*have, stream]!r}): 8 bytes for each"
            " sample of each stream"
        )
        raise InputError(
            f"the stream {stream!r} was not kept, {what}", place=observation.name, cure=cure
        )
    found = np.asarray(observation.detdata[stream][rows], np.float64)
    if stream == EMISSION and EMISSION in observation.smooth:
        first, stop, _ = rows.indices(observation.n_detectors)
        return (
            observation.smooth[EMISSION].evaluate(
                slice(first, stop), slice(0, observation.n_samples)
            )
            + found
        )
    return found
