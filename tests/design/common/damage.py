"""Files whose bytes change or go: whatever reads them refuses them in one line, or reads them."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from hypothesis import strategies as st

from padforge.design import InputError

T = TypeVar("T")

damages = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.binary(max_size=8), st.sampled_from([0, 1, 16, 10**9])),
    min_size=1,
    max_size=3,
)
"""Where in a file something happens, what is put there, and how many bytes go."""


def read_damaged(
    path: Path, content: bytes, damage: list[tuple[float, bytes, int]], read: Callable[[Path], T]
) -> T | None:
    """What is read of a damaged file, None where it is refused in one line that names it."""
    for share, piece, gone in damage:
        at = int(share * len(content))
        content = content[:at] + piece + content[at + gone :]
    path.write_bytes(content)
    try:
        return read(path)
    except InputError as error:
        message = str(error)
    assert path.name in message
    assert len(message) < 1000
    return None
