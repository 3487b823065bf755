"""The twin of a printed pad: how it was laid and wired, and what a press really does to it, as presses have shown.

`padforge sense identify` finds one from a recording; searches design for its reach, simulations answer like it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.files import read_json, write_json
from padforge.design.common.validation import (
    InputError,
    check_array,
    check_float,
    check_int,
    check_mapping,
    check_type,
    short_repr,
)
from padforge.design.common.validation import check_path as as_path
from padforge.design.contact import check_presses
from padforge.design.kernels.geometry import profile_coefficients, profile_weights
from padforge.design.morphology import Array, Morphology
from padforge.design.paths.curves import lengths
from padforge.design.settings import Contact

FORMAT = "padforge-twin/3"
MAX_VOLTS, MAX_MM = 1e3, 1e4
MAX_INFORMATION_GAIN = 1e3
MAX_CHANNELS = 1024
MAX_ELEMENT_LENGTH = 0.02
"""Longest element by which a laid fibre is summed, grid units."""
UNIFORM_SENSITIVITY_STD = 0.02
"""Standard deviation of the logarithm of a fibre's sensitivity that is none."""
MAX_ELEMENTS = 2**23
"""Of all fibres: 256 + 256 of them, as many as a recording may have, are 6.6 million."""


@dataclass(frozen=True)
class PlanTransform:
    """How a pad lay under the arm: a press at p mm was made at scale turn(mirror(p)) + shift of the plan.

    Attributes:
        mirrored: whether x counts the other way, as it does on a casting that was turned over.
        turn_deg: counter-clockwise. shift_mm: from the pad's middle. scale: mm of the plan for a mm of the arm, > 0.
    """

    mirrored: bool = False
    turn_deg: float = 0.0
    shift_mm: tuple[float, float] = (0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        check_type("mirrored", self.mirrored, bool)
        object.__setattr__(self, "turn_deg", check_float("turn_deg", self.turn_deg, -360, 360))
        shift = check_array("shift_mm", self.shift_mm, MAX_MM)
        if shift.shape != (2,):
            raise InputError(f"shift_mm is {short_repr(self.shift_mm)}, expected two numbers")
        object.__setattr__(self, "shift_mm", tuple(shift.tolist()))
        object.__setattr__(self, "scale", check_float("scale", self.scale, 0.1, 10))

    def to_plan(self, places_mm: Array) -> Array:
        """(Q, 2) mm as the arm counts to (Q, 2) mm on the plan, both from the middle."""
        return self.scale * self.turned(places_mm) + self.shift_mm

    def turned(self, places_mm: Array) -> Array:
        """(Q, 2) mm as the arm counts, mirrored and turned."""
        cos, sin = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        mirrored = places_mm * ([-1.0, 1.0] if self.mirrored else [1.0, 1.0])
        return mirrored @ np.array([[cos, sin], [-sin, cos]])


@dataclass(frozen=True)
class TwinChannel:
    """What a channel of the recording reads.

    Attributes:
        channel: from 0. fibre: which one it reads, from 0 as in the knots; None where no fibre explains it.
        gain_v: V for a relative stretch of 1, the signal of the fibre over its length; below 0 where a press lowers
            the reading.
        noise_v: standard deviation of a response that neither place nor history explains, V.
        explained: share of the variance of responses on presses held out; 0 where there is no fibre.
    """

    channel: int
    fibre: int | None
    gain_v: float
    noise_v: float
    explained: float

    def __post_init__(self) -> None:
        check_int("channel", self.channel, 0, MAX_CHANNELS)
        if self.fibre is not None:
            check_int("fibre", self.fibre, 0, MAX_CHANNELS)
        for name, least in (("gain_v", -MAX_VOLTS), ("noise_v", 0.0)):
            object.__setattr__(self, name, check_float(name, getattr(self, name), least, MAX_VOLTS))
        object.__setattr__(self, "explained", check_float("explained", self.explained, -1e9, 1))


@dataclass(frozen=True)
class TwinScatter:
    """What of the scatter of responses grows with them.

    Attributes:
        share: standard deviation of a response from press to press, share of the response.
        common: share of that variance that all channels have in common.
        floor: standard deviation of what does not grow, share of a channel's `noise_v`.
    """

    share: float = 0.0
    common: float = 0.0
    floor: float = 1.0

    def __post_init__(self) -> None:
        for name, most in (("share", 1), ("common", 0.99), ("floor", 1)):
            object.__setattr__(self, name, check_float(name, getattr(self, name), 0, most))


@dataclass(frozen=True)
class TwinReadings:
    """How the twin's readings run beside what presses answer, for simulations.

    Attributes:
        noise_mv: white noise of a reading. drift_mv: spread of the drifting rest; both standard deviations.
        hysteresis: share of its answer that a press leaves behind, the other way round. hysteresis_s: in which time
            that goes.
        information_gain: Fisher information on the position in all readings of a press, as a multiple of that in the
            twin's responses with their `noise_v`; 1 or more.
    """

    noise_mv: float
    drift_mv: float
    hysteresis: float
    hysteresis_s: float
    information_gain: float = 1.0

    def __post_init__(self) -> None:
        limits = (("noise_mv", 0, 1e3), ("drift_mv", 0, 1e3), ("hysteresis", 0, 0.99), ("hysteresis_s", 0.01, 1e4))
        for name, least, most in (*limits, ("information_gain", 1, MAX_INFORMATION_GAIN)):
            object.__setattr__(self, name, check_float(name, getattr(self, name), least, most))


@dataclass(frozen=True)
class Twin:
    """A printed pad as presses have shown it.

    Attributes:
        morphology: as it was planned. channels: one for each channel of the recording. frame: how it lay.
        distance_mm, weight: (n,) how a fibre element answers a press at that distance, 1 at its largest, 0 at the end.
        as_built_mm: for each fibre of the plan its course as laid, (P, 2) mm on the plan from its middle; None where no
            channel reads it.
        angular_weight: (n,) what is added to `weight` times cos 2 phi, phi the angle between the fibre and the way to
            the press; None where the answer does not depend on it.
        sensitivity: for each fibre how much a piece of it counts, (P - 1,) about 1; None where all count alike.
        noise: standard deviation of a response that neither place nor history explains, share of full scale.
        sensed_mm: width and height of what was pressed, along the axes of the plan.
        presses: learnt from. provenance: free JSON. readings: how they run, None where nobody measured that.
        scatter: what of `noise` and of the channels' grows with the response.

    Raises:
        InputError: what does not fit together, or is out of range.
    """

    morphology: Morphology
    channels: tuple[TwinChannel, ...]
    frame: PlanTransform
    distance_mm: Array
    weight: Array
    as_built_mm: tuple[Array | None, ...]
    noise: float
    sensed_mm: tuple[float, float]
    presses: int
    angular_weight: Array | None = None
    sensitivity: tuple[Array | None, ...] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict, compare=False)
    readings: TwinReadings | None = None
    scatter: TwinScatter = TwinScatter()

    def __post_init__(self) -> None:
        fibres = len(check_type("morphology", self.morphology, Morphology).knots)
        _refuse_wiring([channel.fibre for channel in self.channels if channel.fibre is not None], fibres)
        for name in ("distance_mm", "weight", *(["angular_weight"] if self.angular_weight is not None else [])):
            object.__setattr__(self, name, check_array(name, getattr(self, name), MAX_MM))
            if getattr(self, name).shape != (len(self.distance_mm),):
                raise InputError(f"{name} of reach must be a row of {len(self.distance_mm)} numbers, as distance_mm is")
        laid = tuple(None if line is None else check_array("as_built_mm", line, MAX_MM) for line in self.as_built_mm)
        if len(laid) != fibres or any(line is not None and line.shape[1:] != (2,) for line in laid):
            raise InputError(f"as_built_mm must have a row of points or null for each of the {fibres} fibres")
        length = sum(float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in laid if line is not None)
        if length > (most := MAX_ELEMENTS * MAX_ELEMENT_LENGTH * self.morphology.unit_mm):
            raise InputError(f"as_built_mm are {length:.3g} mm long in all, allowed are {most:.3g}")
        object.__setattr__(self, "as_built_mm", laid)
        if self.sensitivity is not None:
            found = tuple(None if row is None else check_array("sensitivity", row, MAX_MM) for row in self.sensitivity)
            pieces = [None if line is None else (len(line) - 1,) for line in laid]
            if [None if row is None else row.shape for row in found] != pieces:
                raise InputError("sensitivity must have a number for each piece of each course in as_built_mm")
            object.__setattr__(self, "sensitivity", found)
        object.__setattr__(self, "noise", check_float("noise", self.noise, 1e-9, 10))
        sensed = check_array("sensed_mm", self.sensed_mm, MAX_MM)
        if sensed.shape != (2,) or sensed.min() <= 0:
            raise InputError(f"sensed_mm is {short_repr(self.sensed_mm)}, expected width and height above 0")
        object.__setattr__(self, "sensed_mm", tuple(sensed.tolist()))
        check_int("presses", self.presses, 1, 2**53)
        check_mapping("provenance", self.provenance)
        self.contact()

    def contact(self) -> Contact:
        """The measured contact."""
        points = zip(self.distance_mm.tolist(), self.weight.tolist(), strict=True)
        return Contact(sensitivity_profile=tuple(points), length="euclidean")

    def ignored_effects(self) -> str | None:
        """Say what of the measured pad no other pad is designed for, or simulated with; None if there is nothing."""
        parts = ["that the angle between fibre and press counts"] if self.angular_weight is not None else []
        uneven = [np.log(np.maximum(row, 1e-3)).std() for row in self.sensitivity or () if row is not None]
        if uneven and max(uneven) > UNIFORM_SENSITIVITY_STD:
            parts.append(f"that fibres answer unevenly along themselves (by {np.mean(uneven):.0%})")
        return f"left out of another pad than the one measured: {' and '.join(parts)}" if parts else None

    def as_built_stretch(self, places_mm: ArrayLike) -> Array:
        """(Q, F) relative stretch of the fibres as laid by presses at (Q, 2) mm as the arm counts.

        It is their signal over the length of the fibre on the plan; 0 for a fibre that no channel reads. Summed over
        elements of at most LONGEST, within some 1e-4 of the integral.
        """
        if (pressed_mm := check_array("places_mm", places_mm, MAX_MM)).shape[1:] != (2,):
            raise InputError(f"places_mm have shape {pressed_mm.shape}, expected (Q, 2)")
        places, _ = check_presses(self.morphology.to_grid(self.frame.to_plan(pressed_mm)))
        reach = self.contact().profile_points(self.morphology.unit_mm)
        profiles = [profile_coefficients(reach)]
        if self.angular_weight is not None:
            points = zip((d for d, _ in reach), self.angular_weight.tolist(), strict=True)
            profiles.append(profile_coefficients(tuple(points)))
        out = np.zeros((len(places), len(self.as_built_mm)))
        for fibre, line in enumerate(self.as_built_mm):
            if line is not None:
                counts = None if self.sensitivity is None else self.sensitivity[fibre]
                elements = _elements(self.morphology.to_grid(line), counts)
                for press, place in enumerate(places):
                    out[press, fibre] = _answer(*elements, place, profiles, reach[-1][0])
        return out / lengths(self.morphology)

    @classmethod
    def load(cls, path: str | Path) -> "Twin":
        """Read a `twin.json`.

        Raises:
            InputError: the file is missing, torn, of another kind, or what it holds does not fit together.
        """
        document = read_json(path := as_path("path", path), FORMAT)
        try:
            profile = document["sensitivity_profile"]
            return cls(
                Morphology.from_dict(document["morphology"]),
                tuple(TwinChannel(**channel) for channel in document["channels"]),
                PlanTransform(**document["frame"]),
                profile["distance_mm"],
                profile["weight"],
                tuple(document["as_built_mm"]),
                document["noise"],
                document["sensed_mm"],
                document["presses"],
                profile.get("angular_weight"),
                None if document.get("sensitivity") is None else tuple(document["sensitivity"]),
                document.get("provenance", {}),
                TwinReadings(**document["readings"]) if document.get("readings") else None,
                TwinScatter(**document["scatter"]),
            )
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise InputError(f"{path}: no valid twin ({error!r})") from error
        except ValueError as error:
            raise InputError(f"{path}: {error}") from error

    def save(self, path: str | Path) -> None:
        """Write a `twin.json`, atomically."""
        pad = self.morphology
        document = {
            "format": FORMAT,
            "morphology": pad.to_dict(),
            "channels": [asdict(channel) for channel in self.channels],
            "frame": asdict(self.frame),
            "sensitivity_profile": {"distance_mm": self.distance_mm.tolist(), "weight": self.weight.tolist()}
            | ({} if self.angular_weight is None else {"angular_weight": self.angular_weight.tolist()}),
            "as_built_mm": _rounded(self.as_built_mm),
            "sensitivity": None if self.sensitivity is None else _rounded(self.sensitivity),
            "noise": self.noise,
            "scatter": asdict(self.scatter),
            "sensed_mm": list(self.sensed_mm),
            "presses": self.presses,
            "provenance": dict(self.provenance),
        } | ({"readings": asdict(self.readings)} if self.readings else {})
        write_json(as_path("path", path), document)


