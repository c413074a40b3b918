"""A real third-party distribution, installed from its folder, is found by its entry points and used
by a pipeline.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.scenes import installed_plugin

HERE = Path(__file__).parent
EXAMPLE = HERE / "plugin_example"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """An environment in which the plugin is installed (into a folder of its own, so that other
    tests do not see it).
    """
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    subprocess.run(
        ["cp", "-r", str(EXAMPLE), str(source)], check=True
    )  # building writes into the source folder
    return installed_plugin(source / "plugin_example", target)


def zonda(environment, *arguments, cwd=None):
    return subprocess.run(
        [sys.executable, "-m", "zonda", *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        cwd=cwd,
    )


def test_listed_and_importable(installed):
    done = zonda(installed, "plugins", "--check")
    assert done.returncode == 0, done.stderr
    for name in ("example_camera", "example_peak", "example_rings", "ReadoutLag"):
        (line,) = [x for x in done.stdout.splitlines() if name in x.split()]
        assert "zonda-example" in line


def test_a_pipeline_uses_it(installed, tmp_path):
    done = zonda(
        installed,
        "run",
        EXAMPLE / "pipelines" / "example.yaml",
        "--output",
        tmp_path / "out",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "out").glob("*.fits"))


def test_its_operator_keeps_the_contract(installed):
    code = (
        "import zonda.testing; from zonda_example.readout_lag import ReadoutLag; "
        "zonda.testing.check_operator(ReadoutLag(tau='50 ms'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=installed, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_absent_plugin_is_named(tmp_path):
    done = zonda(
        {**os.environ, "ZONDA_PLUGINS": ""}, "check", EXAMPLE / "pipelines" / "example.yaml"
    )
    assert done.returncode == 2
    assert "zonda-example" in done.stderr
    assert "example_camera" in done.stderr
    assert "Traceback" not in done.stderr
