"""Where time goes and what is skipped, noted while somebody asks for it; else a note costs the look at a variable."""

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder
from types import ModuleType
from typing import Any

HEAVY = (
    *("build123d", "ezdxf", "h5py", "manifold3d", "matplotlib", "numba", "numpy", "pydantic", "pymoo", "rtde_control"),
    *("scipy", "serial", "shapely", "torch", "trimesh"),
)
"""Libraries whose import is worth telling of."""


class Profile:
    """What has been noted.

    Attributes:
        seconds: wall time of the main thread by stage, without the stages within it.
        counts: by name, how many there were to look at and how many were looked at.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.counts: dict[str, list[int]] = {}
        self._stages = ["elsewhere"]
        self._since = time.perf_counter()
        self._lock = threading.Lock()

    def enter(self, stage: str) -> None:
        """Begin a stage, within the one that runs."""
        self._switch()
        self._stages.append(stage)

    def leave(self) -> None:
        """End the stage that runs."""
        self._switch()
        self._stages.pop()

    def _switch(self) -> None:
        now = time.perf_counter()
        self.seconds[self._stages[-1]] = self.seconds.get(self._stages[-1], 0.0) + now - self._since
        self._since = now

    def add(self, name: str, looked_at: int, of: int) -> None:
        """Add to a count, from any thread."""
        with self._lock:
            count = self.counts.setdefault(name, [0, 0])
            count[0] += looked_at
            count[1] += of

    def lines(self) -> list[str]:
        """The profile for people."""
        self._switch()
        whole = sum(self.seconds.values())
        stages = sorted(self.seconds.items(), key=lambda item: (item[0] == "elsewhere", -item[1]))
        loaded = [name for name in HEAVY if name in sys.modules]
        left = [name for name in HEAVY if name not in sys.modules]
        return [
            f"where {whole:.2f} s went",
            *(f"  {name:<24} {spent:8.2f} s {spent / whole:6.1%}" for name, spent in stages),
            "what was skipped",
            *(f"  {name:<24} {of - done} of {of}" + _share(of - done, of) for name, (done, of) in self.counts.items()),
            f"  {'imports':<24} {len(left)} of {len(HEAVY)}: {', '.join(left) or 'none'}"
            + (f" (not {', '.join(loaded)})" if loaded else ""),
        ]


def _share(part: int, whole: int) -> str:
    return f" ({part / whole:.1%})" if whole >= 1000 else ""


_active: Profile | None = None


@contextmanager
def profiled() -> Iterator[Profile]:
    """Note what happens in the body, imports of HEAVY libraries as stages of their own."""
    global _active
    profile, clock = Profile(), _ImportClock()
    _active = profile
    sys.meta_path.insert(0, clock)
    try:
        yield profile
    finally:
        sys.meta_path.remove(clock)
        _active = None


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Time of the body goes to `name`; in threads other than the main one, to whatever the main one does."""
    profile = _active
    if profile is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    profile.enter(name)
    try:
        yield
    finally:
        profile.leave()


def looked_at(name: str, done: int, of: int) -> None:
    """Note that `done` of `of` were looked at, the others skipped."""
    if _active is not None:
        _active.add(name, done, of)


def is_profiling() -> bool:
    """Whether a profile is being taken, for notes that take work themselves."""
    return _active is not None


class _ImportClock(MetaPathFinder):
    """Makes the import of each of HEAVY a stage."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """The usual specification, its loader timed."""
        spec = PathFinder.find_spec(fullname, path, target) if fullname in HEAVY else None
        loader: Any = spec and spec.loader
        if loader is not None:

            def timed(module: ModuleType) -> None:
                del loader.exec_module  # which is its class's own again
                with stage(f"import {fullname}"):
                    loader.exec_module(module)

            loader.exec_module = timed
        return spec
