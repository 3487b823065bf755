"""Recordings: readings of the fibres while a probe presses known positions."""

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from padforge.common.files import LOCK, locked, make_folder, read_json, reraise_write_error, sync, temporary_folder
from padforge.common.files import provenance as origin
from padforge.common.validation import InputError, check_path, check_type, naming_file, short_repr
from padforge.sense.arrays import (
    MAX_FIBRES,
    MAX_MM,
    MAX_N,
    MAX_RATE_HZ,
    MIN_RATE_HZ,
    Array,
    Indices,
    Mask,
    check_magnitude,
    check_numbers,
    check_stream,
)
from padforge.sense.recording.block_file import read_blocks
from padforge.sense.recording.run_directory import (
    FILES,
    FORMAT,
    JOURNAL,
    READINGS,
    START,
    Press,
    Recorder,
    busy_message,
    check_new_folder,
    is_uncommitted,
    read_fibres,
    read_journal,
)

_ARRAYS = dict.fromkeys(("readings", "times_s", "presses_mm"), np.float64)
_ARRAYS |= dict.fromkeys(("down_command", "up_command"), np.int64)
FIBRE_NAMES = "fibre_names"  # key in the source of a recording: names of its fibres in the imported file
NOTE = "note"  # key in the source of a recording: what was omitted in the import, or filled in
PRESSES_DETECTED = {"presses": "detected"}  # entry of the source of a recording whose presses were detected
_MEASURES = {"depths_mm": (MAX_MM, "mm"), "reached_mm": (MAX_MM, "mm"), "forces_n": (MAX_N, "N")}


