"""For all tests: nothing is read from or left in the user's cache folder (compiled kernels aside);
what a test registers goes with it; hypothesis draws the same examples each time (`pytest
--hypothesis-profile=default` draws others)."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

from zonda.core.machine import cache_folder, one_blas_thread

# as `zonda` does, before numpy is imported: threads of BLAS would wait for each other
one_blas_thread()

from zonda.core.registry import registries

# kernels are compiled once, not in every session
os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder()))

# how quickly examples are made depends on what else the machine does
settings.register_profile(
    "the same each time",
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
    deadline=None,
)
settings.load_profile("the same each time")


@pytest.fixture(scope="session", autouse=True)
def own_user_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ZONDA_CACHE_DIR", str(tmp_path_factory.mktemp("user-cache")))
        yield


@pytest.fixture(autouse=True)
def nothing_stays_registered() -> Iterator[None]:
    before = [dict(each._session) for each in registries]
    yield
    for each, registered in zip(registries, before, strict=True):
        if each._session != registered:
            each._session = registered
            each.refresh()
