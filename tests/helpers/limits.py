from collections.abc import Iterable
from typing import Any

import pytest

from padforge import InputError, Spec
from padforge.common.settings import Settings


def require_ends(model: type[Settings], key: str, kept: Iterable[Any], refused: Iterable[Any]) -> None:
    """See that a key of a section takes the values `kept`, and that each of those `refused` is named."""
    name = model.section()
    for value in kept:
        Spec({name: {key: value}}).section(model)
    for value in refused:
        with pytest.raises(InputError, match=rf"\[{name}\] {key}"):
            Spec({name: {key: value}}).section(model)
