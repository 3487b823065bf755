"""Which pads a study looks at: files of morphologies, and pads that need no file."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from padforge.design.common.settings import validate
from padforge.design.common.validation import InputError
from padforge.design.morphology import Morphology

if TYPE_CHECKING:
    from padforge.sense.recordings.recording import Recording

NAMED = re.compile(r"(square|(optimised)|(random|optimised|genetic)-([1-9]\d?))(?:@([1-9]\d{0,2}))?")
"""Straight fibres, random ones of N knots, and what a search finds: by gradients, or as published; their grid after an
@."""
GRID = 4


def load_pads(names: Sequence[str], seed: int) -> dict[str, Morphology]:
    """Pads by the label that tables and figures give them, in order.

    Args:
        names: files, `square`, `random-N`, `optimised`, `optimised-N` or `genetic-N` (`square@8`: with a grid of 8).
        seed: of all but the first two.

    Raises:
        InputError: no such file or name, a file that is no morphology, or a name given twice.
    """
    return _labelled([(name, *_load(name, seed)) for name in names])


def load_recordings(names: Sequence[str]) -> "dict[str, Recording]":
    """Recordings by label, as `open_recording` reads them; raises InputError as it does, and for a label met twice."""
    from padforge.sense.recordings.import_export import open_recording

    def label(path: Path) -> str:
        return path.resolve().parent.name if path.name == "recording" else path.stem

    return _labelled([(name, label(Path(name)), open_recording(name)) for name in names])


def _labelled(parts: list[tuple[str, str, Any]]) -> dict[str, Any]:
    """Things by label, from what the user called them, their labels and themselves."""
    found: dict[str, Any] = {}
    for name, label, thing in parts:
        # Names of files may hold what no page or table can; matplotlib typesets what is between $ as mathematics, and
        # leaves labels with a _ in front out of its legends; a spreadsheet works out what begins with = + - or @.
        printable = label.encode("utf-8", "backslashreplace").decode().replace("$", "")
        label = " ".join(printable.split()).lstrip("_=+-@ ") or "pad"
        if label in found:
            raise InputError(f"{name}: one called {label} is there already, expected each once")
        found[label] = thing
    return found


def _load(name: str, seed: int) -> tuple[str, Morphology]:
    named = NAMED.fullmatch(name)
    if named and not Path(name).exists():
        grid, method, knots = int(named[5] or GRID), named[2] or named[3], int(named[4]) if named[4] else None
        if method is None:
            return name, Morphology.straight(grid)
        if method == "random":
            return name, Morphology.random(grid, knots or 0, seed)
        return name, _found(grid, "genetic" if method == "genetic" else "descent", knots, seed)
    if not Path(name).exists():
        raise InputError(
            f"{name}: no such file, and none of square, optimised, random-N, optimised-N, genetic-N (N from 1 to 99 "
            "knots; 64 where they are searched for)"
        )
    path = Path(name)
    label = path.parent.name if path.name == "morphology.json" and path.parent.name else path.stem
    return label, Morphology.load(path)


def _found(grid: int, method: Literal["descent", "genetic"], knots: int | None, seed: int) -> Morphology:
    """What a search finds for the published contact: by gradients from a single start, under the default rules; or as
    published, where rules count for nothing. So many knots, or the default."""
    from padforge.design.optimize.search import search
    from padforge.design.settings import PUBLISHED_CONTACT, PUBLISHED_PAD, PUBLISHED_SEARCH, SearchSettings

    pad = PUBLISHED_PAD.model_copy(update={"grid": grid})
    asked = {"starts": 1, "seed": seed, "method": method} | ({} if knots is None else {"knots": knots})
    settings = validate(SearchSettings, PUBLISHED_SEARCH.model_dump() | asked, f"{method} search")
    return search(pad, PUBLISHED_CONTACT, settings).morphology


def described(pads: Mapping[str, Morphology]) -> dict[str, Any]:
    """What the settings say of each pad."""
    return {
        label: {
            **({"grid": pad.grid} if pad.layout.is_square else {"fibres": list(pad.layout.counts)}),
            "pitch_mm": pad.pitch_mm,
            "knots_sha256": hashlib.sha256(pad.knots.tobytes()).hexdigest(),
        }
        for label, pad in pads.items()
    }
