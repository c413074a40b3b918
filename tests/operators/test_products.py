"""What steps add up over scans."""

from __future__ import annotations

import os
import subprocess
import sys

from zonda.core.product import Product, Record
from zonda.core.registry import operators

CLASSES = """
import sys
from zonda.core.product import Product
from zonda.core.registry import operators
operators.get(sys.argv[1])
print(*Product.kinds)
"""


def test_the_module_of_a_step_imports_what_it_adds_up() -> None:
    """Processes of a campaign find the class so; one process has imported all modules."""
    for found in operators.candidates():
        if found.distribution == "zonda":
            operators.get(found.qualified)
    own = {name for name in Product.kinds if name.startswith("zonda.operators.")}
    assert {name.partition(":")[2] for name in own} >= {"MapSums", "Spectrum", "StreamComparison"}
    for step in ("BinMap", "PowerSpectrum", "CompareStreams", "SaveTOD", "SkyMap"):
        done = subprocess.run(
            [sys.executable, "-c", CLASSES, step], capture_output=True, text=True, env=os.environ
        )
        assert done.returncode == 0, done.stderr
        assert set(done.stdout.split()) & own, step


def test_a_class_registers_itself() -> None:
    class Sum(Record):
        """Nothing."""

    assert Product.kinds.pop(Sum.identity()) is Sum
