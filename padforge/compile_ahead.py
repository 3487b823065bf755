"""Kernels compiled beside a first run: its search compiles those of its steps, a second process the others meanwhile.

Compiled kernels are shared through Numba's cache on disk. A kernel that both need at once is compiled twice, which does
no harm.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def compile_beside() -> Iterator[None]:
    """Let a second process compile kernels as soon as this one has to compile one in the body, if there is a core.

    It ends by itself, at the latest with the body. Where everything is read from the cache, none is started.
    """
    from numba.core import event as events

    processes: list[subprocess.Popen[bytes]] = []

    class Starter(events.Listener):
        """Starts the process once."""

        def on_start(self, event: Any) -> None:
            """Start it."""
            if not processes and (os.cpu_count() or 1) > 1:
                command, silent = [sys.executable, "-m", "padforge.compile_ahead"], subprocess.DEVNULL
                processes.append(subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent))

        def on_end(self, event: Any) -> None:
            """Do nothing."""

    starter = Starter()
    events.register("numba:compile", starter)
    try:
        yield
    finally:
        events.unregister("numba:compile", starter)
        for process in processes:
            process.terminate()
            process.wait()


def main() -> None:
    """Compile kernels by small tasks, in the order in which a run needs them, but for those that it compiles first."""
    import numpy as np

    from padforge.design.morphology import Morphology
    from padforge.design.objectives.score import TERMS, ScoredPad
    from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings
    from padforge.fabricate.checks.surface import TriangleMesh
    from padforge.sense.signals.press_detection import PressDetector

    pad = Morphology.random(2, 2, seed=0)
    size = PadSettings().for_layout(pad.layout)
    scored = ScoredPad(pad, Contact(), SearchSettings(), RulesSettings(), size)
    for term in sorted(TERMS, key=lambda term: term.name != "penalty"):  # rules end a step, all others a search
        if not term.name.startswith("expected_error"):
            scored.terms([term.name])
    if hasattr(os, "nice"):
        os.nice(10)  # what follows is not needed before the search ends, which has all cores until then
    TriangleMesh.weld(np.eye(4, 3), [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]).find_self_intersections(1)
    PressDetector(2).update(np.arange(9.0), np.zeros((9, 2)))


if __name__ == "__main__":
    main()
