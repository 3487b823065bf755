"""Profile of a command: its wall time by stage, and how much work it skipped."""

import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder
from types import ModuleType
from typing import Any

# Libraries that take noticeable time to import.
HEAVY = (
    *("OCP", "build123d", "ezdxf", "h5py", "manifold3d", "matplotlib", "numba", "numpy", "pydantic", "pymoo"),
    *("rtde_control", "scipy", "serial", "shapely", "torch", "trimesh"),
)
_OTHER = "elsewhere"


class Profile:
    """Wall time of the main thread by stage, excluding nested stages, and counts."""

    def __init__(self) -> None:
        self.seconds = defaultdict[str, float](float)
        self.counts = defaultdict[str, list[int]](lambda: [0, 0])  # [evaluated, total]
        self.lock, self.stages, self._since = threading.Lock(), [_OTHER], time.perf_counter()

    def attribute_time(self) -> None:
        """Add the time since the last call to the innermost stage."""
        now = time.perf_counter()
        self.seconds[self.stages[-1]] += now - self._since
        self._since = now

    def lines(self) -> list[str]:
        self.attribute_time()
        total_s = sum(self.seconds.values())
        lines = [f"where {total_s:.2f} s went"]
        for name, spent in sorted(self.seconds.items(), key=lambda item: (item[0] == _OTHER, -item[1])):
            lines.append(f"  {name:<24} {spent:8.2f} s {spent / total_s:6.1%}")
        lines.append("what was skipped")
        for name, (evaluated, total) in self.counts.items():
            n = total - evaluated
            lines.append(f"  {name:<24} {n} of {total}" + (f" ({n / total:.1%})" if total >= 1000 else ""))
        loaded = ", ".join(name for name in HEAVY if name in sys.modules)
        skipped = [name for name in HEAVY if name not in sys.modules]
        imports = f"  {'imports':<24} {len(skipped)} of {len(HEAVY)}: {', '.join(skipped) or 'none'}"
        return [*lines, imports + (f" (not {loaded})" if loaded else "")]


_active: Profile | None = None


@contextmanager
def profiled() -> Iterator[Profile]:
    """Profile the body, in which the import of each library in `HEAVY` is a stage."""
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
    profile = _active
    if profile is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    profile.attribute_time()
    profile.stages.append(name)
    try:
        yield
    finally:
        profile.attribute_time()
        profile.stages.pop()


def add_count(name: str, evaluated: int, total: int) -> None:
    """Count `total` items, of which `evaluated` were evaluated and the others skipped; thread-safe."""
    if _active is not None:
        with _active.lock:
            _active.counts[name][0] += evaluated
            _active.counts[name][1] += total


class _TimedImports(MetaPathFinder):
    """Makes the import of each library in `HEAVY` a stage."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        spec = PathFinder.find_spec(fullname, path, target) if fullname in HEAVY else None
        loader: Any = spec and spec.loader
        if loader is not None:

            def exec_timed(module: ModuleType) -> None:
                del loader.exec_module  # this attribute, which hides the method of the class
                with stage(f"import {fullname}"):
                    loader.exec_module(module)

            loader.exec_module = exec_timed
        return spec
