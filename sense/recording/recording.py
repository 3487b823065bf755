"""Recordings: what the fibres gave while a probe pressed known places, as read from a run directory (`recorder`)."""

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import locked, read_json, reraise_write_error, sync, temporary_folder
from padforge.design.common.validation import InputError, check_type, short_repr
from padforge.design.common.validation import check_path as as_path
from padforge.sense import arrays as limits
from padforge.sense.arrays import Array, Indices, Mask
from padforge.sense.recording.block_file import read_blocks
from padforge.sense.recording.run_directory import (
    FILES,
    FORMAT,
    JOURNAL,
    READINGS,
    START,
    Press,
    Recorder,
    busy,
    fibres_of,
    read_journal,
    refuse_existing,
    unborn,
)

_ARRAYS = dict.fromkeys(("readings", "times_s", "presses_mm"), np.float64) | dict.fromkeys(
    ("down_command", "up_command"), np.int64
)
_MEASURED = {
    "depths_mm": (limits.MAX_MM, "mm"),
    "reached_mm": (limits.MAX_MM, "mm"),
    "forces_n": (limits.MAX_N, "N"),
}


@dataclass(frozen=True)
class Recording:
    """Readings of a pad and the presses made meanwhile.

    Attributes:
        readings: (R, C) volts, one row per reading, one column per fibre; NaN where one is missing.
        times_s: (R,) ascending, s.
        presses_mm: (Q, 2) places, mm from the pad's centre; NaN where a press's place is not known.
        down_command: (Q,) index of the first reading after the probe was sent down.
        up_command: (Q,) index of the first reading after it was sent up; R if none was taken.
        source: where the recording came from; free JSON.
        torn_presses: presses that were left out because the end of the stream was torn off.
        depths_mm: (Q,) how deep the probe was to go below the surface, mm, > 0; NaN where that is not known.
        reached_mm: (Q,) how deep an arm found itself while it held the press, mm; NaN where none told.
        forces_n: (Q,) force on the probe meanwhile, N, >= 0; NaN where no sensor told.

    Raises:
        InputError: no numbers, shapes that do not fit together, infinite values or such beyond the limits of
            `limits`, no reading at all, half a place, times that do not ascend, presses that overlap, one without a
            reading before it, depths or forces below 0, or a source that JSON cannot hold.
    """

    readings: Array
    times_s: Array
    presses_mm: Array
    down_command: Indices
    up_command: Indices
    source: Mapping[str, Any] = field(default_factory=dict, compare=False)
    torn_presses: int = field(default=0, compare=False)
    depths_mm: Array = field(default_factory=lambda: np.empty(0))
    reached_mm: Array = field(default_factory=lambda: np.empty(0))
    forces_n: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        for name, kind in _ARRAYS.items():
            self._keep(name, limits.check_numbers(getattr(self, name), kind, name))
        _validate(self)
        for name, (limit, unit) in _MEASURED.items():
            values = limits.check_numbers(getattr(self, name), np.float64, name)
            unknown = np.isnan(values).all()  # of however many: `replace` may have left some presses out
            self._keep(name, np.full(len(self.presses_mm), np.nan) if unknown else values)
            _validate_measured(self, name, limit, unit)

    def _keep(self, name: str, array: NDArray[Any]) -> None:
        array.setflags(write=False)
        object.__setattr__(self, name, array)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Recording):
            return NotImplemented
        names = (*_ARRAYS, *_MEASURED)
        return all(np.array_equal(getattr(self, name), getattr(other, name), equal_nan=True) for name in names)

    __hash__ = None  # type: ignore[assignment]

    @property
    def fibres(self) -> int:
        """C, the number of recorded fibres."""
        return self.readings.shape[1]

    @property
    def known(self) -> Mask:
        """(Q,) whether the place of each press is known."""
        return ~(np.isnan(self.presses_mm[:, 0]) | np.isnan(self.presses_mm[:, 1]))

    @property
    def deep_mm(self) -> Array:
        """(Q,) how deep each press was, mm: as reached, or else as commanded; NaN where neither is known."""
        return np.where(np.isnan(self.reached_mm), self.depths_mm, self.reached_mm)

    @property
    def measures(self) -> dict[str, Array]:
        """What else than its place is known of each press, by its name: (Q,) how deep and with which force it was."""
        return {"depth_mm": self.deep_mm, "force_n": self.forces_n}

    @property
    def mirrored(self) -> bool:
        """Whether `[rig]` said that the pad lay with its tracks up: seen from above, x ran to the left of y."""
        return is_mirrored(self.source)

    @property
    def rate_hz(self) -> float:
        """Readings per second, by the median interval."""
        return rate_of(self.times_s)

    @property
    def digest(self) -> str:
        """Hex SHA-256 of all readings and presses, wherever they are kept, and whether or not depth and force are."""
        digest = hashlib.sha256()
        for array in (getattr(self, name) for name in _ARRAYS):
            plain = np.where(np.isnan(array), np.nan, array) if array.dtype.kind == "f" else array  # one NaN of many
            digest.update(repr(array.shape).encode() + plain.tobytes())
        return digest.hexdigest()

    @classmethod
    def open(cls, path: str | Path) -> "Recording":
        """Read a run directory, finished or not; `import_export.open_recording` reads files as well.

        The torn tail of a run directory is cut off, with the presses it had.

        Raises:
            InputError: no run directory, a file damaged elsewhere than at its end, or no press in it.
        """
        path = as_path("path", path)
        fibres = fibres_of(path)
        start = read_json(path / START, FORMAT)
        rows, _ = read_blocks(path / READINGS, fibres)
        done = read_journal(path / JOURNAL)
        presses = [press for press in done.values() if press.up_command <= len(rows)]
        table = np.array(presses, dtype=np.float64).reshape(-1, len(Press._fields))
        try:
            return cls(
                readings=rows[:, 1:],
                times_s=rows[:, 0],
                presses_mm=table[:, :2],
                down_command=table[:, 2].astype(np.int64),
                up_command=table[:, 3].astype(np.int64),
                source=start.get("source", {}),
                torn_presses=len(done) - len(presses),
                depths_mm=table[:, 4],
                reached_mm=table[:, 5],
                forces_n=table[:, 6],
            )
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    def save(self, path: str | Path, provenance: Mapping[str, Any], replacing: bool = False) -> None:
        """Write a run directory that appears whole or not at all.

        Args:
            replacing: whether a simulated recording that is there gives way, see `refuse_replacing`.

        Raises:
            InputError: `check_path` exists and is not an empty directory (no other recording is written over, not even
            one
                that appeared meanwhile), or cannot be written.
        """
        refuse = refuse_replacing if check_type("replacing", replacing, bool) else refuse_existing
        refuse(path := as_path("path", path))
        path = path.resolve()
        with reraise_write_error(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary_folder(path.parent) as folder:
                self._write(folder / path.name, provenance)
                if replacing:
                    refuse(path)
                    with suppress(FileNotFoundError):
                        path.rename(folder / f"{path.name}-old")
                _put(folder / path.name, path)

    def _write(self, path: Path, provenance: Mapping[str, Any]) -> None:
        with Recorder(path, self.fibres, self.source, provenance) as recorder:
            recorder.append(self.times_s, self.readings)
            measured = np.column_stack([getattr(self, name) for name in _MEASURED]).tolist()
            edges = zip(self.presses_mm, self.down_command, self.up_command, measured, strict=True)
            for place, down_command, up_command, (depth, reached, force) in edges:
                recorder.begin(place, int(down_command), **({} if isnan(depth) else {"depth_mm": depth}))
                told = {} if isnan(reached) else {"at_mm": [None, None, reached]}
                recorder.finish(int(up_command), **told, **({} if isnan(force) else {"force_n": force}))


def _put(unfinished: Path, path: Path) -> None:
    """Rename a run directory to `check_path`, unless another came there first."""
    try:
        if path.exists():
            path.rmdir()
        unfinished.rename(path)
    except OSError:
        refuse_existing(path)
        raise
    sync(path.parent)


def refuse_replacing(path: Path) -> None:
    """Raise InputError if `check_path` holds anything but a simulated recording, which the same seed gives again.

    It is never a link, and nobody may be recording into it.
    """
    other = "choose another --out"
    if path.is_symlink():
        raise InputError(f"{path}: is a link, and none is followed where a recording is replaced; {other}")
    if not path.exists():
        return
    if not path.is_dir():
        raise InputError(f"{path}: is no folder, expected a simulated recording or nothing; {other}")
    if not unborn(path):
        for file in sorted(path.iterdir()):
            if file.name not in FILES or file.is_symlink() or not file.is_file():
                raise InputError(f"{path}: holds {file.name}, which is no part of a recording; {other}")
    if (path / START).exists() or not unborn(path):
        source = read_json(path / START, FORMAT).get("source")
        kind = source.get("kind") if isinstance(source, dict) else None
        if kind != "simulated":
            raise InputError(f"{path}: holds a recording of kind {kind!r}, not a simulated one; {other}")
    if (path / JOURNAL).exists():
        with locked(path / JOURNAL, busy(path)):
            pass


def _validate(recording: Recording) -> None:
    if not isinstance(recording.source, Mapping):
        raise InputError(f"source is {short_repr(recording.source)}, expected a mapping")
    try:
        json.dumps(dict(recording.source), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(
            f"source is {short_repr(dict(recording.source))}, expected what JSON can hold ({error})"
        ) from error
    readings, presses = recording.readings, recording.presses_mm
    if readings.ndim != 2 or not 1 <= readings.shape[1] <= limits.MAX_FIBRES or len(readings) < 2:
        raise InputError(f"readings have shape {readings.shape}, expected (R, C), R >= 2, C = 1 to {limits.MAX_FIBRES}")
    if recording.times_s.shape != (len(readings),):
        raise InputError(f"times have shape {recording.times_s.shape}, expected ({len(readings)},)")
    if presses.ndim != 2 or presses.shape[1] != 2 or len(presses) == 0:
        raise InputError(f"presses have shape {presses.shape}, expected (Q, 2) with at least one press")
    if recording.down_command.shape != (len(presses),) or recording.up_command.shape != (len(presses),):
        raise InputError(
            f"{len(presses)} presses have {recording.down_command.size} begins and {recording.up_command.size} ends"
        )
    limits.check_magnitude("readings", readings, limits.MAX_VOLTS, "V", missing=True)
    limits.check_magnitude("times", recording.times_s[:, None], limits.MAX_S, "s")
    limits.check_magnitude("presses", presses, limits.MAX_MM, "mm", missing=True)
    if np.isnan(readings).all():
        raise InputError(f"readings are all missing (NaN), all {readings.size} of them, expected some numbers")
    half = np.isnan(presses[:, 0]) != np.isnan(presses[:, 1])
    if half.any():
        raise InputError(f"press {int(np.argmax(half))} has one of x and y, expected both or neither")
    limits.check_ascending(recording.times_s)
    if not limits.MIN_RATE_HZ <= recording.rate_hz <= limits.MAX_RATE_HZ:
        raise InputError(
            f"times give {recording.rate_hz:g} readings a second, "
            f"allowed is {limits.MIN_RATE_HZ:g} to {limits.MAX_RATE_HZ:g}"
        )
    edges = np.column_stack([recording.down_command, recording.up_command]).ravel()
    late = np.diff(edges, prepend=0, append=len(readings) + 1) < 1
    if late.any():
        press = min(int(np.argmax(late)) // 2, len(presses) - 1)
        raise InputError(
            f"press {press} goes from reading {recording.down_command[press]} to {recording.up_command[press]}, "
            f"expected presses that do not overlap, each after at least one reading and within {len(readings)}"
        )


def _validate_measured(recording: Recording, name: str, limit: float, unit: str) -> None:
    """Refuse measures of presses that do not go with them; only an arm may tell of one that it is above the pad."""
    values = getattr(recording, name)
    if values.shape != (len(recording.presses_mm),):
        raise InputError(f"{name} have shape {values.shape}, expected ({len(recording.presses_mm)},)")
    limits.check_magnitude(name, values[:, None], limit, unit, missing=True)
    wrong = {"depths_mm": values <= 0, "forces_n": values < 0}.get(name, np.zeros(len(values), bool))
    if wrong.any():
        press = int(np.argmax(wrong))
        least = "more than 0" if name == "depths_mm" else "0 or more"
        raise InputError(f"{name} of press {press} is {values[press]:g} {unit}, allowed is {least}")


def is_mirrored(source: object) -> bool:
    """Return whether the source of a recording says that the pad lay with its tracks up, see `Recording.mirrored`."""
    rig = source.get("rig") if isinstance(source, Mapping) else None
    return isinstance(rig, Mapping) and rig.get("mirrored") is True


def rate_of(times_s: Array) -> float:
    """Readings per second of a recording, by the median of the steps of its (R,) times, s."""
    return 1 / float(np.median(np.diff(times_s)))
