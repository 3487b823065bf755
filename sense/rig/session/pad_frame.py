"""Where the pad lies before the arm: from places on the pad to poses of the tool and back."""

import math
from dataclasses import dataclass

import numpy as np

from padforge.sense.recordings.processing.limits import Array
from padforge.sense.rig.devices.protocols import Pose, RigFault
from padforge.sense.settings import RigSettings


@dataclass(frozen=True)
class Frame:
    """The pad's frame in the arm's base frame.

    Attributes:
        centre_mm: of the pad, x and y. turn_rad: from the base's y axis to the pad's.
        contact_mm: height of the pad's surface. tool_rad: rotation vector of the tool.
        mirrored: whether the pad lies with its tracks up: its y axis as on the plan, its x axis the other way.
    """

    centre_mm: tuple[float, float]
    turn_rad: float
    contact_mm: float
    tool_rad: tuple[float, float, float]
    mirrored: bool = False

    @classmethod
    def of(cls, rig: RigSettings) -> "Frame":
        """The frame that `[rig]` says; raises RigFault where the contact height or the pad's place is unknown."""
        if rig.contact_mm is None:
            raise RigFault(
                "refused",
                "[rig] contact_mm is unknown, allowed is the height of the pad's surface in the base frame",
                "touch the pad with the tool by hand and note its z",
            )
        if rig.pad_mm is None:
            raise RigFault(
                "refused",
                "[rig] pad_mm is unknown, allowed are x and y of the pad's centre in the base frame",
                "jog the tool to the middle of the pad and note its x and y",
            )
        return cls(rig.pad_mm, math.radians(rig.pad_angle_deg), rig.contact_mm, rig.tool_rad, bool(rig.mirrored))

    def pose(self, place_mm: Array, depth_mm: float) -> Pose:
        """The tool's pose at a place (2,) on the pad's plan, `depth_mm` below its surface (above: less than 0)."""
        x, y = np.asarray(place_mm, dtype=np.float64) @ self._axes + self.centre_mm
        return (float(x), float(y), self.contact_mm - depth_mm, *self.tool_rad)

    def tip(self, poses: Array) -> tuple[Array, Array]:
        """Places (n, 2) on the pad's plan and depths (n,) of poses (n, 3 or more), mm."""
        places = (poses[:, :2] - self.centre_mm) @ self._axes.T
        return places, self.contact_mm - poses[:, 2]

    @property
    def _axes(self) -> Array:
        """(2, 2) the axes of the plan, x and y, in the base frame, a row each."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return np.array([[-c, -s] if self.mirrored else [c, s], [-s, c]])
