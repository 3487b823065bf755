"""The run directory of a recording by hand: a new one, or one to go on with."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from padforge.design.common.files import provenance
from padforge.design.common.validation import InputError
from padforge.sense.recordings.press_journal import read_journal
from padforge.sense.recordings.processing.limits import MAX_MM, Array, as_numbers, refuse_beyond
from padforge.sense.recordings.recorder import JOURNAL, START, Recorder
from padforge.sense.rig.planning.setup import Setup, begun_source, require_same_devices, source_of

from padforge.sense.live.by_hand.targets import still_to_make, targets_of

KIND = "hand"
"""Of the source of such a recording: nobody knows how deep its presses were."""


def opened(setup: Setup, converter: Mapping[str, Any], resume: bool) -> tuple[Recorder, Array, Array]:
    """The recorder, the places (Q, 2) mm of its plan, and those (P, 2) that are still to be pressed.

    Args:
        converter: what it says of itself. resume: go on with what is in `setup.out`, if anything is.

    Raises:
        InputError: places that cannot be, another recording in the way, or one that was begun otherwise.
    """
    board = {"board": converter}
    if resume and (setup.out / START).exists():
        source = begun_source(setup, setup.rig, KIND)
        targets = _kept_targets(setup, source)
        require_same_devices(setup.out, source, board)
        recorder = Recorder.resume(setup.out)
        made = [press[:2] for press in read_journal(setup.out / JOURNAL).values()]
        return recorder, targets, still_to_make(targets, np.array(made).reshape(-1, 2))
    targets = targets_of(setup)
    plan = {"columns": ["x_mm", "y_mm"], "presses": targets.tolist()}
    made_by = provenance(setup.command, setup.rig.seed, setup.inputs)
    source = source_of(setup, setup.rig, KIND, plan, board)
    return Recorder(setup.out, converter["channels"], source, made_by), targets, targets


def _kept_targets(setup: Setup, source: Mapping[str, Any]) -> Array:
    """The places of a recording that is to be gone on with."""
    targets = as_numbers(source["plan"]["presses"], np.float64, "places of the plan")
    if targets.ndim != 2 or targets.shape[1] != 2:
        raise InputError(f"{setup.out}: its plan has shape {targets.shape}, expected (Q, 2)")
    refuse_beyond("places of the plan", targets, MAX_MM, "mm")
    return targets
