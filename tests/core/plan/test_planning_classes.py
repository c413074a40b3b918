"""How the planning of an operator is found."""

import subprocess
import sys

from zonda.core import registry
from zonda.core.plan.planning import planning_class


def test_every_planning_class_is_that_of_the_operator_of_its_name():
    """`Planning.of` may be a reference, which nothing imports."""
    shipped = {
        found.name for found in registry.planning.candidates() if found.distribution == "zonda"
    }
    assert {name for name in shipped if name not in registry.operators} <= {
        "Pointing",
        "FunctionOperator",
    }  # no operators
    for name in shipped:
        if name in registry.operators:
            assert planning_class(registry.operators.get(name)) is registry.planning.get(name), name


def test_the_planning_of_a_run_imports_no_operator_that_it_lacks():
    code = (
        "import sys, zonda\nfrom zonda.core.plan.planning import planning_class\nfor step in"
        " ('SkyMap', 'AtmosphereLayers', 'Efficiency', 'CommonModeFilter', 'HighpassFilter',"
        " 'Plots', 'Report'):\n    assert"
        " planning_class(zonda.core.registry.operators.get(step)).of\nprint(*sorted(m for m in"
        " sys.modules if m.startswith('zonda.operators.')))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    others = (
        "sky.cmb sky.pysm sky.point_sources atmosphere.screens optics.polarizers"
        " optics.ground_pickup filters.ground filters.polynomial"
        " diagnostics.compare_maps diagnostics.mode_spectrum"
    )
    assert "zonda.operators.sky.skymap" in loaded
    assert not {f"zonda.operators.{name}" for name in others.split()} & set(loaded)
