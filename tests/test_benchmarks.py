"""Benchmarks find the shipped map in an installed package, which has no folders beside it as this
tree has.
"""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import zonda

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"

LOOK = """
import runpy, sys
sys.path[:0] = {path!r}
import zonda
assert zonda.__file__.startswith({site!r}), zonda.__file__
found = runpy.run_path({script!r})
where = {expression}
assert str(where).startswith({site!r}), where
assert where.is_file(), where
"""

EXPRESSIONS = {
    "stages.py": 'found["pipeline_of"]("M2").operators[1].file',
    "memory.py": 'found["chain"]("10 s").operators[1].file',
    "peers/zonda_chain.py": 'found["CLUSTER"]',
}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The package alone, as a wheel unpacks it."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(
        Path(zonda.__file__).parent, folder / "zonda", ignore=shutil.ignore_patterns("__pycache__")
    )
    return folder


@pytest.mark.skipif(not BENCHMARKS.is_dir(), reason="benchmarks are not in this copy")
@pytest.mark.parametrize("name", EXPRESSIONS)
def test_the_shipped_map_is_found(site, name):
    script = BENCHMARKS / name
    path = [str(site), str(script.parent), *sys.path]
    text = LOOK.format(path=path, site=str(site), script=str(script), expression=EXPRESSIONS[name])
    done = subprocess.run([sys.executable, "-P", "-c", text], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
