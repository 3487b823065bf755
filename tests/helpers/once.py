"""What is dear to make is made once for all workers of a session, by whichever needs it first."""

import os
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import filelock

T = TypeVar("T")


class Once:
    """Makes things once a session.

    Args:
        temporary: the folder for temporary files of this worker, which lies in that of the session.
    """

    def __init__(self, temporary: Path) -> None:
        session = temporary.parent if "PYTEST_XDIST_WORKER" in os.environ else temporary
        self._folder = session / "once"
        self._folder.mkdir(exist_ok=True)

    def __call__(self, name: str, make: Callable[[Path], T]) -> T:
        """A copy of what `make` returns, which is called by the first who asks for `name`.

        Args:
            name: of the thing; whoever uses another's must mean the same.
            make: is given an empty folder, whose files all workers may read and none may change.
        """
        kept = self._folder / f"{name}.pickle"
        with filelock.FileLock(self._folder / f"{name}.lock"):
            if not kept.exists():
                thing = make(Path(tempfile.mkdtemp(prefix=f"{name}-", dir=self._folder)))
                kept.write_bytes(pickle.dumps(thing))
        return pickle.loads(kept.read_bytes())
