"""A whole rig without hardware: the real drivers talk to an emulated arm and board, which share one simulated pad."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

import numpy as np

from padforge.design import Contact, Morphology
from padforge.design.common.validation import InputError
from padforge.sense.arrays import Array
from padforge.sense.rig.arms.printer import Printer
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.boards.line_board import LineBoard, LineHeader
from padforge.sense.rig.config import RigConfig, RobotFrame
from padforge.sense.rig.devices import Arm, Board
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import SUPPLY_V, LivePad
from padforge.sense.virtual.boards import EmulatedLineBoard, SampleSource
from padforge.sense.virtual.printer import EmulatedPrinter
from padforge.sense.virtual.ur5 import HOST, EmulatedUR5
from padforge.sense.virtual.ur5_controller import Series

STIFFNESS_N_MM = 2.0  # of the pad under the emulated UR5, which has a force sensor: 10 N at the 5 mm of a usual press
DUE_INPUTS = 12
MIN_LINE_INPUTS = 16  # inputs of the emulated line board, which has more if higher ones are named
BED_MM = 1000.0  # width, depth and height of the emulated printer: room for any pad


@contextmanager
def emulate_ur5(
    pad: Morphology, contact: Contact, rig: RigSettings, series: Series = "e"
) -> Iterator[tuple[UR5, LineBoard, EmulatedUR5, EmulatedLineBoard]]:
    """Open drivers of arm and board, not yet connected, and the emulators behind them; `rig` is of `ur5_settings`.

    An arm of the series "cb3" measures no force.
    """
    tip = RobotFrame.from_settings(rig).pose(np.zeros(2), -2 * rig.clearance_mm)
    tcp_mm = rig.tcp_mm or (0.0, 0.0, 0.0)
    with (
        EmulatedUR5(series, tip, rig.contact_mm, STIFFNESS_N_MM, HOST, tcp_mm) as robot,
        _emulate_board(pad, contact, rig, robot.true_poses) as (board_driver, board),
        closing(UR5.from_settings(rig.model_copy(update={"host": HOST}))) as arm,
    ):
        yield arm, board_driver, robot, board


@contextmanager
def emulate_printer(
    pad: Morphology, contact: Contact, rig: RigSettings
) -> Iterator[tuple[Printer, LineBoard, EmulatedPrinter, EmulatedLineBoard]]:
    """Open drivers and emulators as `emulate_ur5` does, with a printer as the arm and `rig` of `printer_settings`."""
    tip = RobotFrame.from_settings(rig).pose(np.zeros(2), -2 * rig.clearance_mm)
    tcp = np.array(rig.tcp_mm)
    x, y, z = (tip[:3] - tcp).tolist()
    with EmulatedPrinter((x, y, z), bed_mm=(BED_MM, BED_MM, BED_MM)) as robot:
        printer = Printer(rig.model_copy(update={"printer_port": robot.port}))

        def tip_positions(times_s: Array) -> Array:
            return robot.true_positions(times_s) + tcp

        with _emulate_board(pad, contact, rig, tip_positions) as (driver, board), closing(printer):
            yield printer, driver, robot, board


def board_header(rig: RigSettings, n_inputs: int) -> LineHeader:
    """Return the header of the board that `[rig]` names, with room for a number of inputs: "due" or "line"."""
    if rig.board == "due":
        extra = (("name", "padforge-due"), ("serial", "0"))
        return LineHeader(rig.board_rate_hz, 16, SUPPLY_V, DUE_INPUTS, extra=extra)
    extra = (("name", "emulated"), ("serial", "0"))
    return LineHeader(rig.board_rate_hz, 12, SUPPLY_V, max(MIN_LINE_INPUTS, n_inputs), extra=extra)


@contextmanager
def _emulate_board(
    pad: Morphology, contact: Contact, rig: RigSettings, tip_positions: SampleSource
) -> Iterator[tuple[LineBoard, EmulatedLineBoard]]:
    """Open the driver of a board, and the board, which samples the pad below the tip."""
    frame, inputs = RobotFrame.from_settings(rig), rig.inputs(len(pad.knots))
    n_inputs = 1 + max(inputs)
    header = board_header(rig, n_inputs)
    model = LivePad(pad, contact, rig, rig.board_rate_hz, np.random.default_rng(rig.seed))
    model.prepare()  # before the board has to keep up

    def source(times_s: Array) -> Array:
        volts = np.zeros((len(times_s), max(header.channels, n_inputs)))
        volts[:, inputs] = model.volts(*frame.tip(tip_positions(times_s)))
        return volts

    with EmulatedLineBoard(source, header) as board:
        driver = LineBoard.from_settings(rig.model_copy(update={"port": board.port}), inputs)
        with closing(driver):
            yield driver, board


def ur5_settings(rig: RigSettings, pad: Morphology) -> RigSettings:
    """Return `rig` with a workspace around the emulated pad; pad and tip are where `rig` says, if it does."""
    x, y = rig.pad_mm or (0.0, -400.0)
    reach = max(pad.layout.size_mm) + rig.clearance_mm  # however the pad is rotated
    return rig.model_copy(
        update={
            "pad_mm": (x, y),
            "tcp_mm": rig.tcp_mm or (0.0, 0.0, 0.0),
            "contact_mm": 100.0,
            "box_mm": (x - reach, x + reach, y - reach, y + reach, 100.0 - rig.max_depth_mm, 300.0),
        }
    )


def printer_settings(rig: RigSettings, pad: Morphology) -> RigSettings:
    """Return `rig` with the pad in the middle of the emulated printer's bed, and the probe beside its nozzle."""
    middle, height = BED_MM / 2, 8.0
    reach = max(pad.layout.size_mm) + rig.clearance_mm
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
    "simulated": (ur5_settings, emulate_ur5),
    "ur5": (ur5_settings, emulate_ur5),
    "printer": (printer_settings, emulate_printer),
}
"""What is emulated, by the name of the rig: its settings, and its devices."""


@contextmanager
def opened_virtual_rig(kind: str, config: RigConfig, inputs: Sequence[int]) -> Iterator[tuple[Arm, Board, RigSettings]]:
    """Open emulated devices behind the drivers of one of `RIGS`, not yet connected, with the settings for them."""
    if kind not in RIGS:
        raise InputError(f"--virtual-hardware: got --rig {kind}, allowed are {', '.join(RIGS)}")
    settings, emulated_devices = RIGS[kind]
    rig = settings(config.rig.model_copy(update={"channels": tuple(inputs)}), config.pad)
    with emulated_devices(config.pad, config.contact, rig) as (arm, board, _, _):
        yield arm, board, rig
