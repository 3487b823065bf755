"""The work as URScript, for the arms of Universal Robots: movel over the pad, movep along a fibre, popups to wait."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from padforge.design.morphology import Array
from padforge.fabricate.fibre_placement.toolpath import TOLERANCE_MM, Go, Instruction, Pause, Stroke
from padforge.fabricate.settings import DispenserSettings

_BLEND_SHARE = 0.4
"""Of the shorter of two pieces: the arcs at its ends may not meet."""
_UNKNOWN = "where the pad lies is unknown: [dispenser] arm_pose in pad.toml says it"


def urscript(work: Iterable[Instruction], summary: Iterable[str], dispenser: DispenserSettings) -> str:
    """The program: places in mm in the frame of the pad, which `at` puts into the base of the arm.

    Along a fibre the tip goes through the corners on arcs that stay within the tolerance of the course. Where nobody
    knows how the pad lies, the program says so and ends before anything moves.
    """
    pose, dynamics = dispenser.arm_pose or (0.0,) * 6, _dynamics(dispenser.travel_mm_s, dispenser)
    lines = [
        "def padforge_laying():",
        *(f"  # {line}" for line in summary),
        "  # the TCP is the mouth of the needle; pad is the middle of its upper face in the base of the arm, m and rad",
        f"  pad = p[{', '.join(f'{value:.10g}' for value in pose)}]",
        *([_popup(_UNKNOWN), "  halt"] if dispenser.arm_pose is None else []),
        "  def at(x, y, z):",
        f"    return pose_trans(pad, p[x / 1000, y / 1000, z / 1000, {math.pi:.9f}, 0, 0])",
        "  end",
        _popup("needle over the pad, all its ways free?"),
        "  here = pose_trans(pose_inv(pad), get_actual_tcp_pose())",
        f"  movel(at(here[0] * 1000, here[1] * 1000, {_number(dispenser.travel_height_mm)}), {dynamics})",
        *_body(work, dispenser),
        "end",
        "",
    ]
    return "\n".join(lines)


def _body(work: Iterable[Instruction], dispenser: DispenserSettings) -> Iterator[str]:
    for told in work:
        if isinstance(told, Pause):
            yield _popup(told.message)
        elif isinstance(told, Go):
            yield f"  movel(at({', '.join(map(_number, told.place))}), {_dynamics(told.speed_mm_s, dispenser)})"
        else:
            yield from _laid(told.stroke, dispenser)


def _laid(stroke: Stroke, dispenser: DispenserSettings) -> Iterator[str]:
    places = np.round(stroke.positions_mm, 3)
    feeds, blends = stroke.feeds_mm_s.tolist(), _blends(places).tolist()
    for (x, y), feed, blend in zip(places[1:].tolist(), feeds, blends, strict=True):
        place = ", ".join(map(_number, (x, y, stroke.z_mm)))
        yield f"  movep(at({place}), {_dynamics(feed, dispenser)}, r={blend / 1000:.7g})"


def _blends(places: Array) -> Array:
    """(n - 1,) how far from each corner but the first its arc begins, mm; 0 at the end.

    An arc that begins b from a corner where the course turns by t passes the corner at b tan(t / 4).
    """
    steps = np.diff(places, axis=0)
    length = np.hypot(*steps.T)
    headings = np.arctan2(*steps.T[::-1])
    turns = np.abs((np.diff(headings) + np.pi) % (2 * np.pi) - np.pi)
    room = _BLEND_SHARE * np.minimum(length[:-1], length[1:])
    within = TOLERANCE_MM / np.tan(np.maximum(turns, 1e-6) / 4)
    return np.append(np.floor(1e4 * np.minimum(room, within)) / 1e4, 0.0)


def _dynamics(speed_mm_s: float, dispenser: DispenserSettings) -> str:
    return f"a={dispenser.acceleration_mm_s2 / 1000:.6g}, v={speed_mm_s / 1000:.6g}"


def _popup(message: str) -> str:
    return f'  popup("{message}", title="padforge", blocking=True)'


def _number(value: float) -> str:
    return f"{round(value, 3) + 0.0:.10g}"
