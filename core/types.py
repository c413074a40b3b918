"""Array types."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
AnyFloats = NDArray[np.floating[Any]]
"""float32 or float64."""
Bools = NDArray[np.bool_]
"""bool."""
Integers = NDArray[np.int64]
"""int64."""
Indices = NDArray[np.intp]
"""intp: numbers of rows, detectors or samples."""
