"""A recording as messages of ROS 2: which topics there are, and what their messages say.

Numbers are in the units that ROS has by REP 103: m, N, V. Places lie in the frame `pad`: its origin is the middle of
the pad, x and y run as on the plan, z points away from the surface; of a pad that lay mirrored into it, for the frame
to be right-handed there too. A press has its messages at the reading that follows its begin or its end.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.validation import InputError
from padforge.sense.recordings.processing.limits import Array
from padforge.sense.recordings.recording import Recording

READINGS, PRESSED, PLACE = "/pad/readings", "/pad/pressed", "/pad/place"
REACHED, FORCE, RECORDING = "/pad/reached", "/pad/force", "/pad/recording"
TOUCHES, HEALTH, ARM = "/pad/touches", "/pad/health", "/arm/pose"
FRAME, ARM_FRAME = "pad", "base"
KINDS = {
    READINGS: "std_msgs/msg/Float64MultiArray",
    PRESSED: "std_msgs/msg/Bool",
    PLACE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    REACHED: "geometry_msgs/msg/PointStamped",
    FORCE: "geometry_msgs/msg/WrenchStamped",
    RECORDING: "std_msgs/msg/String",
    TOUCHES: "geometry_msgs/msg/PoseWithCovarianceStamped",
    HEALTH: "diagnostic_msgs/msg/DiagnosticArray",
    ARM: "geometry_msgs/msg/PoseStamped",
}
UNITS = {
    READINGS: "V, one value for each fibre; NaN where one is missing",
    PRESSED: "true while the probe is sent down",
    PLACE: "m, z is minus the depth commanded (plus, where the pad lay mirrored: frames are right-handed); "
    "covariance 0 is as commanded, -1 not known; unknown places are left out",
    REACHED: "m, z is minus the depth that the arm found itself at",
    FORCE: "N on the probe, along z",
    RECORDING: "what the messages round off, as JSON: times in s, places and depths in mm, forces in N",
    TOUCHES: "m, places found by a model, with their variances in m^2; -1 where depth was not learnt",
    HEALTH: "which fibre is at fault, by a model",
    ARM: "m and a quaternion, pose of the tool in the frame of the arm",
}
"""What is said of each topic in the bag."""
X, Y, Z = (f"pose.pose.position.{axis}" for axis in "xyz")
COVARIANCE = "pose.covariance"
NOT_KNOWN = -1.0
"""A variance of what is not known, as in `sensor_msgs/msg/Imu`."""
R90 = 1.6449
"""Standard deviations that hold 90 % of a normal distribution, to both sides."""
_LONGEST_S = 2**31
"""Seconds that the stamp of a message can count."""


@dataclass(frozen=True)
class Stream:
    """Messages of one topic: (n,) stamps in ns, ascending, and the numbers in them, (n,) or (n, k) by their path."""

    stamps: NDArray[np.int64]
    fields: Mapping[str, NDArray[Any]]

    def same(self, other: "Stream") -> bool:
        """Whether the messages of another one say the same at the same times."""
        return np.array_equal(self.stamps, other.stamps) and all(
            np.array_equal(values, other.fields[path], equal_nan=True) for path, values in self.fields.items()
        )


def epoch_of(times_s: Array) -> float:
    """What is taken from (n,) times for stamps to count from 0: nothing, where stamps hold the times as they are.

    Raises:
        InputError: they last longer than stamps can count.
    """
    if times_s[-1] - times_s[0] >= _LONGEST_S - 2:
        raise InputError(f"recording lasts {times_s[-1] - times_s[0]:g} s, allowed in a bag are {_LONGEST_S - 2}")
    return 0.0 if times_s[0] >= 0 and times_s[-1] < _LONGEST_S - 1 else float(np.floor(times_s[0]))


def stamps_of(times_s: Array, epoch_s: float) -> NDArray[np.int64]:
    """(n,) times in ns since an epoch."""
    seconds = np.floor(times_s)
    return (seconds - epoch_s).astype(np.int64) * 10**9 + np.round((times_s - seconds) * 1e9).astype(np.int64)


def stamps_at(readings: NDArray[np.int64], indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Stamps of readings by their indices; a reading that was not taken would have come one step after the last."""
    step = max(int(readings[-1] - readings[-2]), 1)
    return np.append(readings, readings[-1] + step)[indices]


def streams_of(recording: Recording, epoch_s: float) -> dict[str, Stream]:
    """What a recording says, by its topics; those without a message are left out."""
    stamps = stamps_of(recording.times_s, epoch_s)
    begun, lifted = (stamps_at(stamps, indices) for indices in (recording.begun, recording.lifted))
    metres = recording.presses_mm / 1000
    deep = ~np.isnan(recording.depths_mm)
    variances = np.zeros((len(begun), 36))
    variances[~deep, 14] = NOT_KNOWN
    places = {X: metres[:, 0], Y: metres[:, 1], Z: heights(recording, recording.depths_mm), COVARIANCE: variances}
    heights_m = heights(recording, recording.reached_mm)
    reached = {"point.x": metres[:, 0], "point.y": metres[:, 1], "point.z": heights_m}
    forces = {"wrench.force.z": _up(recording) * recording.forces_n}
    streams = {
        READINGS: Stream(stamps, {"data": recording.readings}),
        PRESSED: Stream(
            np.column_stack([begun, lifted]).ravel(), {"data": np.tile(np.array([1, 0], np.uint8), len(begun))}
        ),
        PLACE: _where(recording.known, begun, places),
        REACHED: _where(~np.isnan(recording.reached_mm), begun, reached),
        FORCE: _where(~np.isnan(recording.forces_n), begun, forces),
    }
    return {topic: stream for topic, stream in streams.items() if len(stream.stamps)}


def heights(recording: Recording, depths_mm: Array) -> Array:
    """Where on z depths below the surface are, m; 0 where they are unknown."""
    return 0 - _up(recording) * np.nan_to_num(depths_mm) / 1000


def _up(recording: Recording) -> float:
    """Which way z has to point from the surface, for x and y of the plan to be right-handed with it."""
    return -1.0 if recording.mirrored else 1.0


def _where(there: NDArray[np.bool_], stamps: NDArray[np.int64], fields: Mapping[str, Array]) -> Stream:
    return Stream(stamps[there], {path: values[there] for path, values in fields.items()})
