"""Operation of a rig: devices are opened, diagnosed, and made to record; or a recording is simulated at once.

An adaptive plan moves its presses, as the recording goes on, to where a localizer errs most.
"""

import logging
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
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
from padforge.sense.rig.devices import Arm, Board, RigFault, host_ports, load_device
from padforge.sense.rig.doctor import Diagnosis, examine_arm, examine_board
from padforge.sense.rig.press_loop import Interrupts, PressLoop, check_plan
from padforge.sense.rig.safety import Limits, check_start_state, check_tcp
from padforge.sense.settings import RigSettings, read_rig
from padforge.sense.simulation.simulated_recording import simulate

_log = logging.getLogger(__name__)

ADAPT_EVERY = 20  # presses between two evaluations of the localizer by an adaptive plan
_N_CANDIDATES = 500
_N_NEIGHBOURS = 5

OpenedRig = AbstractContextManager[tuple[Arm, Board, RigSettings]]
"""An arm and a board, not yet connected, and the settings for them, which name the inputs of the board."""


class AdaptivePlanner:
    """Moves presses to those candidates where errors nearby, times the distance to the nearest press, are largest.

    The localizer is calibrated on an earlier recording; `run` is being written, and synced after every press.
    """

    def __init__(self, localizer: LocalizerModel, run: Path, rng: np.random.Generator, free: PositionTest) -> None:
        self._localizer, self._run, self._rng, self._free = localizer, run, rng, free

    def __call__(self, plan: PressPlan, press: int) -> PressPlan:
        """Return the plan with its next presses, from `press` on, moved; unchanged between two evaluations."""
        if press == 0 or press % ADAPT_EVERY:
            return plan
        recording = Recording.open(self._run)
        errors_mm = np.linalg.norm(self._localizer.predict(recording).positions_mm - recording.presses_mm, axis=1)
        positions_mm = plan.positions_mm.copy()
        corner_mm = np.abs(plan.positions_mm).max(axis=0)
        candidates = sample_uniform(np.array([-corner_mm, corner_mm]), _N_CANDIDATES, self._rng, self._free)
        pressed = recording.presses_mm
        for number in range(press, min(press + ADAPT_EVERY, len(plan))):
            score = acquisition(candidates, recording.presses_mm, errors_mm, pressed)
            positions_mm[number] = candidates[np.argmax(score)]
            pressed = np.vstack([pressed, positions_mm[number]])
        return PressPlan(positions_mm, plan.depths_mm)


