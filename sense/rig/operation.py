"""Pressing where a localizer is least certain: an adaptive plan moves its presses there as the recording goes on.

A rig at work: its devices are opened, looked over, and made to record; or a recording is simulated at once.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from padforge.design.common.files import provenance, temporary_folder
from padforge.design.common.profiling import stage
from padforge.design.common.settings import Spec
from padforge.design.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.settings import Contact, PadSettings
from padforge.design.twin import Twin
from padforge.sense.arrays import Array
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.recording.press_plan import (
    PositionTest,
    PressPlan,
    fit_pad_settings,
    pressable_test,
    sample_uniform,
)
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import check_new_folder, check_new_recording
from padforge.sense.rig.config import RigConfig, kept_plan, on_bed, plan_of, recorder_of
from padforge.sense.rig.devices import Arm, Board, RigFault, device, host_ports
from padforge.sense.rig.doctor import Diagnosis, examine_arm, examine_converter
from padforge.sense.rig.press_loop import Interrupts, Report, Session, require_safe_plan
from padforge.sense.rig.safety import Limits, require_ready, require_tool
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate

EVERY = 20
"""Presses between two looks at how well the localizer finds them."""
_CANDIDATES = 500
_NEIGHBOURS = 5


class AdaptivePlanner:
    """Chooses presses: those candidates where errors nearby, times the way to the nearest press, are largest.

    Args:
        localizer: calibrated on an earlier recording of the pad. run: run directory that is being written, synced after
            every press. rng: of the candidates. free: which of them may be pressed.
    """

    def __init__(self, localizer: LocalizerModel, run: Path, rng: np.random.Generator, free: PositionTest) -> None:
        self._localizer, self._run, self._rng, self._free = localizer, run, rng, free

    def __call__(self, plan: PressPlan, press: int) -> PressPlan:
        """The plan with its next presses, from `press` on, moved; unchanged between two looks."""
        if press == 0 or press % EVERY:
            return plan
        recording = Recording.open(self._run)
        errors = np.linalg.norm(self._localizer.predict(recording).positions_mm - recording.presses_mm, axis=1)
        places = plan.positions_mm.copy()
        high = np.abs(plan.positions_mm).max(axis=0)
        candidates = sample_uniform(np.array([-high, high]), _CANDIDATES, self._rng, self._free)
        pressed = recording.presses_mm
        for number in range(press, min(press + EVERY, len(plan))):
            places[number] = candidates[np.argmax(uncertainty(candidates, recording.presses_mm, errors, pressed))]
            pressed = np.vstack([pressed, places[number]])
        return PressPlan(places, plan.depths_mm)


def uncertainty(candidates: Array, known: Array, errors: Array, pressed: Array) -> Array:
    """(K,) how much there is to learn at candidates (K, 2): mean error of the nearest presses times the way to any.

    Args:
        known, errors: (Q, 2) places whose errors (Q,) are known. pressed: (P, 2) all places, of which none is repeated.
    """
    _, near = KDTree(known).query(candidates, k=min(_NEIGHBOURS, len(known)))
    way, _ = KDTree(pressed).query(candidates)
    return errors[near].reshape(len(candidates), -1).mean(axis=1) * way


_DRY = "padforge-dry-"
"""What folders for recordings that nobody keeps begin with, among temporary ones."""


def record_simulated(
    spec: Spec,
    pad: Morphology | Twin,
    out: Path,
    overrides: Mapping[str, Any],
    inputs: Sequence[Path] = (),
    like: Twin | None = None,
    replacing: bool = False,
) -> Recording:
    """Record presses on the simulated rig, at once, with the settings of `spec`, into the run directory `out`.

    Args:
        pad, like: see `simulate`.
        replacing: whether a simulated recording that is there gives way.

    Raises:
        InputError: settings that cannot be, a twin that reads no fibre, or a recording in the way.
    """
    if not replacing:
        check_new_folder(out)
    options = spec.section(RigSettings, **overrides)
    plan = pad.morphology if isinstance(pad, Twin) else pad
    size = spec.section(PadSettings, **plan.layout.settings)
    with stage("simulate"):
        recording = simulate(pad, options, spec.section(Contact), size, like)
    inputs = [*inputs, *([options.plan_file] if options.plan_file else [])]
    recording.save(out, provenance("padforge sense record --rig simulated", options.seed, inputs), replacing)
    return recording


@contextmanager
def opened_rig(
    kind: str, setup: RigConfig, inputs: Sequence[int], virtual_hardware: bool = False
) -> Iterator[tuple[Arm, Board, RigSettings]]:
    """Arm and converter of a rig, "simulated" or the name of an arm, not yet connected, and the settings for them.

    Args:
        inputs: of the board, fibre by fibre; all of them where empty. The settings then name these.
        virtual_hardware: emulated devices behind the drivers of the rig, as the simulated one always has them.
    """
    rig = setup.rig.model_copy(update={"channels": tuple(inputs)})
    if kind == "simulated" or virtual_hardware:
        from padforge.sense.virtual.virtual_rig import RIGS

        if kind not in RIGS:
            raise InputError(f"--virtual-hardware: got --rig {kind}, allowed are {', '.join(RIGS)}")
        settle, emulated = RIGS[kind]
        chosen = settle(rig, setup.pad)
        with emulated(setup.pad, setup.contact, chosen) as (arm, converter, _, _):
            yield arm, converter, chosen
        return
    arm, rig = _arm(kind, setup, rig)
    with closing(_board(rig, inputs)) as converter, closing(arm):
        yield arm, converter, rig


def _arm(kind: str, setup: RigConfig, rig: RigSettings) -> tuple[Arm, RigSettings]:
    """An arm by its name, and the settings for it."""
    make = device("padforge.arms", kind)
    rig = on_bed(rig, setup.folder) if kind == "printer" else rig
    return make(rig), rig


def _board(rig: RigSettings, inputs: Sequence[int]) -> Board:
    return device("padforge.boards", rig.board)(rig, inputs)


@contextmanager
def opened_board(setup: RigConfig, inputs: Sequence[int]) -> Iterator[Board]:
    """The board alone, not yet connected: the pad is pressed by hand. `inputs` as of `opened_rig`."""
    with closing(_board(setup.rig, inputs)) as converter:
        yield converter


@contextmanager
def _emulated_board(setup: RigConfig) -> Iterator[Board]:
    from padforge.sense.virtual.virtual_hand import pressed_by_finger

    with pressed_by_finger(setup.pad, setup.contact, setup.rig) as (converter, _):
        yield converter


def record(
    kind: str,
    setup: RigConfig,
    model: Path | None = None,
    *,
    dry: bool = False,
    resume: bool = False,
    virtual_hardware: bool = False,
    report: Report = lambda done, of: None,
    say: Callable[[str], None] = lambda line: None,
) -> Recording | None:
    """Record with the drivers of a rig, see `opened_rig`; what is done is on the disk whatever happens.

    Args:
        model: folder of the localizer that an adaptive plan is steered by.
        dry: go through the plan without touching the pad; nothing is kept. resume: go on with what is in `setup.out`.
        virtual_hardware: see `opened_rig`.
        report: told of presses done, and in all. say: told what a person should know before the arm moves.

    Returns:
        The recording, None of a dry run.

    Raises:
        InputError: settings, a plan or a run directory that cannot be.
        RigFault: the rig failed, or the plan is not safe.
    """
    inputs = setup.rig.inputs(len(setup.pad.knots))
    with opened_rig(kind, setup, inputs, virtual_hardware) as (arm, converter, rig):
        with Interrupts() as interrupts:
            plan = plan_of(setup, rig, resume)
            steer = _steering(setup, rig, model)
            require_safe_plan(plan, rig)
            if resume and (told := kept_plan(setup)):
                say(told)
            if not (resume or dry):
                check_new_recording(setup.out)
            devices = {"board": converter.connect(), "arm": arm.connect()}
            require_tool(rig.tcp_mm, devices["arm"])
            require_ready(arm.state(), Limits.of(rig))  # before there is a folder that would be in the way
            interrupts.check()
        if rig.max_force_n is None:
            say('[rig] max_force_n is "unwatched": no force stops the arm')
        with temporary_folder(Path(tempfile.gettempdir()), _DRY) if dry else nullcontext(setup.out) as folder:
            with recorder_of(setup, rig, plan, folder, resume, devices) as recorder:
                report(len(recorder.done), len(plan))
                Session(arm, converter, recorder, rig, dry=dry).run(plan, report, steer)
            return None if dry else Recording.open(folder)


def _steering(setup: RigConfig, rig: RigSettings, model: Path | None) -> Callable[[PressPlan, int], PressPlan]:
    if rig.plan != "adaptive":
        return lambda plan, press: plan
    if model is None:
        raise InputError("[rig] plan is adaptive, which needs --model, a folder that calibrate wrote")
    free = pressable_test(setup.pad, fit_pad_settings(setup.pad, setup.size))
    return AdaptivePlanner(LocalizerModel.load(model), setup.out, np.random.default_rng(rig.seed), free)


def look_over(kind: str, setup: RigConfig, inputs: Sequence[int], virtual_hardware: bool = False) -> list[Diagnosis]:
    """What to know of a rig, see `opened_rig`, or of the board alone for "hand", before a long run; nothing moves."""
    ports = [f"{port.device} ({port.description})" for port in host_ports() if port.vid is not None]
    found = [Diagnosis("ports", "ok", ", ".join(ports) or "no board seen on USB")]
    if kind == "hand":
        with _emulated_board(setup) if virtual_hardware else opened_board(setup, inputs) as converter:
            return found + examine_converter(converter, time.monotonic, time.sleep)
    if kind == "simulated" or virtual_hardware:
        with opened_rig(kind, setup, inputs, virtual_hardware) as (arm, converter, rig):
            found += examine_converter(converter, time.monotonic, time.sleep)
            return found + examine_arm(arm, rig, time.monotonic, time.sleep)

    def board() -> list[Diagnosis]:
        return examine_converter(_board(setup.rig, inputs), time.monotonic, time.sleep)

    def arm_alone() -> list[Diagnosis]:
        return examine_arm(*_arm(kind, setup, setup.rig), time.monotonic, time.sleep)

    for name, examined in (("board", board), ("arm", arm_alone)):  # one is looked at where the other is not there
        try:
            found += examined()
        except RigFault as fault:
            found.append(Diagnosis(name, "fail", str(fault)))
    return found
