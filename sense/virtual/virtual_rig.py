"""A whole rig without hardware: the real drivers talk to an emulated arm and board, which share one simulated pad."""

import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

import numpy as np

from padforge.design import Contact, Morphology, signals
from padforge.design.common.validation import InputError
from padforge.sense.arrays import Array
from padforge.sense.rig.arms.printer import Printer
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.boards.due import Arduino
from padforge.sense.rig.boards.line_board import LineBoard
from padforge.sense.rig.boards.line_framing import LineHeader
from padforge.sense.rig.config import RigConfig, RobotFrame
from padforge.sense.rig.devices import Arm, Board
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import SUPPLY_V, LivePad
from padforge.sense.virtual.boards import EmulatedBoard, EmulatedLineBoard, Source
from padforge.sense.virtual.printer import EmulatedPrinter
from padforge.sense.virtual.ur5 import HOST, UrEmulator

STIFFNESS_N_MM = 2.0
"""Of the pad under the emulated arm, which has a force sensor: 10 N at the 5 mm of a usual press."""
MUX_INPUTS = 16
"""Of the emulated line board, which has more where more are named."""

BED_MM = 1000.0
"""Width, depth and height of the emulated printer: room for any pad."""

_START_S = 2.0
_DRIVERS = {"due": Arduino, "line": LineBoard}

Driver = Arduino | LineBoard
EmulatedBoards = EmulatedBoard | EmulatedLineBoard


@contextmanager
def emulated(
    pad: Morphology, contact: Contact, rig: RigSettings
) -> Iterator[tuple[UR5, Driver, UrEmulator, EmulatedBoards]]:
    """Drivers of an arm and a board, not yet connected, and the emulators behind them.

    Args:
        pad: under the arm, where `rig` says. contact: what a press deforms.
        rig: as `emulated_rig` makes it, of strengths of the pad and of the rate; names the board and how it is wired.

    Raises:
        InputError, RigFault: a board that is not emulated, or has too few inputs.
    """
    start = RobotFrame.from_settings(rig).pose(np.zeros(2), -2 * rig.clearance_mm)
    tcp_mm = rig.tcp_mm or (0.0, 0.0, 0.0)
    with UrEmulator("e", start, rig.contact_mm, STIFFNESS_N_MM, HOST, tcp_mm) as robot:
        _await_pose(robot)
        with _read_below(pad, contact, rig, robot.pose_at) as (converter, board), closing(UR5(HOST)) as arm:
            yield arm, converter, robot, board


@contextmanager
def emulated_printer(
    pad: Morphology, contact: Contact, rig: RigSettings
) -> Iterator[tuple[Printer, Driver, EmulatedPrinter, EmulatedBoards]]:
    """As `emulated`, with a printer for the arm and `rig` as `emulated_printer_rig` makes it."""
    tip = RobotFrame.from_settings(rig).pose(np.zeros(2), -2 * rig.clearance_mm)
    tcp = np.array(rig.tcp_mm)
    x, y, z = (tip[:3] - tcp).tolist()
    with EmulatedPrinter((x, y, z), bed_mm=(BED_MM, BED_MM, BED_MM)) as robot:
        printer = Printer(rig.model_copy(update={"printer_port": robot.port}))

        def tips(times_s: Array) -> Array:
            return robot.nozzle_at(times_s) + tcp

        with _read_below(pad, contact, rig, tips) as (converter, board), closing(printer):
            yield printer, converter, robot, board


@contextmanager
def _read_below(
    pad: Morphology, contact: Contact, rig: RigSettings, tips: Source
) -> Iterator[tuple[Driver, EmulatedBoards]]:
    """The driver of a board and the board, which reads the pad below a tip whose x, y, z `tips` gives for times."""
    frame, inputs = RobotFrame.from_settings(rig), rig.inputs(len(pad.knots))
    there = max(MUX_INPUTS, 1 + max(inputs))
    model = LivePad(pad, contact, rig, rig.board_rate_hz, np.random.default_rng(rig.seed))
    signals(pad, pad.to_grid([[0.0, 0.0]]), contact)  # compiled before the board has to keep up

    def volts(times_s: Array) -> Array:
        wired = np.zeros((len(times_s), there))
        wired[:, inputs] = model.volts(*frame.tip(tips(times_s)))
        return wired

    with _board(rig, volts, there) as board:
        driver = _DRIVERS[rig.board].of(rig.model_copy(update={"port": board.port}), inputs)
        with closing(driver) as converter:
            yield converter, board


