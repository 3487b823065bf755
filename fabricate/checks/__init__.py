"""Findings of the checks: name, status, measured value, limit, message and positions."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

Status = Literal["pass", "warn", "fail"]
Number = float | list[float]
Position = tuple[float, float]


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        name: name of the check.
        status: "pass", "warn" (it works, with care) or "fail".
        measured: measured value, in the unit of the message; mm unless it names another.
        limit: limit of the measured value, in the same unit.
        message: one sentence for the user.
        positions_mm: (x, y) from the pad's centre, or in the frame of a mesh file; empty if there is none.
    """

    name: str
    status: Status
    measured: Number
    limit: Number
    message: str
    positions_mm: tuple[Position, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as JSON, positions rounded to the micrometre."""
        return asdict(self) | {"positions_mm": [[round(x, 3), round(y, 3)] for x, y in self.positions_mm]}


def check_result(
    name: str, status: Status | bool, measured: Number, limit: Number, message: str, positions: Iterable[Any] = ()
) -> Finding:
    """Return a finding; `status` may also be whether the check passes, `positions` any sequence of (x, y), mm."""
    if not isinstance(status, str):
        status = "pass" if status else "fail"
    return Finding(name, status, measured, limit, message, tuple((float(x), float(y)) for x, y in positions))


def grade(measured: float, limit: float) -> Status:
    """Grade a thickness: pass from `limit` up, warn below it, fail at 0 and below."""
    return "pass" if measured >= limit - 1e-9 else "warn" if measured > 0 else "fail"
