"""A whole rig without hardware: the real drivers talk to an emulated arm and board, which share one simulated pad."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from design import Contact, Morphology, signals
from sense.recordings.processing.limits import Array
from sense.recordings.simulation.pad_model import LivePad
from sense.rig.arms.ur5.driver import UR5
from sense.rig.boards.due.driver import Arduino
from sense.rig.session.pad_frame import Frame
from sense.settings import RigSettings

from .due_board import EmulatedBoard
from .ur.emulator import HOST, UrEmulator


@contextmanager
def emulated(
    pad: Morphology, contact: Contact, rig: RigSettings
) -> Iterator[tuple[UR5, Arduino, UrEmulator, EmulatedBoard]]:
    """Drivers of an arm and a board, not yet connected, and the emulators behind them.

    Args:
        pad: under the arm, where `rig` says. contact: what a press deforms.
        rig: as `emulated_rig` makes it, of strengths of the pad and of the rate.
    """
    frame = Frame.of(rig)
    model = LivePad(pad, contact, rig, rig.converter_rate_hz, np.random.default_rng(rig.seed))
    signals(pad, pad.to_grid([[0.0, 0.0]]), contact)  # compiled before the board has to keep up
    start = frame.pose(np.zeros(2), -2 * rig.clearance_mm)
    with UrEmulator(pose=start, surface_mm=rig.contact_mm, host=HOST) as robot:

        def volts(times_s: Array) -> Array:
            return model.volts(*frame.tip(robot.pose_at(times_s)))

        with EmulatedBoard(volts) as board:
            arm, converter = UR5(HOST), Arduino(board.port, rig.converter_rate_hz, rig.channels)
            try:
                yield arm, converter, robot, board
            finally:
                converter.close()
                arm.close()


def emulated_rig(rig: RigSettings, pad: Morphology) -> RigSettings:
    """`rig` with a workspace around the emulated pad, and a channel for every fibre as far as the board has them."""
    x, y = rig.pad_mm
    reach = pad.size_mm + rig.clearance_mm
    return rig.model_copy(
        update={
            "contact_mm": 100.0,
            "box_mm": (x - reach, x + reach, y - reach, y + reach, 100.0 - rig.max_depth_mm, 300.0),
            "channels": 2 * pad.grid,
        }
    )
