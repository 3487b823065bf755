"""Checkpoints of a search or study: a small file of arrays for each of its tasks, so that it survives a kill."""

import hashlib
import io
import json
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import MAX_BYTES, atomic_file, read_bytes, read_json, remove_leftovers, write_json
from padforge.design.common.validation import InputError, short_repr

FORMAT = "padforge-search/1"

State = dict[str, NDArray[Any]]

_SETTINGS_FILE = "search.json"
_STATE_FILE = re.compile(r"start_([0-9]{4,})\.npz")
_DIGEST = "seal"
"""Name of the array that holds the digest of the others."""


class Checkpoints:
    """The folder of the states of a search."""

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        """Use a folder.

        Args:
            folder: created with the first state.
            settings: what the search depends on, JSON by section and key; states of other settings are refused.
        """
        self.folder = folder
        self.settings = json.loads(json.dumps(settings))

    def begin(self, resume: bool) -> dict[int, State]:
        """Read the states of an earlier run, or remove them.

        Args:
            resume: whether to go on from them.

        Returns:
            States by number.

        Raises:
            InputError: the states belong to other settings, or cannot be read.
        """
        path = self.folder / _SETTINGS_FILE
        if not (resume and path.exists()):
            self.clear()
            return {}
        stored = read_json(path, FORMAT).get("settings")
        if not isinstance(stored, dict) or not all(isinstance(section, dict) for section in stored.values()):
            raise InputError(f"{path}: settings are not as padforge writes them; start anew without --resume")
        for section, values in self.settings.items():
            for key, value in values.items():
                before = stored.get(section, {}).get(key)
                if before != value:
                    raise InputError(
                        f"{self.folder}: begun with {section} {key} {short_repr(before)}, now {short_repr(value)}; "
                        "allowed to resume are the same settings"
                    )
        paths = {int(name[1]): path for path in self.folder.iterdir() if (name := _STATE_FILE.fullmatch(path.name))}
        return {number: self._read(paths[number], number) for number in sorted(paths)}

    def save(self, number: int, state: State) -> None:
        """Write a state atomically in place of the last one of that number."""
        if not (self.folder / _SETTINGS_FILE).exists():
            write_json(self.folder / _SETTINGS_FILE, {"format": FORMAT, "settings": self.settings})
        with atomic_file(self.folder / f"start_{number:04d}.npz") as temporary:
            np.savez(temporary, allow_pickle=False, **state, **{_DIGEST: np.array(self._digest(number, state))})

    def clear(self) -> None:
        """Remove all states, and the folder if nothing else is in it.

        Raises:
            InputError: its search.json is not that of a search.
        """
        path = self.folder / _SETTINGS_FILE
        if path.exists():
            try:
                read_json(path, FORMAT)
            except InputError as error:
                raise InputError(f"{error}; remove it, or choose another folder") from error
            for file in list(self.folder.iterdir()):
                if _STATE_FILE.fullmatch(file.name) and file.is_file() and not file.is_symlink():
                    file.unlink()
            path.unlink()
        remove_leftovers(self.folder)
        with suppress(OSError):  # it does not exist, or is not empty
            self.folder.rmdir()

    def _read(self, path: Path, number: int) -> State:
        try:
            with np.load(io.BytesIO(read_bytes(path)), allow_pickle=False) as arrays:
                if sum(entry.file_size for entry in arrays.zip.infolist()) > MAX_BYTES:
                    raise ValueError(f"it unpacks to more than {MAX_BYTES} bytes")
                state = {name: arrays[name] for name in arrays.files}
            if str(state.pop(_DIGEST, "")) != self._digest(number, state):
                raise ValueError("it is not as it was written")
        except InputError:
            raise
        except Exception as error:  # NumPy and zipfile raise many kinds on torn files
            raise InputError(f"{path}: cannot be read ({error}); start anew without --resume") from error
        return state

    def _digest(self, number: int, state: State) -> str:
        """Compute the digest of a state and of what it belongs to, which makes further checks unnecessary."""
        digest = hashlib.sha256(json.dumps([self.settings, number], sort_keys=True).encode())
        for name, array in sorted(state.items()):
            digest.update(f"{name} {array.dtype.str} {array.shape}".encode() + array.tobytes())
        return digest.hexdigest()
