"""For all tests: nothing is read from or left in the user's cache folder (compiled kernels aside)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session", autouse=True)
def own_user_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ZONDA_CACHE_DIR", str(tmp_path_factory.mktemp("user-cache")))
        yield
