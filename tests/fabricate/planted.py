"""Pads and settings with a known shape or a known fault."""

from dataclasses import replace

import numpy as np

from design.pad.knots import assemble
from design.pad.morphology import Morphology
from design.settings import Pad, Rules
from fabricate.settings import DEFAULTS, Mould, Printer, Settings


def level_pad(first: float, second: float, pitch_mm: float = 10.0) -> Morphology:
    """A pad of 2 x 2 whose horizontals run level at y = `first` and `second` (grid units) from x = 1 to 2."""
    inner = np.empty((4, 2, 2))
    inner[:2, :, 0] = (1, 2)
    inner[:2, :, 1] = [[first], [second]]
    inner[2:, :, 0] = [[1], [2]]
    inner[2:, :, 1] = (1, 2)
    return Morphology(assemble(inner), pitch_mm)


def with_settings(
    mould: dict[str, object] | None = None,
    printer: dict[str, object] | None = None,
    pad: dict[str, object] | None = None,
    rules: dict[str, object] | None = None,
) -> Settings:
    """The defaults with some keys changed."""
    return replace(
        DEFAULTS,
        mould=Mould.model_validate(mould or {}),
        printer=Printer.model_validate(printer or {}),
        pad=Pad.model_validate(pad or {}),
        rules=Rules.model_validate(rules or {}),
    )
