"""What a search has done so far, on disk: one small file of arrays per start, so that it survives being killed."""

import json
import shutil
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .files import atomic, read_json, write_json

FORMAT = "padforge-search/1"

State = dict[str, NDArray[Any]]


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
                        f"{self.folder}: begun with {section} {key} {was!r}, now {value!r}; "
                        "allowed to resume are the same settings"
                    )
        return {int(path.stem.split("_")[1]): _read(path) for path in sorted(self.folder.glob("start_*.npz"))}

    def save(self, start: int, state: State) -> None:
        """Put the state of a start in the place of its last one, atomically."""
        if not (self.folder / "search.json").exists():
            write_json(self.folder / "search.json", {"format": FORMAT, "settings": self.settings})
        with atomic(self.folder / f"start_{start:04d}.npz") as temporary:
            np.savez(temporary, allow_pickle=False, **state)

    def clear(self) -> None:
        """Remove all states: the search is finished, or begins anew."""
        if (self.folder / "search.json").exists():
            shutil.rmtree(self.folder)


def _read(path: Path) -> State:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, EOFError, KeyError, zlib.error, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read ({error}); start anew without --resume") from error
