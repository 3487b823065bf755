"""The twin: the as-built model (digital twin) of a printed pad, identified from presses.

It holds the paths of the fibres, their wiring, and their response to a press. `padforge sense identify` estimates it
from a recording; searches design for its sensitivity profile, and simulations respond like it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.files import read_json, write_json
from padforge.common.validation import InputError, check_array, check_path, short_repr
from padforge.design.contact import check_presses
from padforge.design.kernels.element_signals import sum_elements
from padforge.design.kernels.geometry import EUCLIDEAN, profile_law
from padforge.design.morphology import Array, Morphology
from padforge.design.paths.curves import lengths
from padforge.design.settings import Contact

FORMAT = "padforge-twin/1"
PARTS = "held", "onset", "creep", "after"  # parts of a press
MAX_ELEMENT_LENGTH = 0.02  # length of the elements that an as-built fibre is summed over, grid units
UNIFORM_SENSITIVITY_STD = 0.02  # of the log-sensitivity along a fibre: up to there it counts as uniform


def _convert(instance: object, to: Callable[[Any], Any], *names: str) -> None:
    """Convert fields of a frozen dataclass, such as lists that a file has, unless they are None."""
    for name in names:
        if (value := getattr(instance, name)) is not None:
            object.__setattr__(instance, name, to(value))


def _to_array(values: ArrayLike) -> Array:
    return np.array(values, dtype=np.float64)


def _to_rows(rows: Sequence[ArrayLike | None]) -> tuple[Array | None, ...]:
    return tuple(None if row is None else _to_array(row) for row in rows)


@dataclass(frozen=True)
class PlanTransform:
    """Similarity transform from the arm's frame to the plan: scale R(turn) mirror(p) + shift."""

    mirrored: bool = False  # whether x is reversed, as on a casting that was turned over
    turn_deg: float = 0.0  # rotation, counter-clockwise
    shift_mm: tuple[float, float] = (0.0, 0.0)  # translation, from the middle of the pad
    scale: float = 1.0  # mm of the plan per mm of the arm, > 0

    def __post_init__(self) -> None:
        _convert(self, tuple, "shift_mm")

    def to_plan(self, positions_mm: Array) -> Array:
        """Transform positions (Q, 2) of the arm to the plan, both in mm from the middle."""
        return self.scale * self.turned(positions_mm) + self.shift_mm

    def turned(self, positions_mm: Array) -> Array:
        """Mirror and rotate positions (Q, 2) of the arm, mm."""
        cos, sin = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        mirrored = positions_mm * ([-1.0, 1.0] if self.mirrored else [1.0, 1.0])
        return mirrored @ np.array([[cos, sin], [-sin, cos]])


@dataclass(frozen=True)
class TwinChannel:
    """A channel of the recording."""

    channel: int  # index, from 0
    fibre: int | None  # index of the fibre it reads, from 0 as in the knots; None where no fibre explains it
    gain_v: float  # V for a relative stretch of 1; below 0 where a press lowers the reading
    noise_v: float  # standard deviation of a response that neither position nor history explains, V
    explained: float  # explained share of the variance of responses on held-out presses; 0 without a fibre


@dataclass(frozen=True)
class TwinScatter:
    """Part of the scatter of responses that grows with them."""

    share: float = 0.0  # standard deviation of a response from press to press, as a share of the response
    common: float = 0.0  # share of that variance that all channels have in common
    floor: float = 1.0  # standard deviation of the additive part, as a share of a channel's `noise_v`


@dataclass(frozen=True)
class TwinReadings:
    """Statistics of the readings, for simulations; fields as in `[rig]`."""

    noise_mv: float  # standard deviation of the white noise of a reading
    drift_mv: float  # standard deviation of the drifting baseline
    hysteresis_s: float  # time constant by which the residue of a press decays
    memory: float = 0.0  # share of the residue of a press that another press at its position removes
    memory_mm: float = 9.0  # distance over which that share falls
    gain_wander: float = 0.0  # standard deviation of changes of the gains over minutes
    touch_s: float = 0.0  # standard deviation over the pad of the time of the touch


@dataclass(frozen=True)
class TwinPart:
    """Response of the fibres to one part of a press, without the residues of earlier presses that it removes.

    The fields are as of `Twin`.
    """

    distance_mm: Array
    weight: Array
    gains_v: Array  # of each channel, V for a relative stretch of 1; shape (C,)
    angular_weight: Array | None = None
    sensitivity: tuple[Array | None, ...] | None = None

    def __post_init__(self) -> None:
        _convert(self, _to_array, "distance_mm", "weight", "gains_v", "angular_weight")
        _convert(self, _to_rows, "sensitivity")

    def contact(self) -> Contact:
        """Return the contact of which this is the profile."""
        return _profile_contact(self.distance_mm, self.weight)


