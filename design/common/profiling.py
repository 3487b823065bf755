"""Profile of a command: wall time by stage, and how much of the work was skipped; costs nothing unless enabled."""

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
"""Libraries whose import takes noticeable time."""
_OTHER = "elsewhere"


class Profile:
    """Times and counts.

    Attributes:
        seconds: wall time of the main thread by stage, without the stages within it.
        counts: by name, [evaluated, total].
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.counts: dict[str, list[int]] = {}
        self.lock = threading.Lock()
        self._stages = [_OTHER]
        self._since = time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Attribute the time of the body to `name`."""
        self._attribute_time()
        self._stages.append(name)
        try:
            yield
        finally:
            self._attribute_time()
            self._stages.pop()

    def _attribute_time(self) -> None:
        now = time.perf_counter()
        self.seconds[self._stages[-1]] = self.seconds.get(self._stages[-1], 0.0) + now - self._since
        self._since = now

    def lines(self) -> list[str]:
        """Format the profile as text."""
        self._attribute_time()
        total_s = sum(self.seconds.values())
        stages = sorted(self.seconds.items(), key=lambda item: (item[0] == _OTHER, -item[1]))
        loaded = [name for name in HEAVY if name in sys.modules]
        skipped = [name for name in HEAVY if name not in sys.modules]
        counts = {name: (total - evaluated, total) for name, (evaluated, total) in self.counts.items()}
        return [
            f"where {total_s:.2f} s went",
            *(f"  {name:<24} {spent:8.2f} s {spent / total_s:6.1%}" for name, spent in stages),
            "what was skipped",
            *(
                f"  {name:<24} {n} of {total}" + (f" ({n / total:.1%})" if total >= 1000 else "")
                for name, (n, total) in counts.items()
            ),
            f"  {'imports':<24} {len(skipped)} of {len(HEAVY)}: {', '.join(skipped) or 'none'}"
            + (f" (not {', '.join(loaded)})" if loaded else ""),
        ]


_active: Profile | None = None


@contextmanager
def profiled() -> Iterator[Profile]:
    """Profile the body; imports of HEAVY libraries are stages of their own."""
    global _active
    _active, finder = Profile(), _TimedImports()
    sys.meta_path.insert(0, finder)
    try:
        yield _active
    finally:
        sys.meta_path.remove(finder)
        _active = None


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Attribute the time of the body to `name` if it runs in the main thread of a profiled command."""
    if _active is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    with _active.stage(name):
        yield


def add_count(name: str, evaluated: int, total: int) -> None:
    """Count how many of `total` items were evaluated, the others skipped; from any thread."""
    if _active is not None:
        with _active.lock:
            count = _active.counts.setdefault(name, [0, 0])
            count[0] += evaluated
            count[1] += total


def is_profiling() -> bool:
    """Whether a profile is being taken, for counts that take time themselves."""
    return _active is not None


class _TimedImports(MetaPathFinder):
    """Makes the import of each of HEAVY a stage."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        spec = PathFinder.find_spec(fullname, path, target) if fullname in HEAVY else None
        loader: Any = spec and spec.loader
        if loader is not None:

            def exec_timed(module: ModuleType) -> None:
                del loader.exec_module  # uncovers the method of its class
                with stage(f"import {fullname}"):
                    loader.exec_module(module)

            loader.exec_module = exec_timed
        return spec
