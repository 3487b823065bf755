"""What a run has done, in `run.json`: of what each stage was made, and the files it left, so that none is done anew."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from padforge.design.common.files import as_written, read_json, sha256, write_json

FORMAT, NAME = "padforge-run/1", "run.json"


class RunProgress:
    """The stages that a run into a folder has finished.

    Args:
        out: the folder. resume: whether to go on from what an earlier run has noted; else that is forgotten.

    Raises:
        InputError: the note cannot be read, or is none of padforge.
    """

    def __init__(self, out: Path, resume: bool) -> None:
        self._out, self._note = out, out / NAME
        self._stages: dict[str, dict[str, Any]] = {}
        if resume and self._note.exists():
            with as_written(self._note):
                self._stages = dict(read_json(self._note, FORMAT)["stages"])

    def begin(self) -> None:
        """Forget what is not to be gone on from: from now on another run's results are replaced."""
        if not self._stages:
            self._note.unlink(missing_ok=True)

    def has(self, stage: str, made_of: Mapping[str, Any]) -> bool:
        """Whether a stage was made of the same, and its files are as it has left them.

        Args:
            made_of: settings and digests of inputs, as JSON has them.
        """
        with as_written(self._note):
            before = self._stages.get(stage, {})
            same = before.get("made_of") == _digest(made_of)
            return same and dict(before["files"]) == self._digests(before["files"])

    def note(self, stage: str, made_of: Mapping[str, Any], files: Iterable[str] = ()) -> None:
        """Keep that a stage is done, with the names of its files and folders."""
        self._stages[stage] = {"made_of": _digest(made_of), "files": self._digests(files)}
        write_json(self._note, {"format": FORMAT, "stages": self._stages})

    def _digests(self, names: Iterable[str]) -> dict[str, str]:
        paths = {name: self._out / Path(name).name for name in names}
        return {name: sha256(path) for name, path in paths.items() if path.exists()}


def _digest(made_of: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()