@dataclass(frozen=True)
class TwinResidual:
    """Smooth function of the position by which the measured parts of a press differ from the predicted ones."""

    middle_mm: tuple[float, float]  # centre of the square on which it is sampled, in the arm's frame
    half_mm: float  # half of its side
    volts: Array  # on a grid over the square, x before y; shape (parts, C, n, n), in the order of `PARTS`

    def __post_init__(self) -> None:
        _convert(self, tuple, "middle_mm")
        _convert(self, _to_array, "volts")


@dataclass(frozen=True)
class Twin:
    """As-built model of a printed pad.

    Attributes:
        morphology: the pad as planned.
        channels: one for each channel of the recording.
        frame: position of the pad under the arm.
        distance_mm: distances of the sensitivity profile; shape (n,).
        weight: sensitivity of a fibre element to a press at that distance, 1 at its largest, 0 at the end; shape (n,).
        as_built_mm: centre line of each fibre as built, on the plan from its middle; shape (P, 2); None for a fibre
            that no channel reads.
        noise: standard deviation of a response that neither position nor history explains, as a share of full scale.
        sensed_mm: width and height of what was pressed, along the axes of the plan.
        presses: number of presses it was identified from.
        angular_weight: amplitude of a term of `weight` in cos 2 phi, phi the angle between fibre and direction to the
            press; shape (n,); None where the response does not depend on it.
        sensitivity: sensitivity of each piece of each fibre, about 1; shape (P - 1,); None where it is uniform.
        provenance: origin of the twin; free JSON.
        readings: statistics of the readings; None where they were not measured.
        scatter: part of `noise`, and of the channels' noise, that grows with the response.
        parts: of a press, by name in `PARTS`; none where there were too few presses.
        residual: what the fibres do not explain of the parts; None where there are none.
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
    parts: Mapping[str, TwinPart] = field(default_factory=dict)
    residual: TwinResidual | None = None

    def __post_init__(self) -> None:
        _convert(self, _to_array, "distance_mm", "weight", "angular_weight")
        _convert(self, _to_rows, "as_built_mm", "sensitivity")
        _convert(self, tuple, "sensed_mm")
        for part in (self, *self.parts.values()):
            part.contact()  # refuses a profile that no search could design for

    def contact(self) -> Contact:
        """Return the measured contact."""
        return _profile_contact(self.distance_mm, self.weight)

    def ignored_effects(self) -> str | None:
        """Describe effects measured on this pad that do not hold for other pads; None if there are none."""
        effects = ["the dependence on the angle between fibre and press"] if self.angular_weight is not None else []
        stds = [np.log(np.maximum(row, 1e-3)).std() for row in self.sensitivity or () if row is not None]
        if stds and max(stds) > UNIFORM_SENSITIVITY_STD:
            effects.append(f"the uneven sensitivity along its fibres ({np.mean(stds):.0%})")
        return f"not carried over to another pad: {' and '.join(effects)}" if effects else None

    def as_built_stretch(self, positions_mm: ArrayLike, part: str | None = None) -> Array:
        """Compute the relative stretch of the as-built fibres: signal over planned length.

        Fibres are summed over elements of at most MAX_ELEMENT_LENGTH, within about 1e-4 of the integral.

        Args:
            positions_mm: presses in the arm's frame; shape (Q, 2), mm.
            part: a name in `parts`; None for the whole response, with what history adds to it on average.

        Returns:
            Relative stretch; shape (Q, F); 0 for a fibre that no channel reads.

        Raises:
            InputError: the twin has no such part, or positions are not (Q, 2).
        """
        if part is not None and part not in self.parts:
            raise InputError(f"part is {short_repr(part)}, allowed are {', '.join(self.parts) or 'none, of this twin'}")
        pressed_mm = check_array("positions_mm", positions_mm)
        if pressed_mm.shape[1:] != (2,):
            raise InputError(f"positions_mm have shape {pressed_mm.shape}, expected (Q, 2)")
        presses, _ = check_presses(self.morphology.to_grid(self.frame.to_plan(pressed_mm)))
        profile = self if part is None else self.parts[part]
        angular = np.zeros_like(profile.weight) if profile.angular_weight is None else profile.angular_weight
        distance = profile.distance_mm / self.morphology.unit_mm
        # cos 2 phi = 2 cos^2 phi - 1
        law = profile_law(EUCLIDEAN, ((distance, profile.weight - angular, 2 * angular),))
        out = np.zeros((len(presses), len(self.as_built_mm)))
        for fibre, path in enumerate(self.as_built_mm):
            if path is not None:
                sensitivity = None if profile.sensitivity is None else profile.sensitivity[fibre]
                out[:, fibre] = sum_elements(*_cut(self.morphology.to_grid(path), sensitivity), presses, law, 0)
        return out / lengths(self.morphology)

    @classmethod
    def load(cls, path: str | Path) -> "Twin":
        """Read a twin.

        Args:
            path: a `twin.json`.

        Raises:
            InputError: the file is missing, torn or of another kind.
        """
        document = read_json(path := check_path("path", path), FORMAT)
        try:
            return cls(
                morphology=Morphology.from_dict(document["morphology"]),
                channels=tuple(TwinChannel(**channel) for channel in document["channels"]),
                frame=PlanTransform(**document["frame"]),
                **_profile_from(document),
                as_built_mm=document["as_built_mm"],
                noise=document["noise"],
                sensed_mm=document["sensed_mm"],
                presses=document["presses"],
                provenance=document.get("provenance", {}),
                readings=TwinReadings(**document["readings"]) if document.get("readings") else None,
                scatter=TwinScatter(**document["scatter"]),
                parts={
                    name: TwinPart(gains_v=part["gains_v"], **_profile_from(part))
                    for name, part in document["parts"].items()
                },
                residual=TwinResidual(**document["residual"]) if document["residual"] else None,
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path}: no valid twin ({error!r})") from error
        except ValueError as error:
            raise InputError(f"{path}: {error}") from error

    def save(self, path: str | Path) -> None:
        """Write the twin atomically.

        Args:
            path: a `twin.json`.
        """
        document = {
            "format": FORMAT,
            "morphology": self.morphology.to_dict(),
            "channels": [asdict(channel) for channel in self.channels],
            "frame": asdict(self.frame),
            "as_built_mm": _round_rows(self.as_built_mm),
            **_profile_document(self),
            "parts": {
                name: {"gains_v": part.gains_v.tolist(), **_profile_document(part)} for name, part in self.parts.items()
            },
            "residual": self.residual and asdict(self.residual) | {"volts": np.round(self.residual.volts, 6).tolist()},
            "noise": self.noise,
            "scatter": asdict(self.scatter),
            "sensed_mm": list(self.sensed_mm),
            "presses": self.presses,
            "provenance": dict(self.provenance),
        } | ({"readings": asdict(self.readings)} if self.readings else {})
        write_json(check_path("path", path), document)


def _profile_contact(distance_mm: Array, weight: Array) -> Contact:
    points = zip(distance_mm.tolist(), weight.tolist(), strict=True)
    return Contact(sensitivity_profile=tuple(points), length="euclidean")


def _profile_document(part: "Twin | TwinPart") -> dict[str, Any]:
    """Return the sensitivity profile, and the sensitivity along the fibres, as JSON."""
    profile = {name: getattr(part, name) for name in ("distance_mm", "weight", "angular_weight")}
    return {
        "sensitivity_profile": {name: row.tolist() for name, row in profile.items() if row is not None},
        "sensitivity": None if part.sensitivity is None else _round_rows(part.sensitivity),
    }


def _profile_from(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a twin or its part that `_profile_document` wrote."""
    return dict(document["sensitivity_profile"]) | {"sensitivity": document["sensitivity"]}


def _round_rows(rows: Sequence[Array | None]) -> list[list[Any] | None]:
    return [None if row is None else np.round(row, 4).tolist() for row in rows]


def _cut(path: Array, sensitivity: Array | None) -> tuple[Array, Array, Array]:
    """Return the middles (n, 2), lengths times sensitivity (n,) and unit tangents (n, 2) of a path's elements."""
    step = np.diff(path, axis=0)
    size = np.hypot(*step.T)
    counts = np.maximum(np.ceil(size / MAX_ELEMENT_LENGTH), 1).astype(int)
    piece = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(piece)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[piece]
    tangents = step / np.maximum(size, 1e-12)[:, None]
    weighted = size if sensitivity is None else sensitivity * size
    return path[piece] + share[:, None] * step[piece], (weighted / counts)[piece], tangents[piece]