def _await_pose(robot: UrEmulator) -> None:
    """Return once the arm knows where it is: a board that samples from its start on asks for that."""
    deadline = time.monotonic() + _START_S
    while not len(robot.truth.rows()) and time.monotonic() < deadline:
        time.sleep(1e-3)


def _board(rig: RigSettings, volts: Source, inputs: int) -> EmulatedBoards:
    """The emulated board that `[rig]` names, with so many inputs if it is a line board."""
    if rig.board == "due":
        return EmulatedBoard(volts)
    if rig.board == "line":
        said = (("name", "emulated"), ("serial", "0"))
        return EmulatedLineBoard(volts, LineHeader(rig.board_rate_hz, 12, SUPPLY_V, inputs, said=said))
    raise InputError(f"[rig] board: got {rig.board!r}, emulated are {' and '.join(_DRIVERS)}")


def emulated_rig(rig: RigSettings, pad: Morphology) -> RigSettings:
    """`rig` with a workspace around the emulated pad.

    Where the pad lies and where the tip is are as said, or as good as any.
    """
    x, y = rig.pad_mm or (0.0, -400.0)
    reach = _reach_mm(rig, pad)
    return rig.model_copy(
        update={
            "pad_mm": (x, y),
            "tcp_mm": rig.tcp_mm or (0.0, 0.0, 0.0),
            "contact_mm": 100.0,
            "box_mm": (x - reach, x + reach, y - reach, y + reach, 100.0 - rig.max_depth_mm, 300.0),
        }
    )


def _reach_mm(rig: RigSettings, pad: Morphology) -> float:
    """How far from the middle of a pad a tip may go, however the pad is turned."""
    return max(pad.layout.size_mm) + rig.clearance_mm


def emulated_printer_rig(rig: RigSettings, pad: Morphology) -> RigSettings:
    """`rig` with the pad in the middle of the emulated printer's bed, and the probe beside its nozzle."""
    middle, height = BED_MM / 2, 8.0
    reach = _reach_mm(rig, pad)
    sides = (middle - reach, middle + reach)
    return rig.model_copy(
        update={
            "pad_mm": (middle, middle),
            "contact_mm": height,
            "box_mm": (*sides, *sides, height - rig.max_depth_mm, height + 200.0),
            "tcp_mm": rig.tcp_mm or (30.0, 0.0, -20.0),
            "max_force_n": None,
        }
    )


RIGS = {
    "simulated": (emulated_rig, emulated),
    "ur5": (emulated_rig, emulated),
    "printer": (emulated_printer_rig, emulated_printer),
}
"""What is emulated, by the name of the rig: its settings, and its devices."""


@contextmanager
def opened_virtual_rig(kind: str, config: RigConfig, inputs: Sequence[int]) -> Iterator[tuple[Arm, Board, RigSettings]]:
    """Open emulated devices behind the drivers of a rig, not yet connected, and the settings for them.

    Args:
        kind: One of `RIGS`.
        config: What is recorded.
        inputs: Of the board, in the order of the fibres; all of them if empty.

    Raises:
        InputError: There is no such rig.
    """
    if kind not in RIGS:
        raise InputError(f"--virtual-hardware: got --rig {kind}, allowed are {', '.join(RIGS)}")
    settings, emulated_devices = RIGS[kind]
    rig = settings(config.rig.model_copy(update={"channels": tuple(inputs)}), config.pad)
    with emulated_devices(config.pad, config.contact, rig) as (arm, board, _, _):
        yield arm, board, rig
