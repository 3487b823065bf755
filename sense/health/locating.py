"""Places found, as CSV, and depths and forces where they were learnt: one line a press, with how sure it is."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.files import reraise_write_error, write_text
from padforge.design.common.validation import InputError, check_type, short_repr
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.localizer.localizer import Found, Localizer
from padforge.sense.recording.recording import Recording

COLUMNS = ("press", "x_mm", "y_mm", "sd_x_mm", "sd_y_mm", "r50_mm", "r90_mm")
"""Press, counted from 0; place from the pad's centre; standard deviations; radii that hold 50 % and 90 % of presses.
Where they were learnt, `MEASURED` follow: depth, force, and how far beside them 90 % of presses are at most."""
MEASURED = {"depth_mm": ("depth_mm", "depth_r90_mm"), "force_n": ("force_n", "force_r90_n")}


def write_places(found: Found, path: str | Path) -> None:
    """Write what was found for Q presses as CSV with the columns `COLUMNS` and `MEASURED`, atomically.

    Raises:
        InputError: `path` cannot be written.
    """
    more = [column for each in found.measures.values() for column in (each.values, each.r90)]
    table = np.column_stack([found.places_mm, found.sd_mm, found.r50_mm, found.r90_mm, *more])
    names = (*COLUMNS, *(name for measure in found.measures for name in MEASURED[measure]))
    lines = [",".join([str(press), *(f"{value:.4f}" for value in row)]) for press, row in enumerate(table.tolist())]
    with reraise_write_error(Path(path)):
        write_text(Path(path), "\n".join([",".join(names), *lines]) + "\n")


def locate(
    localizer: Localizer, recording: Recording, lost: ArrayLike = (), findings: Sequence[FibreFault] = ()
) -> Found:
    """Find the place of every press of `recording`, without the fibres `lost`, by index.

    Args:
        findings: of `monitor.examine`; a fibre found at fault is left out from the press on since which it is.

    Raises:
        InputError: as `Localizer.inputs` and `Localizer.locate`, or findings of a pad with more fibres.
    """
    presses = check_type("localizer", localizer, Localizer).inputs(recording)
    alive = presses.alive.copy()
    if not isinstance(findings, Sequence):
        raise InputError(f"findings are {short_repr(findings)}, expected a sequence of them")
    for finding in findings:
        fibres = list(check_type("findings", finding, FibreFault).fibres)
        if max(fibres, default=0) >= localizer.fibres:
            raise InputError(f"findings name fibre {max(fibres) + 1}, allowed are 1 to {localizer.fibres}")
        alive[finding.since :, fibres] = False
    return localizer.locate(replace(presses, alive=alive), lost)
