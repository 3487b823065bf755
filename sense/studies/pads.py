"""Which pads a study looks at: files of morphologies, and pads that need no file."""

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from design.errors import InputError
from design.morphology import Morphology

NAMED = re.compile(r"(square|optimised|random-([1-9]\d?))(?:@([1-9]\d{0,2}))?")
"""Straight fibres, random ones of N knots, and what a short search finds; their grid after an @."""
GRID = 4


def load_pads(names: tuple[str, ...], seed: int) -> dict[str, Morphology]:
    """Pads by the label that tables and figures give them, in order.

    Args:
        names: files, `square`, `random-N` or `optimised` (`square@8`: with a grid of 8). seed: of the last two.

    Raises:
        InputError: no such file or name, a file that is no morphology, or a name given twice.
    """
    pads: dict[str, Morphology] = {}
    for name in names:
        label, pad = _load(name, seed)
        if label in pads:
            raise InputError(f"{name}: a pad called {label} is there already, expected each once")
        pads[label] = pad
    return pads


def _load(name: str, seed: int) -> tuple[str, Morphology]:
    named = NAMED.fullmatch(name)
    if named and not Path(name).exists():
        grid = int(named[3] or GRID)
        if named[2]:
            return name, Morphology.random(grid, int(named[2]), seed)
        return name, _optimised(grid, seed) if named[1] == "optimised" else Morphology.straight(grid)
    if not Path(name).exists():
        raise InputError(f"{name}: no such file, and none of square, optimised, random-N (N from 1 to 99)")
    path = Path(name)
    label = path.parent.name if path.name == "morphology.json" and path.parent.name else path.stem
    return label, Morphology.load(path)


def _optimised(grid: int, seed: int) -> Morphology:
    """What the default search finds from a single start, under the default rules."""
    from design.search import search
    from design.settings import Contact, Pad, Rules, Search

    return search(Pad(grid=grid), Contact(), Search(starts=1, seed=seed), Rules()).morphology


def described(pads: Mapping[str, Morphology]) -> dict[str, Any]:
    """What the settings say of each pad."""
    return {
        label: {
            "grid": pad.grid,
            "pitch_mm": pad.pitch_mm,
            "knots_sha256": hashlib.sha256(pad.knots.tobytes()).hexdigest(),
        }
        for label, pad in pads.items()
    }
