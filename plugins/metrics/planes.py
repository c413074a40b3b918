"""Metrics of maps of I, Q and U: each plane has its own error, and the largest counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from zonda.core.accuracy.metrics import Metric
from zonda.core.maps.planes import IQU


class OfPlanes(Metric):
    """Base of metrics whose `measure` finds something of each plane: by its name, ``I`` alone or
    ``I``, ``Q`` and ``U``.

    A subclass has `between` and `summary` of one plane, and `floor_of`; `counted`, where not all
    planes of a reference count.
    """

    def error(self, found: Mapping[str, Any], reference: Mapping[str, Any]) -> float:
        return max(self._each(found, reference).values())

    def errors(self, found: Mapping[str, Any], reference: Mapping[str, Any]) -> Mapping[str, float]:
        each = self._each(found, reference)
        return each if len(each) > 1 else {}

    def mean_error(self, found: Sequence[Any], reference: Sequence[Any]) -> tuple[float, float]:
        planes = [
            p
            for p in IQU
            if all(p in self.counted(one) for one in reference) and all(p in one for one in found)
        ]
        return max(
            super(OfPlanes, self).mean_error(
                [one[p] for one in found], [one[p] for one in reference]
            )
            for p in planes
        )

    def floor(self, reference: Mapping[str, Any]) -> float | None:
        """The lowest of all planes; None where one has none."""
        floors = [self.floor_of(reference[plane]) for plane in self.counted(reference)]
        known = [floor for floor in floors if floor is not None]
        return min(known) if len(known) == len(floors) else None

    def counted(self, reference: Mapping[str, Any]) -> Sequence[str]:
        """The planes of a reference in which errors are looked for."""
        return list(reference)

    def between(self, found: Any, reference: Any) -> float:
        """`error` of one plane."""
        raise NotImplementedError

    def floor_of(self, reference: Any) -> float | None:
        """`floor` of one plane."""
        raise NotImplementedError

    def _each(self, found: Mapping[str, Any], reference: Mapping[str, Any]) -> dict[str, float]:
        return {
            plane: self.between(found[plane], reference[plane])
            for plane in self.counted(reference)
            if plane in found
        }
