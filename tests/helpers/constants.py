"""Constants of modules that have other values in the tests of a file: smaller ones, mostly, which take less time."""

from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import Any

import pytest


def with_constants(*changes: tuple[ModuleType, Mapping[str, Any]]) -> Any:
    """Return a fixture under which all tests of a file see modules with these constants, as said by their names."""

    @pytest.fixture(autouse=True, scope="module")
    def changed() -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patched:
            for module, values in changes:
                for name, value in values.items():
                    patched.setattr(module, name, value)
            yield

    return changed