@dataclass(frozen=True)
class Recording:
    """Readings of the fibres of a pad, and the presses on it.

    Attributes:
        readings: voltages (R, C), a row per reading and a column per fibre; NaN where missing.
        times_s: times (R,), ascending, s.
        presses_mm: commanded positions (Q, 2), mm from the pad's centre; NaN where unknown.
        down_command: index (Q,) of the first reading after the probe was commanded down.
        up_command: index (Q,) of the first reading after it was commanded up; R if there is none.
        source: origin of the recording; JSON.
        torn_presses: number of presses that were omitted because the end of the readings was torn off.
        depths_mm: commanded depths (Q,) below the surface, mm, > 0; NaN where unknown.
        reached_mm: depths (Q,) measured by the arm while it held the press, mm; NaN where unknown.
        forces_n: forces (Q,) on the probe during the press, N, >= 0; NaN where unknown.
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
            values = getattr(self, name)
            # Arrays that cannot change are not copied, since they may have gigabytes.
            is_frozen = isinstance(values, np.ndarray) and values.flags.owndata and not values.flags.writeable
            self._freeze(name, check_numbers(values, kind, name, copy=not is_frozen))
        _check_source(self.source)
        _check_readings(self)
        _check_presses(self)
        for name in _MEASURES:
            values = check_numbers(getattr(self, name), np.float64, name)
            is_unknown = np.isnan(values).all()  # of any length: `replace` may have changed the number of presses
            self._freeze(name, np.full(len(self.presses_mm), np.nan) if is_unknown else values)
            _check_measure(self, name)

    def _freeze(self, name: str, array: NDArray[Any]) -> None:
        array.setflags(write=False)
        object.__setattr__(self, name, array)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Recording):
            return NotImplemented
        names = (*_ARRAYS, *_MEASURES)
        return all(np.array_equal(getattr(self, name), getattr(other, name), equal_nan=True) for name in names)

    __hash__ = None  # type: ignore[assignment]

    @property
    def fibres(self) -> int:
        """Number of fibres C."""
        return self.readings.shape[1]

    @property
    def shape(self) -> tuple[int]:
        """Shape (Q,) of the presses, as if they were an array."""
        return (len(self),)

    def __len__(self) -> int:
        return len(self.presses_mm)

    def __getitem__(self, presses: Any) -> "PressSelection":
        return PressSelection(self, np.arange(len(self)))[presses]

    @property
    def has_position(self) -> Mask:
        """Whether the position of each press is known; shape (Q,)."""
        return ~np.isnan(self.presses_mm[:, 0])  # x and y are both known or both unknown

    @property
    def actual_depths_mm(self) -> Array:
        """Depths (Q,) of the presses, mm: as measured, otherwise as commanded; NaN where unknown."""
        return np.where(np.isnan(self.reached_mm), self.depths_mm, self.reached_mm)

    @property
    def measures(self) -> dict[str, Array]:
        """Depths and forces of the presses, each (Q,), by name; NaN where unknown."""
        return {"depth_mm": self.actual_depths_mm, "force_n": self.forces_n}

    @property
    def mirrored(self) -> bool:
        """Whether the pad lay with its tracks up, by `[rig]`: seen from above, x then points left if y points away."""
        return is_mirrored(self.source)

    @property
    def fibre_names(self) -> tuple[str, ...]:
        """Names (C,) of the fibres in the file that they were imported from; () if unknown."""
        names = self.source.get(FIBRE_NAMES)
        return tuple(map(str, names)) if isinstance(names, list) and len(names) == self.fibres else ()

    @property
    def pad_digest(self) -> str:
        """Hexadecimal SHA-256 of the plan of the pad, rounded to 1e-6; "" if the source has none."""
        if (plan := self.source.get("morphology")) is None:
            return ""
        rounded = json.loads(json.dumps(plan), parse_float=lambda number: round(float(number), 6))
        return hashlib.sha256(json.dumps(rounded, sort_keys=True).encode()).hexdigest()

    @property
    def rate_hz(self) -> float:
        """Readings per second, from the median interval."""
        return median_rate_hz(self.times_s)

    @property
    def digest(self) -> str:
        """Hexadecimal SHA-256 of the readings and presses, without depths and forces."""
        digest = hashlib.sha256()
        for array in (getattr(self, name) for name in _ARRAYS):
            # NaN has several bit patterns
            normalised = np.where(np.isnan(array), np.nan, array) if array.dtype.kind == "f" else array
            digest.update(repr(array.shape).encode() + normalised.tobytes())
        return digest.hexdigest()

    @classmethod
    def from_arrays(
        cls,
        readings: ArrayLike,
        times_s: ArrayLike,
        *,
        down_s: ArrayLike | None = None,
        up_s: ArrayLike | None = None,
        presses_mm: ArrayLike | None = None,
        **measures: ArrayLike,
    ) -> "Recording":
        """Make a recording from arrays.

        Args:
            readings: voltages, NaN where missing; shape (R, C), V.
            times_s: times of the readings, ascending; shape (R,), s.
            down_s: start of each press, by the same clock; shape (Q,), s. Without it and `up_s`, presses are detected
                in the readings.
            up_s: end of each press; shape (Q,), s.
            presses_mm: position of each press from the pad's centre; shape (Q, 2), mm. By default unknown.
            **measures: `depths_mm`, `reached_mm` and `forces_n` of a `Recording`; shape (Q,).

        Raises:
            InputError: arrays are inconsistent, or there is no press.
        """
        readings, times = check_stream(times_s, readings)[::-1]
        source: dict[str, Any] = {"kind": "arrays"}
        if (down_s is None) != (up_s is None):
            raise InputError("one of down_s and up_s is given, expected both or neither")
        if down_s is None or up_s is None:
            down, up = detect_commands(readings, times, source)
            source |= PRESSES_DETECTED
        else:
            seconds = (check_numbers(values, np.float64, name) for name, values in (("down_s", down_s), ("up_s", up_s)))
            down, up = (np.searchsorted(times, values) for values in seconds)
        positions = np.full((len(down), 2), np.nan) if presses_mm is None else presses_mm
        return cls(readings, times, positions, down, up, source, **measures)  # type: ignore[arg-type]

    @classmethod
    def open(cls, path: str | Path) -> "Recording":
        """Read a run directory, finished or not; `import_export.open_recording` reads files as well.

        Args:
            path: the run directory. A torn end of its readings is omitted, with the presses in it.

        Raises:
            InputError: the path is no run directory, or is damaged otherwise.
        """
        path = check_path("path", path)
        fibres = read_fibres(path)
        # The journal is read first, since its presses are never ahead of the readings, which may be being recorded.
        done = np.array(list(read_journal(path / JOURNAL).values()), dtype=np.float64).reshape(-1, len(Press._fields))
        times_s, readings = read_blocks(path / READINGS, fibres)
        table = done[done[:, 3] <= len(times_s)]
        for array in (times_s, readings):
            array.setflags(write=False)
        with naming_file(path):
            return cls(
                readings=readings,
                times_s=times_s,
                presses_mm=table[:, :2],
                down_command=table[:, 2].astype(np.int64),
                up_command=table[:, 3].astype(np.int64),
                source=read_json(path / START, FORMAT).get("source", {}),
                torn_presses=len(done) - len(table),
                depths_mm=table[:, 4],
                reached_mm=table[:, 5],
                forces_n=table[:, 6],
            )

    def save(self, path: str | Path, provenance: Mapping[str, Any] | None = None, replacing: bool = False) -> None:
        """Write a run directory atomically.

        Args:
            path: the run directory.
            provenance: provenance of the recording, JSON; by default versions of padforge and its dependencies.
            replacing: whether to replace an existing recording, which must be a simulated one, see
                `check_replaceable`.
        """
        provenance = origin("padforge.sense.Recording.save") if provenance is None else provenance
        check_target = check_replaceable if check_type("replacing", replacing, bool) else check_new_folder
        check_target(path := check_path("path", path))
        path = path.resolve()
        with reraise_write_error(path):
            make_folder(path.parent)
            with temporary_folder(path.parent) as folder:
                self._write(folder / path.name, provenance)
                if replacing:
                    check_target(path)
                    with suppress(FileNotFoundError):
                        path.rename(folder / f"{path.name}-old")
                try:
                    if path.exists():
                        path.rmdir()
                    (folder / path.name).rename(path)
                except OSError:
                    check_new_folder(path)  # another process may have created it
                    raise
                sync(path.parent)

    def _write(self, path: Path, provenance: Mapping[str, Any]) -> None:
        step = max(1, 2**18 // (8 * (1 + self.fibres)))  # readings written at once, 256 KiB
        with Recorder(path, self.fibres, self.source, provenance) as recorder:
            for first in range(0, len(self.readings), step):
                recorder.append(self.times_s[first : first + step], self.readings[first : first + step])
            measures = np.column_stack([getattr(self, name) for name in _MEASURES])
            presses = zip(self.presses_mm, self.down_command, self.up_command, measures, strict=True)
            for position_mm, down, up, measured in presses:
                depth, reached, force = measured.tolist()
                recorder.begin(position_mm, int(down), **({} if isnan(depth) else {"depth_mm": depth}))
                at_mm = {} if isnan(reached) else {"at_mm": [None, None, reached]}
                recorder.finish(int(up), **at_mm, **({} if isnan(force) else {"force_n": force}))


@dataclass(frozen=True)
class PressSelection:
    """A selection of presses, `recording[presses]`, for cross-validation.

    It has the readings of all presses, since earlier presses influence later ones.
    """

    recording: Recording
    presses: Indices  # indices of the selected presses; shape (S,)

    @property
    def presses_mm(self) -> Array:
        """Positions (S, 2) of the selected presses, mm; NaN where unknown."""
        return self.recording.presses_mm[self.presses]

    @property
    def shape(self) -> tuple[int]:
        """Shape (S,) of the presses, as if they were an array."""
        return (len(self),)

    def __len__(self) -> int:
        return len(self.presses)

    def __getitem__(self, presses: Any) -> "PressSelection":
        rows = presses[0] if isinstance(presses, tuple) else presses  # scikit-learn indexes by [rows, ...]
        return PressSelection(self.recording, np.atleast_1d(self.presses[rows]))


def check_replaceable(path: Path) -> None:
    """Raise InputError unless a path is absent or a simulated recording, which can be made again by its seed.

    A link, or a recording in progress, is refused.
    """
    advice = "choose another --out"
    if path.is_symlink():
        raise InputError(f"{path}: is a link, expected a folder to replace; {advice}")
    if not path.exists():
        return
    if not path.is_dir():
        raise InputError(f"{path}: is no folder, expected a simulated recording or nothing; {advice}")
    if (path / START).exists() or not is_uncommitted(path):
        for file in sorted(path.iterdir()):
            if file.name not in (*FILES, LOCK) or file.is_symlink() or not file.is_file():
                raise InputError(f"{path}: holds {file.name}, which is no part of a recording; {advice}")
        source = read_json(path / START, FORMAT).get("source")
        kind = source.get("kind") if isinstance(source, dict) else None
        if kind != "simulated":
            raise InputError(f"{path}: holds a recording of kind {kind!r}, not a simulated one; {advice}")
    with locked(path, busy_message(path)):
        pass


def detect_commands(readings: Array, times_s: Array, source: Mapping[str, Any]) -> tuple[Indices, Indices]:
    """Detect the presses in readings (R, C) and return their down and up commands (Q,); InputError if there is none."""
    from padforge.sense.signals.press_detection import detect_presses, estimate_commands

    placeholder = np.array([1])
    Recording(readings, times_s, np.zeros((1, 2)), placeholder, placeholder + 1, source)  # checks the readings
    presses = detect_presses(readings, times_s)
    if len(presses.touched) == 0:
        what = "none is given, and none is detected in the readings"
        hint = "; a recording has many lines for each press" if len(readings) < 100 else ""
        raise InputError(f"has no press: {what}{hint}")
    return estimate_commands(presses, times_s)


def _check_source(source: object) -> None:
    if not isinstance(source, Mapping):
        raise InputError(f"source is {short_repr(source)}, expected a mapping")
    try:
        json.dumps(dict(source), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"source is {short_repr(dict(source))}, expected what JSON can hold ({error})") from error


def _check_readings(recording: Recording) -> None:
    readings, times_s = recording.readings, recording.times_s
    if readings.ndim != 2 or not 1 <= readings.shape[1] <= MAX_FIBRES or len(readings) < 2:
        raise InputError(f"readings have shape {readings.shape}, expected (R, C), R >= 2, C = 1 to {MAX_FIBRES}")
    check_stream(times_s, readings)
    if np.isnan(readings).all():
        raise InputError(f"readings are all missing (NaN), all {readings.size} of them, expected some numbers")
    if not MIN_RATE_HZ <= recording.rate_hz <= MAX_RATE_HZ:
        raise InputError(
            f"times give {recording.rate_hz:g} readings a second, allowed is {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g}"
        )


def _check_presses(recording: Recording) -> None:
    presses, down, up = recording.presses_mm, recording.down_command, recording.up_command
    if presses.ndim != 2 or presses.shape[1] != 2 or len(presses) == 0:
        raise InputError(f"presses have shape {presses.shape}, expected (Q, 2) with at least one press")
    if down.shape != (len(presses),) or up.shape != (len(presses),):
        raise InputError(f"{len(presses)} presses have {down.size} down commands and {up.size} up commands")
    check_magnitude("presses", presses, MAX_MM, "mm", missing=True)
    incomplete = np.isnan(presses[:, 0]) != np.isnan(presses[:, 1])
    if incomplete.any():
        raise InputError(f"press {int(np.argmax(incomplete))} has one of x and y, expected both or neither")
    n_readings = len(recording.readings)
    is_early = np.diff(np.column_stack([down, up]).ravel(), prepend=0, append=n_readings + 1) < 1
    if is_early.any():
        press = min(int(np.argmax(is_early)) // 2, len(presses) - 1)
        raise InputError(
            f"press {press} goes from reading {down[press]} to {up[press]}, "
            f"expected presses that do not overlap, each after at least one reading and within {n_readings}"
        )


def _check_measure(recording: Recording, name: str) -> None:
    values, (limit, unit) = getattr(recording, name), _MEASURES[name]
    if values.shape != (len(recording.presses_mm),):
        raise InputError(f"{name} have shape {values.shape}, expected ({len(recording.presses_mm)},)")
    check_magnitude(name, values[:, None], limit, unit, missing=True)
    # Reached depths may be negative, if the arm measures that it is above the pad.
    is_wrong = {"depths_mm": values <= 0, "forces_n": values < 0}.get(name, np.zeros(len(values), bool))
    if is_wrong.any():
        press = int(np.argmax(is_wrong))
        allowed = "more than 0" if name == "depths_mm" else "0 or more"
        raise InputError(f"{name} of press {press} is {values[press]:g} {unit}, allowed is {allowed}")


def is_mirrored(source: object) -> bool:
    """Return `Recording.mirrored` by the source of a recording."""
    rig = source.get("rig") if isinstance(source, Mapping) else None
    return isinstance(rig, Mapping) and rig.get("mirrored") is True


def median_rate_hz(times_s: Array) -> float:
    """Return the readings per second, from the median interval of times (R,)."""
    return 1 / float(np.median(np.diff(times_s)))
