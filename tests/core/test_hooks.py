from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from zonda.core.discovery import PluginWarning
from zonda.core.errors import ZondaError
from zonda.core.hooks import Hooks, manager
from zonda.plugins.progress import Progress, line

Plugin = Callable[..., Path]
IMPL = (
    "from zonda.core.hooks import hookimpl\nseen = []\n@hookimpl\ndef {hook}({arguments}):\n   "
    " {body}\n"
)


def hook(
    plugin: Plugin,
    name: str,
    module: str,
    hook: str = "zonda_pipeline_start",
    arguments: str = "pipeline",
    body: str = "pass",
) -> None:
    source = IMPL.format(hook=hook, arguments=arguments, body=body)
    plugin(name, "1.0", {"zonda.hooks": {"same": module}}, **{module: source})


def test_every_plugin_is_called_with_what_it_asks_for(plugin: Plugin) -> None:
    hook(
        plugin, "z-one", "zh_one", arguments="data, pipeline", body="data.append(('one', pipeline))"
    )
    hook(
        plugin, "z-two", "zh_two", arguments="data", body="data.append('two')"
    )  # same entry-point name, other distribution
    data: list[Any] = []
    manager().hook.zonda_pipeline_start(pipeline="p", data=data)
    assert sorted(data, key=str) == [("one", "p"), "two"]
    assert manager() is manager()


def test_a_broken_plugin_is_left_out_by_name(plugin: Plugin) -> None:
    plugin(
        "z-broken",
        "1.0",
        {"zonda.hooks": {"x": "zh_broken"}},
        zh_broken="import not_there_at_all\n",
    )
    hook(plugin, "z-arguments", "zh_arguments", arguments="pipeline, wind")
    hook(plugin, "z-good", "zh_good", arguments="data", body="data.append('good')")
    with pytest.warns(PluginWarning) as caught:
        plugins = manager()
    text = "\n".join(str(w.message) for w in caught)
    assert (
        "plugin z-broken 1.0 (zh_broken): left out: ModuleNotFoundError: No module named"
        " 'not_there_at_all'" in text
    )
    assert "z-arguments 1.0" in text
    assert "wind" in text
    data: list[str] = []
    plugins.hook.zonda_pipeline_start(pipeline=None, data=data)
    assert data == ["good"]


def test_a_misspelt_hook_is_a_warning(plugin: Plugin) -> None:
    hook(plugin, "z-typo", "zh_typo", hook="zonda_pipline_start")
    with pytest.warns(
        PluginWarning,
        match=(
            r"plugin z-typo 1.0 .*no hook 'zonda_pipline_start'; did you mean"
            r" 'zonda_pipeline_start'\?"
        ),
    ):
        manager()


def test_a_forgotten_decorator_is_a_warning(plugin: Plugin) -> None:
    plugin(
        "z-bare",
        "1.0",
        {"zonda.hooks": {"x": "zh_bare"}},
        zh_bare="def zonda_progress(done): ...\n",
    )
    with pytest.warns(PluginWarning, match="z-bare 1.0 .*'zonda_progress' is not called"):
        manager()


def test_a_hook_that_fails_is_reported_once_and_left_alone(plugin: Plugin) -> None:
    hook(
        plugin,
        "z-faint",
        "zh_faint",
        arguments="data",
        body="data.append('faint'); raise RuntimeError('dizzy')",
    )
    hook(plugin, "z-good", "zh_good", arguments="data", body="data.append('good')")
    data: list[str] = []
    with pytest.warns(
        PluginWarning,
        match="plugin z-faint 1.0 .*zonda_pipeline_start failed .*RuntimeError: dizzy",
    ):
        manager().hook.zonda_pipeline_start(pipeline=None, data=data)
    manager().hook.zonda_pipeline_start(pipeline=None, data=data)
    assert sorted(data) == ["faint", "good", "good"]


def test_a_hook_may_stop_the_run_with_a_message(plugin: Plugin) -> None:
    hook(
        plugin,
        "z-stop",
        "zh_stop",
        body="from zonda.core.errors import ZondaError; raise ZondaError('no')",
    )
    with pytest.raises(ZondaError, match="no"):
        manager().hook.zonda_pipeline_start(pipeline=None, data=None)


def test_allow_list(plugin: Plugin, monkeypatch: pytest.MonkeyPatch) -> None:
    hook(plugin, "z-one", "zh_one", arguments="data", body="data.append('one')")
    monkeypatch.setenv("ZONDA_PLUGINS", "")
    data: list[str] = []
    manager().hook.zonda_pipeline_start(pipeline=None, data=data)
    assert data == []


def test_every_hook_is_documented() -> None:
    assert all(getattr(Hooks, name).__doc__ for name in vars(Hooks) if name.startswith("zonda_"))


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_writes_to_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    for stream, expected in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr("sys.stderr", stream)
        progress = Progress()
        progress.zonda_progress(done=1, total=4, what="scan")
        progress.zonda_progress(done=4, total=4, what="scan")
        progress.zonda_pipeline_end(pipeline=None)
        text = stream.getvalue()
        assert ("scan [#####...............] 25 %" in text) is expected
        assert ("100 %" in text) is expected
        assert text.endswith("\r\033[K" if expected else "")


def test_progress_line() -> None:
    assert line(1, 2, "map", 10.0, width=4) == "map [##..] 50 %, 10 s left"
    assert line(0, 0, "map", 10.0, width=4) == "map [####] 100 %"
    assert line(0, 5, "map", 10.0, width=4) == "map [....] 0 %"
