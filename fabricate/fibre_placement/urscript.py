"""Toolpaths as URScript, for the arms of Universal Robots: movel over the pad, movep along a fibre, popups to wait."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from padforge.design.morphology import Array
from padforge.fabricate.fibre_placement.toolpath import (
    TOLERANCE_MM,
    Instruction,
    LinearMove,
    Pause,
    Step,
    build_instructions,
    format_mm,
    summary_lines,
)
from padforge.fabricate.plan import Plan
from padforge.fabricate.settings import DispenserSettings

_BLEND_SHARE = 0.4
"""Maximum blend as a share of the shorter of two segments: the arcs at its ends may not meet."""
_UNKNOWN = "where the pad lies is unknown: [dispenser] arm_pose in pad.toml says it"


def urscript(plan: Plan, steps: Sequence[Step]) -> str:
    """Write the program of a toolpath, in mm in the frame of the pad, transformed into the arm's base by `at`.

    Along a fibre the tip rounds the corners by arcs within the toolpath's tolerance. While the pose of the pad is
    unknown, the program says so and ends before anything moves.
    """
    dispenser = plan.settings.dispenser
    pose, dynamics = dispenser.arm_pose or (0.0,) * 6, _dynamics(dispenser.travel_mm_s, dispenser)
    lines = [
        "def padforge_laying():",
        *(f"  # {line}" for line in summary_lines(plan, steps)),
        "  # the TCP is the mouth of the needle; pad is the middle of its upper face in the base of the arm, m and rad",
        f"  pad = p[{', '.join(f'{value:.10g}' for value in pose)}]",
        *([_popup(_UNKNOWN), "  halt"] if dispenser.arm_pose is None else []),
        "  def at(x, y, z):",
        f"    return pose_trans(pad, p[x / 1000, y / 1000, z / 1000, {math.pi:.9f}, 0, 0])",
        "  end",
        _popup("needle over the pad, all its ways free?"),
        "  here = pose_trans(pose_inv(pad), get_actual_tcp_pose())",
        f"  movel(at(here[0] * 1000, here[1] * 1000, {format_mm(dispenser.travel_height_mm)}), {dynamics})",
        *(line for instruction in build_instructions(plan, steps) for line in _lines(instruction, dispenser)),
        "end",
        "",
    ]
    return "\n".join(lines)


def _lines(instruction: Instruction, dispenser: DispenserSettings) -> Iterator[str]:
    if isinstance(instruction, Pause):
        yield _popup(instruction.message)
    elif isinstance(instruction, LinearMove):
        position = format_mm(*instruction.position_mm)
        yield f"  movel(at({position}), {_dynamics(instruction.speed_mm_s, dispenser)})"
    else:
        corners = np.round(instruction.positions_mm, 3)
        feeds, blends = instruction.feeds_mm_s.tolist(), _blend_radii(corners).tolist()
        for (x, y), feed, blend in zip(corners[1:].tolist(), feeds, blends, strict=True):
            position = format_mm(x, y, instruction.z_mm)
            yield f"  movep(at({position}), {_dynamics(feed, dispenser)}, r={blend / 1000:.7g})"


def _blend_radii(corners: Array) -> Array:
    """Compute the distance (n - 1,) from each corner but the first to the start of its arc, mm; 0 at the end.

    An arc that starts b from a corner where the path turns by t passes the corner at b tan(t / 4).
    """
    steps = np.diff(corners, axis=0)
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
