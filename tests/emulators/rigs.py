"""Whole rigs without hardware: an emulated arm and board, which share one simulated pad, for the real drivers."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from padforge.design import Contact, Morphology
from padforge.sense.arrays import Array
from padforge.sense.rig.config import RobotFrame
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import LivePad
from tests.emulators.boards import EmulatedLineBoard, SampleSource, emulated_header
from tests.emulators.printer import EmulatedPrinter
from tests.emulators.ur5 import HOST, EmulatedUR5
from tests.emulators.ur5_controller import Series

STIFFNESS_N_MM = 2.0  # of the pad under the emulated UR5, which has a force sensor: 10 N at the 5 mm of a usual press
MIN_INPUTS = 16  # inputs of the emulated board, which has more if higher ones are named
BED_MM = 1000.0  # width, depth and height of the emulated printer: room for any pad


@contextmanager
def emulate_ur5(
    pad: Morphology, contact: Contact, rig: RigSettings, series: Series = "e"
) -> Iterator[tuple[RigSettings, EmulatedUR5, EmulatedLineBoard]]:
    """Run the emulators of a rig of `ur5_settings`, and yield them after its settings, which name their ports."""
    tip = RobotFrame.from_settings(rig).pose(np.zeros(2), -2 * rig.clearance_mm)
    tcp_mm = rig.tcp_mm or (0.0, 0.0, 0.0)
    with (
        EmulatedUR5(series, tip, rig.contact_mm, STIFFNESS_N_MM, HOST, tcp_mm) as robot,
        _emulate_board(pad, contact, rig, robot.true_poses) as board,
    ):
        yield rig.model_copy(update={"host": HOST, "port": board.port}), robot, board


@contextmanager
def emulate_printer(
    pad: Morphology, contact: Contact, rig: RigSettings
) -> Iterator[tuple[RigSettings, EmulatedPrinter, EmulatedLineBoard]]:
    """Run emulators as `emulate_ur5` does, with a printer as the arm and `rig` of `printer_settings`."""
    tip = RobotFrame.from_settings(rig).pose(np.zeros(2), -2 * rig.clearance_mm)
    tcp = np.array(rig.tcp_mm)
    x, y, z = (tip[:3] - tcp).tolist()
    with EmulatedPrinter((x, y, z), bed_mm=(BED_MM, BED_MM, BED_MM)) as robot:

        def tip_positions(times_s: Array) -> Array:
            return robot.true_positions(times_s) + tcp

        with _emulate_board(pad, contact, rig, tip_positions) as board:
            yield rig.model_copy(update={"printer_port": robot.port, "port": board.port}), robot, board


@contextmanager
def _emulate_board(
    pad: Morphology, contact: Contact, rig: RigSettings, tip_positions: SampleSource
) -> Iterator[EmulatedLineBoard]:
    frame, inputs = RobotFrame.from_settings(rig), rig.inputs(len(pad.knots))
    n_inputs = max(MIN_INPUTS, 1 + max(inputs))
    model = LivePad(pad, contact, rig, rig.board_rate_hz, np.random.default_rng(rig.seed))
    model.prepare()  # before the board has to keep up

    def source(times_s: Array) -> Array:
        volts = np.zeros((len(times_s), n_inputs))
        volts[:, inputs] = model.volts(*frame.tip(tip_positions(times_s)))
        return volts

    with EmulatedLineBoard(source, emulated_header(rig.board_rate_hz, n_inputs)) as board:
        yield board


def ur5_settings(rig: RigSettings, pad: Morphology) -> RigSettings:
    """Return `rig` with a workspace around the emulated pad."""
    return _with_pad(rig, pad, (0.0, -400.0), 100.0, tcp_mm=(0.0, 0.0, 0.0))


def printer_settings(rig: RigSettings, pad: Morphology) -> RigSettings:
    """Return `rig` with the pad in the middle of the emulated printer's bed, and the probe beside its nozzle."""
    return _with_pad(rig, pad, (BED_MM / 2, BED_MM / 2), 8.0, tcp_mm=(30.0, 0.0, -20.0), max_force_n=None)


def _with_pad(
    rig: RigSettings, pad: Morphology, centre_mm: tuple[float, float], height_mm: float, **settings: Any
) -> RigSettings:
    reach = max(pad.layout.size_mm) + rig.clearance_mm  # however the pad is rotated
    sides = (side for x in centre_mm for side in (x - reach, x + reach))
    box_mm = (*sides, height_mm - rig.max_depth_mm, height_mm + 200.0)
    return rig.model_copy(update={"pad_mm": centre_mm, "contact_mm": height_mm, "box_mm": box_mm, **settings})
