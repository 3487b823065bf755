"""What a check found: one finding each, with what was measured, what is allowed and where."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

Status = Literal["pass", "warn", "fail"]
Number = float | list[float]
Place = tuple[float, float]


@dataclass(frozen=True)
class Finding:
    """The outcome of one check.

    Attributes:
        name: of the check.
        status: "pass", "warn" (it works, with care) or "fail".
        measured, limit: in the unit the message says; mm unless it says otherwise.
        message: one sentence for people.
        positions_mm: where, in mm from the pad's centre (or in the frame of a mesh file); empty where a place means
            nothing.
    """

    name: str
    status: Status
    measured: Number
    limit: Number
    message: str
    positions_mm: tuple[Place, ...] = ()

    def document(self) -> dict[str, Any]:
        """The finding as JSON, places rounded to the micrometre."""
        return asdict(self) | {"positions_mm": [[round(x, 3), round(y, 3)] for x, y in self.positions_mm]}


def grade(measured: float, limit: float) -> Status:
    """Pass from `limit` up, warn below it, fail where nothing is left."""
    return "pass" if measured >= limit - 1e-9 else "warn" if measured > 0 else "fail"


def check_result(
    name: str, passed: bool, measured: Number, limit: Number, message: str, places: Iterable[Any] = ()
) -> Finding:
    """A finding that passes or fails."""
    return Finding(name, "pass" if passed else "fail", measured, limit, message, as_places(places))


def as_places(places: Iterable[Any]) -> tuple[Place, ...]:
    """Pairs of coordinates of any kind, mm, as plain floats."""
    return tuple((float(x), float(y)) for x, y in places)