def _refuse_wiring(read: list[int], fibres: int) -> None:
    if read and max(read) >= fibres:
        raise InputError(f"a channel reads fibre {max(read)}, allowed are 0 to {fibres - 1}")
    if len(set(read)) < len(read):
        raise InputError("two channels read the same fibre")


def _rounded(rows: Sequence[Array | None]) -> list[list[Any] | None]:
    return [None if row is None else np.round(row, 4).tolist() for row in rows]


def _elements(line: Array, counts: Array | None) -> tuple[Array, Array, Array]:
    """Middles (n, 2), lengths times what they count (n,) and unit tangents (n, 2) of elements up to LONGEST.

    Args:
        line: (P, 2) a polyline. counts: (P - 1,) of each piece; None where all count alike.
    """
    along = np.diff(line, axis=0)
    size = np.hypot(*along.T)
    parts = np.maximum(np.ceil(size / MAX_ELEMENT_LENGTH), 1).astype(int)
    which = np.repeat(np.arange(len(parts)), parts)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts) + 0.5) / parts[which]
    tangents = along / np.maximum(size, 1e-12)[:, None]
    return (
        line[which] + share[:, None] * along[which],
        ((size if counts is None else counts * size) / parts)[which],
        tangents[which],
    )


def _answer(
    middles: Array, lengths: Array, tangents: Array, place: Array, profiles: Sequence[Array], end: float
) -> float:
    """What elements signal for a press at `place` (2,), by the profiles of the weight and of its angle's part."""
    off = middles - place
    far = np.hypot(*off.T)
    near = far < end
    weights = profile_weights(profiles[0], end, far[near])
    for angled in profiles[1:]:
        along = (off[near] * tangents[near]).sum(axis=1)
        weights = weights + profile_weights(angled, end, far[near]) * (2 * along**2 / (far[near] ** 2 + 1e-6) - 1)
    return float(weights @ lengths[near])
