"""What happens to files: bytes that change or go, values that are replaced; and the pad of which they are."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from design.settings import PadSettings, RulesSettings, SearchSettings

SEARCH = SearchSettings(knots=1, starts=1, steps=30, lost=1, population=4, generations=4)
PAD, RULES = PadSettings(grid=1), RulesSettings(enforce=False)


def published(fibres: int) -> dict[str, Any]:
    """Variables as the published files have them: a morphology, settings, presses and their signals."""
    rng = np.random.default_rng(0)
    settings = {"object_size": 0.6, "str_shp": 30.0, "fineness": 200.0}
    knots = np.sort(rng.uniform(0.1, fibres / 2 + 0.9, (3, 4 * fibres // 2)), axis=0)
    return {"para": knots, "K": settings, "loc_all": rng.uniform(1, 2, (9, 2)), "sens_raw_all": rng.random((9, fibres))}


@st.composite
def damages(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """A few things that happen to files: bytes that change or go, an end that is missing, what does not belong."""
    steps = draw(
        st.lists(
            st.tuples(st.integers(0, 5), st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=8)),
            min_size=1,
            max_size=4,
        )
    )

    def damaged(content: bytes) -> bytes:
        found = bytearray(content)
        for kind, share, piece in steps:
            at = int(share * len(found))
            match kind:
                case 0:
                    found[at : at + 1] = piece[:1]
                case 1:
                    found[at : at + len(piece)] = piece
                case 2:
                    del found[at:]
                case 3:
                    found[at : at + 64] = bytes(64)
                case 4:
                    found[at:at] = piece
                case 5:
                    del found[at : at + 16]
        return bytes(found)

    return damaged


JUNK = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.integers(-(10**400), 10**400),
        st.floats(),
        st.text(max_size=8),
        st.sampled_from(["nan", "1e999", "\ud800", "x" * 5000, 10**4000, -1, 0]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=4)),
    max_leaves=8,
)
"""Whatever JSON can hold, and a little more."""


@st.composite
def replacements(draw: st.DrawFn) -> Callable[[Any], Any]:
    """Something else in the place of a few values of a document, wherever they lie, or nothing there."""
    steps = draw(st.lists(st.tuples(st.integers(0, 10**6), st.booleans(), JUNK), min_size=1, max_size=3))

    def replaced(document: Any) -> Any:
        document = json.loads(json.dumps(document))
        for number, gone, junk in steps:
            places = list(_places(document))
            if places:
                holder, key = places[number % len(places)]
                if gone:
                    del holder[key]
                else:
                    holder[key] = junk
        return document

    return replaced


def _places(value: Any) -> Any:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


def dump(path: Path, document: Any) -> None:
    path.write_text(json.dumps(document), encoding="utf-8", errors="surrogatepass")


ARRAYS = st.one_of(
    st.sampled_from(
        [np.zeros((0, 0)), np.zeros((0, 4)), np.zeros((3, 3)), np.zeros((1, 4)), np.array([[1j, 2, 3, 4]])]
    ),
    st.sampled_from(
        [np.array(["text"]), np.array([[1]], dtype=np.uint8), np.full((2, 8), np.nan), np.full((2, 8), 1e308)]
    ),
    st.sampled_from([np.array([["a", 1.0]], dtype=object), np.ones((2, 2, 8)), {}, {"a": {}}, np.array([[True] * 4])]),
    st.floats(),
    st.text("abc", max_size=5),
)
