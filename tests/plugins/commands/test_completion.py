"""Completion in the shell: scripts that a shell accepts, and names."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

from zonda.core import cli

RUN = "from zonda.core.cli import main; import sys; sys.exit(main())"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_is_one_of_the_shell(shell, capsys, tmp_path):
    assert cli.main(["completion", shell]) == 0
    text = capsys.readouterr().out
    assert f"_ZONDA_COMPLETE={shell}_complete" in text
    assert f"zonda completion {shell}" in text.splitlines()[0]
    if shutil.which(shell):
        path = tmp_path / "script"
        path.write_text(text)
        subprocess.run([shell, "-n", str(path)], check=True)


def test_other_shells_are_refused(capsys):
    assert cli.main(["completion", "tcsh"]) == 2
    assert "'tcsh' is not one of 'bash', 'zsh', 'fish'" in capsys.readouterr().err


def completed(words: str, folder=None, code: str = RUN) -> list[str]:
    """What bash would offer behind ``zonda ...``, the last word unfinished."""
    parts = words.split(" ")
    environment = {
        **os.environ,
        "_ZONDA_COMPLETE": "bash_complete",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(parts) - 1),
    }
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=folder
    )
    assert done.stderr == ""
    return [
        line.partition(",")[2] for line in done.stdout.splitlines() if line.startswith("plain,")
    ]


def test_instruments_are_completed_for_show():
    assert completed("zonda show instrument act_pa") == ["act_pa4", "act_pa5", "act_pa6"]


def test_names_are_completed(tmp_path):
    (tmp_path / "mine.yaml").write_text("")
    (tmp_path / "music").mkdir()
    (tmp_path / "music" / "deep.yml").write_text("")
    (tmp_path / "more.fits").write_text("")
    assert completed("zonda compl", tmp_path) == ["completion"]
    assert set(completed("zonda run m", tmp_path)) == {"mine.yaml", "music/", "mustang2_cluster"}
    assert completed("zonda check music/", tmp_path) == ["music/deep.yml"]
    assert completed("zonda run nowhere/x", tmp_path) == []
    assert completed("zonda new pipeline --instrument mus", tmp_path) == ["mustang2"]
    assert completed("zonda new pipeline --site green", tmp_path) == ["green_bank"]
    assert completed("zonda weather green", tmp_path) == ["green_bank"]
    assert completed("zonda weather fe", tmp_path) == ["fetch"]
    assert completed("zonda weather fetch green", tmp_path) == ["green_bank"]
    assert completed("zonda weather green_bank --instrument mus", tmp_path) == ["mustang2"]
    assert completed("zonda when mars --site green", tmp_path) == ["green_bank"]
    assert completed("zonda sensitivity --instrument mus", tmp_path) == ["mustang2"]
    assert "--no-prune" in completed("zonda run --no", tmp_path)


def test_completion_imports_nothing_heavy(tmp_path):
    heavy = ["numpy", "astropy", "numba", "scipy", "matplotlib", "pydantic"]
    code = (
        "import sys, atexit\n"
        f"atexit.register(lambda: print('heavy', [m for m in {heavy} if m in sys.modules]))\n"
        + RUN.replace("; ", "\n")
    )
    parts = "zonda new pipeline --instrument mus"
    environment = {
        **os.environ,
        "_ZONDA_COMPLETE": "bash_complete",
        "COMP_WORDS": parts,
        "COMP_CWORD": "4",
    }
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stdout.splitlines() == ["plain,mustang2", "heavy []"]