def acquisition(candidates: Array, evaluated: Array, errors: Array, pressed: Array) -> Array:
    """Score candidates (K, 2): mean error of the nearest evaluated presses times distance to the nearest pressed."""
    _, nearest = KDTree(evaluated).query(candidates, k=min(_N_NEIGHBOURS, len(evaluated)))
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
    """Record presses on a simulated pad at once, see `simulate`; `overrides` of `[rig]` take precedence.

    `inputs` are files it is made from; `replacing` tells whether a simulated recording in `out` is replaced.
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
    """Check that presses do not go through a pad, and warn if none is as deep as the pad is designed for.

    Args:
        pad: pad that is pressed.
        rig: how it is pressed.
        contact: contact of the settings, which counts where the pad does not say what it is designed for.
        folder: folder of the pad, with what fabricate has written of its mould.

    Raises:
        InputError: a press is as deep as the pad is thick, by `[contact]` or by its mould.
    """
    depths_mm = planned_depths_mm(rig)
    if contact.model == "layer":
        check_depths(depths_mm, contact.thickness_mm, "[contact] thickness_mm")
    if (thickness_mm := cast_thickness_mm(folder)) is not None:
        check_depths(depths_mm, thickness_mm, str(folder / FABRICATION_FILE))
    if notice := describe_other_depth(depths_mm, contact_designed_for(pad.provenance) or contact):
        _log.warning(notice)


@contextmanager
def opened_rig(kind: str, config: RigConfig, inputs: Sequence[int]) -> Iterator[tuple[Arm, Board, RigSettings]]:
    """Open a rig with real devices, see `OpenedRig`, `make_arm` and `make_board`."""
    arm, rig = make_arm(kind, config, inputs)
    # The arm is closed, and so stopped, before the board.
    with closing(make_board(rig, inputs)) as board, closing(arm):
        yield arm, board, rig


def make_arm(kind: str, config: RigConfig, inputs: Sequence[int]) -> tuple[Arm, RigSettings]:
    """Return an arm by its name, not yet connected, and the settings for it, which name the inputs of the board."""
    rig = config.rig.model_copy(update={"channels": tuple(inputs)})
    if kind == "printer":
        _check_ports(rig)
        rig = locate_on_bed(rig, config.folder)
    return load_device("padforge.arms", kind)(rig), rig


def _check_ports(rig: RigSettings) -> None:
    if rig.printer_port is not None and Path(rig.printer_port).resolve() == Path(rig.port).resolve():
        message = f"[rig] port and printer_port are the same, {rig.port}"
        raise RigFault("refused", message, "the board and the printer each have a port of their own")


def make_board(rig: RigSettings, inputs: Sequence[int]) -> Board:
    """Return the board that `[rig]` names, not yet connected, which reads these inputs, or all if empty."""
    return load_device("padforge.boards", rig.board)(rig, inputs)


def record(
    config: RigConfig,
    opened: OpenedRig,
    *,
    model: Path | None = None,
    dry: bool = False,
    resume: bool = False,
    on_progress: OnProgress = ignore_progress,
) -> Recording | None:
    """Record with a rig, see `opened_rig`; what is done is on the disk whatever happens.

    An adaptive plan needs the folder of a localizer, `model`. If `dry`, the pad is not touched, nothing is kept, and
    None is returned. Raises RigFault if the rig failed, or the plan is not safe.
    """
    with opened as (arm, board, rig):
        with Interrupts() as interrupts:
            plan = load_or_make_plan(config, rig, resume)
            planner = _make_planner(config, rig, model)
            check_plan(plan, rig)
            if resume and (notice := plan_notice(config)):
                _log.warning(notice)
            if not (resume or dry):
                check_new_recording(config.out)
            identities = {"board": board.connect(), "arm": arm.connect()}
            check_tcp(rig.tcp_mm, identities["arm"])
            # Before there is a folder that would be in the way.
            check_start_state(arm.state(), Limits.from_settings(rig))
            interrupts.check()
        if rig.max_force_n is None:
            _log.warning('[rig] max_force_n is "unwatched": no force stops the arm')
        folder = temporary_folder(Path(tempfile.gettempdir()), "padforge-dry-") if dry else nullcontext(config.out)
        with folder as out:
            with open_recorder(config, rig, plan.to_rows(), out, resume, identities) as recorder:
                on_progress(len(recorder.done), len(plan), "")
                PressLoop(arm, board, recorder, rig, dry=dry).run(plan, on_progress, planner)
            return None if dry else Recording.open(out)


def _make_planner(config: RigConfig, rig: RigSettings, model: Path | None) -> Callable[[PressPlan, int], PressPlan]:
    if rig.plan != "adaptive":
        return lambda plan, press: plan
    if model is None:
        raise InputError("[rig] plan is adaptive, which needs --model, a folder that calibrate wrote")
    free = pressable_test(config.pad, fit_pad_settings(config.pad, config.pad_settings))
    return AdaptivePlanner(LocalizerModel.load(model), config.out, np.random.default_rng(rig.seed), free)


def diagnose(kind: str, config: RigConfig, inputs: Sequence[int]) -> list[Diagnosis]:
    """Diagnose a rig before a long run, or with `hand` the board alone; nothing moves.

    One device is examined even if the other cannot be made; a board alone that cannot raises RigFault. A printer is
    examined before it is asked where the pad lies.
    """
    ports = [f"{port.device} ({port.description})" for port in host_ports() if port.vid is not None]
    diagnoses = [Diagnosis("ports", "ok", ", ".join(ports) or "no board seen on USB")]
    try:
        diagnoses += examine_board(make_board(config.rig, inputs))
    except RigFault as fault:
        if kind == "hand":
            raise
        diagnoses.append(Diagnosis("board", "fail", str(fault)))
    if kind == "hand":
        return diagnoses
    rig, place = config.rig.model_copy(update={"channels": tuple(inputs)}), []
    try:
        if kind == "printer":
            _check_ports(rig)
            try:
                rig = locate_on_bed(rig, config.folder)
            except RigFault as fault:
                place = [Diagnosis("place", "fail", str(fault))]
        diagnoses += examine_arm(load_device("padforge.arms", kind)(rig), rig)
    except RigFault as fault:
        diagnoses.append(Diagnosis("arm", "fail", str(fault)))
    return diagnoses + place
