"""Operation of a rig: opening and diagnosing its devices, recording with them, and simulated recordings.

An adaptive plan moves its next presses to where the errors of a localizer are largest.
"""

import logging
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from padforge.common.files import provenance, temporary_folder
from padforge.common.profiling import stage
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.settings import Spec
from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.settings import Contact, PadSettings, contact_designed_for, read_contact
from padforge.design.twin import Twin
from padforge.sense.arrays import Array
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.recording.press_plan import (
    PositionTest,
    PressPlan,
    check_depths,
    describe_other_depth,
    fit_pad_settings,
    planned_depths_mm,
    pressable_test,
    sample_uniform,
)
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import check_new_folder, check_new_recording
from padforge.sense.rig.config import (
    FABRICATION_FILE,
    RigConfig,
    cast_thickness_mm,
    load_or_make_plan,
    locate_on_bed,
    open_recorder,
    plan_notice,
)
from padforge.sense.rig.devices import Board, RigFault, host_ports, load_device
from padforge.sense.rig.doctor import Diagnosis, examine_arm, examine_board
from padforge.sense.rig.press_loop import Interrupts, PressLoop, check_plan
from padforge.sense.rig.safety import Limits, check_start_state, check_tcp
from padforge.sense.settings import RigSettings, read_rig
from padforge.sense.simulation.simulated_recording import simulate

_log = logging.getLogger(__name__)

ADAPT_EVERY = 20  # presses between two evaluations of the localizer by an adaptive plan


class AdaptivePlanner:
    """Moves presses to the random candidates with the largest `acquisition`.

    The localizer was trained on an earlier recording; `run` is the directory of the current one, synced after every
    press; `free` returns which positions (n, 2), mm, may be pressed.
    """

    def __init__(self, localizer: LocalizerModel, run: Path, rng: np.random.Generator, free: PositionTest) -> None:
        self._localizer, self._run, self._rng, self._free = localizer, run, rng, free

    def __call__(self, plan: PressPlan, press: int) -> PressPlan:
        """Return the plan with `ADAPT_EVERY` presses from `press` on moved; otherwise the plan itself."""
        if press == 0 or press % ADAPT_EVERY:
            return plan
        recording = Recording.open(self._run)
        errors_mm = np.linalg.norm(self._localizer.predict(recording).positions_mm - recording.presses_mm, axis=1)
        positions_mm = plan.positions_mm.copy()
        corner_mm = np.abs(plan.positions_mm).max(axis=0)
        candidates = sample_uniform(np.array([-corner_mm, corner_mm]), 500, self._rng, self._free)
        pressed = recording.presses_mm
        for number in range(press, min(press + ADAPT_EVERY, len(plan))):
            score = acquisition(candidates, recording.presses_mm, errors_mm, pressed)
            positions_mm[number] = candidates[np.argmax(score)]
            pressed = np.vstack([pressed, positions_mm[number]])
        return PressPlan(positions_mm, plan.depths_mm)


def acquisition(candidates: Array, evaluated: Array, errors: Array, pressed: Array) -> Array:
    """Return the acquisition score (K,) of candidate positions (K, 2): large errors, and unexplored positions.

    It is the mean of the errors (N,) of the five nearest evaluated presses (N, 2), times the distance to the nearest
    position (P, 2) that has been pressed or is planned.
    """
    _, nearest = KDTree(evaluated).query(candidates, k=min(5, len(evaluated)))
    distance, _ = KDTree(pressed).query(candidates)
    return errors[nearest].reshape(len(candidates), -1).mean(axis=1) * distance


def record_simulated(
    spec: Spec,
    pad: Morphology | Twin,
    out: Path,
    overrides: Mapping[str, Any],
    inputs: Sequence[Path] = (),
    like: Twin | None = None,
    replacing: bool = False,
) -> Recording:
    """Simulate a recording faster than real time, see `simulate`, and save it in `out`; see `Recording.save`.

    `overrides` are values of `[rig]` that take precedence over `spec`; the pad has the sensitivity, gain and noise of
    the twin `like`, if there is one.
    """
    if not replacing:
        check_new_folder(out)
    rig = read_rig(spec, **overrides)
    plan = pad.morphology if isinstance(pad, Twin) else pad
    pad_settings = spec.section(PadSettings, **plan.layout.settings)
    with stage("simulate"):
        recording = simulate(pad, rig, read_contact(spec), pad_settings, like)
    inputs = [*inputs, *([rig.plan_file] if rig.plan_file else [])]
    recording.save(out, provenance("padforge sense record --rig simulated", rig.seed, inputs), replacing)
    return recording


