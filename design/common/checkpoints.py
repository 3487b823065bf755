"""What a search has done so far, on disk: one small file of arrays per start, so that it survives being killed."""

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

_STATE = re.compile(r"start_([0-9]{4,})\.npz")
_SEAL = "seal"
"""Name of the array that tells whether the others are as they were written."""


class Checkpoints:
    """The folder a search keeps its states in.

    Args:
        folder: made when the first state is written.
        settings: what the search depends on, JSON; states of other settings are no help.
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.folder = folder
        self.settings = json.loads(json.dumps(settings))

    def begin(self, resume: bool) -> dict[int, State]:
        """States by start to go on from; none, and an empty folder, unless `resume` is asked for.

        Raises:
            InputError: the states there belong to other settings, or cannot be read.
        """
        about = self.folder / "search.json"
        if not (resume and about.exists()):
            self.clear()
            return {}
        before = read_json(about, FORMAT).get("settings")
        if not isinstance(before, dict) or not all(isinstance(section, dict) for section in before.values()):
            raise InputError(f"{about}: settings are not as padforge writes them; start anew without --resume")
        for section in self.settings:
            for key, value in self.settings[section].items():
                if before.get(section, {}).get(key) != value:
                    was = before.get(section, {}).get(key)
                    raise InputError(
                        f"{self.folder}: begun with {section} {key} {short_repr(was)}, now {short_repr(value)}; "
                        "allowed to resume are the same settings"
                    )
        named = {path: _STATE.fullmatch(path.name) for path in sorted(self.folder.glob("start_*.npz"))}
        return {int(number[1]): self._read(path, int(number[1])) for path, number in named.items() if number}

    def save(self, start: int, state: State) -> None:
        """Put the state of a start in the place of its last one, atomically."""
        if not (self.folder / "search.json").exists():
            write_json(self.folder / "search.json", {"format": FORMAT, "settings": self.settings})
        with atomic_file(self.folder / f"start_{start:04d}.npz") as temporary:
            np.savez(temporary, allow_pickle=False, **state, **{_SEAL: np.array(self._seal(start, state))})

    def clear(self) -> None:
        """Remove all states, and nothing else that may lie there: what they led to is kept, or it begins anew.

        Raises:
            InputError: a search.json there that is none of a search.
        """
        about = self.folder / "search.json"
        if about.exists():
            try:
                read_json(about, FORMAT)
            except InputError as error:
                raise InputError(f"{error}; remove it, or choose another folder") from error
            for path in self.folder.iterdir():
                if _STATE.fullmatch(path.name) and path.is_file() and not path.is_symlink():
                    path.unlink()
            about.unlink()
        remove_leftovers(self.folder)
        with suppress(OSError):  # where it is not there, or there is more in it than states
            self.folder.rmdir()

    def _read(self, path: Path, start: int) -> State:
        content = io.BytesIO(read_bytes(path))
        try:
            with np.load(content, allow_pickle=False) as arrays:
                if sum(entry.file_size for entry in arrays.zip.infolist()) > MAX_BYTES:
                    raise ValueError(f"it unpacks to more than {MAX_BYTES} bytes")
                state = {name: arrays[name] for name in arrays.files}
            if str(state.pop(_SEAL, "")) != self._seal(start, state):
                raise ValueError("it is not as it was written")
        except Exception as error:  # the readers of NumPy and of zip files raise whatever a torn file leads them to
            raise InputError(f"{path}: cannot be read ({error}); start anew without --resume") from error
        return state

    def _seal(self, start: int, state: State) -> str:
        """Digest of a state and of what it belongs to: one that bears it needs no further check."""
        digest = hashlib.sha256(json.dumps([self.settings, start], sort_keys=True).encode())
        for name, array in sorted(state.items()):
            digest.update(f"{name} {array.dtype.str} {array.shape}".encode() + array.tobytes())
        return digest.hexdigest()