def check_press_depths(pad: Morphology, rig: RigSettings, contact: Contact, folder: Path) -> None:
    """Raise InputError for a press as deep as the pad is thick, as `[contact]` or the mould in the folder states it.

    Warn if no press has the depth that the pad was designed for, as its provenance or else `[contact]` states it.
    """
    depths_mm = planned_depths_mm(rig)
    if contact.model == "layer":
        check_depths(depths_mm, contact.thickness_mm, "[contact] thickness_mm")
    if (thickness_mm := cast_thickness_mm(folder)) is not None:
        check_depths(depths_mm, thickness_mm, str(folder / FABRICATION_FILE))
    if notice := describe_other_depth(depths_mm, contact_designed_for(pad.provenance) or contact):
        _log.warning(notice)


def _check_ports(rig: RigSettings) -> None:
    if rig.printer_port is not None and Path(rig.printer_port).resolve() == Path(rig.port).resolve():
        message = f"[rig] port and printer_port are the same, {rig.port}"
        raise RigFault("refused", message, "the board and the printer each have a port of their own")


def make_board(rig: RigSettings, inputs: Sequence[int]) -> Board:
    """Return the board of `[rig]`, not yet connected; it reads `inputs`, or all of its inputs if that is empty."""
    return load_device("padforge.boards", rig.board)(rig, inputs)


def record(
    kind: str,
    config: RigConfig,
    *,
    model: Path | None = None,
    dry: bool = False,
    resume: bool = False,
    on_progress: OnProgress = ignore_progress,
) -> Recording | None:
    """Record with an arm, by its name; completed presses are on the disk even if the recording fails.

    An adaptive plan needs a `model`, the folder of a localizer. If `dry`, the arm moves above the pad only, and nothing
    is stored or returned. `on_progress` is called after every press. Raises RigFault if a device fails, or the plan is
    not safe.
    """
    inputs = config.rig.inputs(len(config.pad.knots))
    if kind == "printer":
        _check_ports(config.rig)
        config = replace(config, rig=locate_on_bed(config.rig, config.folder))
    rig = config.rig
    arm = load_device("padforge.arms", kind)(rig)
    # Closing stops the arm, and comes before the board is closed.
    with closing(make_board(rig, inputs)) as board, closing(arm):
        with Interrupts() as interrupts:
            plan = load_or_make_plan(config, resume)
            planner = make_planner(config, model)
            check_plan(plan, rig)
            if resume and (notice := plan_notice(config)):
                _log.warning(notice)
            if not (resume or dry):
                check_new_recording(config.out)
            identities = {"board": board.connect(), "arm": arm.connect()}
            check_tcp(rig.tcp_mm, identities["arm"])
            # Checked before the run directory exists, so that a refusal leaves none behind.
            check_start_state(arm.state(), Limits.from_settings(rig))
            interrupts.check()
        if rig.max_force_n is None:
            _log.warning('[rig] max_force_n is "unwatched": no force stops the arm')
        folder = temporary_folder(Path(tempfile.gettempdir()), "padforge-dry-") if dry else nullcontext(config.out)
        with folder as out:
            with open_recorder(config, plan.to_rows(), out, resume and not dry, identities) as recorder:
                on_progress(len(recorder.done), len(plan), "")
                PressLoop(arm, board, recorder, rig, dry=dry).run(plan, on_progress, planner)
            return None if dry else Recording.open(out)


def make_planner(config: RigConfig, model: Path | None) -> AdaptivePlanner | None:
    """Return the planner of an adaptive plan, by the localizer in the folder `model`; None for any other plan."""
    if config.rig.plan != "adaptive":
        return None
    if model is None:
        raise InputError("[rig] plan is adaptive, which needs --model, a folder that calibrate wrote")
    free = pressable_test(config.pad, fit_pad_settings(config.pad, config.pad_settings))
    return AdaptivePlanner(LocalizerModel.load(model), config.out, np.random.default_rng(config.rig.seed), free)


def diagnose(kind: str, config: RigConfig, inputs: Sequence[int]) -> list[Diagnosis]:
    """Diagnose a rig before a long run, without moving it.

    Each device is examined even if the other one fails, and a printer even if the pose of the pad is unknown. `kind` is
    the name of the arm, or "hand" for the board alone, which then raises RigFault if it is missing; `inputs` are those
    of the board to read, () for all.
    """
    ports = [f"{port.device} ({port.description})" for port in host_ports() if port.vid is not None]
    diagnoses = [Diagnosis("ports", "ok", ", ".join(ports) or "no board seen on USB")]
    if kind == "hand":
        return diagnoses + examine_board(make_board(config.rig, inputs))
    try:
        diagnoses += examine_board(make_board(config.rig, inputs))
    except RigFault as fault:
        diagnoses.append(Diagnosis("board", "fail", str(fault)))
    rig, location = config.rig, []
    try:
        if kind == "printer":
            _check_ports(rig)
            try:
                rig = locate_on_bed(rig, config.folder)
            except RigFault as fault:
                location = [Diagnosis("place", "fail", str(fault))]
        arm = load_device("padforge.arms", kind)(rig)
    except RigFault as fault:
        return [*diagnoses, Diagnosis("arm", "fail", str(fault)), *location]
    return diagnoses + examine_arm(arm, rig) + location
