"""Kernels compiled beside a first run: a part of them by a second process, meanwhile and before the run needs them.

Compiled kernels are shared through Numba's cache on disk. A kernel that both need at once is compiled twice, which does
no harm.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import IO, Any, cast


@contextmanager
def compile_beside() -> Iterator[Callable[[], None]]:
    """Let a second process compile kernels as soon as this one has to compile one in the body, if there is a core.

    It compiles what a search needs, and the rest once the function is called that is yielded: after the search, which
    has all cores. It ends by itself, at the latest with the body. Where everything is read from disk, none is started.
    """
    from numba.core import event as events

    from padforge.design.common.compilation import cache_folder

    processes: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        if not processes and (os.cpu_count() or 1) > 1:
            command, silent = [sys.executable, "-m", "padforge.compile_ahead"], subprocess.DEVNULL
            processes.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=silent, stderr=silent))

    def go_on() -> None:
        for process in processes:
            cast(IO[bytes], process.stdin).close()

    class Starter(events.Listener):
        """Starts the process, once."""

        def on_start(self, event: Any) -> None:
            """Start it."""
            start()

        def on_end(self, event: Any) -> None:
            """Do nothing."""

    with events.install_listener("numba:compile", Starter()):
        try:
            if not any(cache_folder().rglob("*.nbi")):
                start()  # while this process imports what a run needs
            yield go_on
        finally:
            for process in processes:
                process.terminate()
                process.wait()
            go_on()


def main() -> None:
    """Compile kernels by small tasks, in the order in which a run needs them, but for those that it compiles first."""
    import numpy as np

    from padforge.design.contact import quick_signals
    from padforge.design.morphology import Morphology
    from padforge.design.objectives.expected_error import expected_error
    from padforge.design.objectives.score import TERMS, ScoredPad
    from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

    # 1. what ends a step of the search, whose signals the run compiles
    rng, scatter = np.random.default_rng(0), SearchSettings().response_scatter
    responses, positions = rng.random((2, 4)), rng.random((4, 2))
    expected_error(responses, positions, np.ones(2), np.ones(4, bool), np.ones((1, 2)), scatter, np.ones(2))
    pad, contact = Morphology.random(2, 2, seed=0), Contact()
    size = PadSettings().for_layout(pad.layout)
    scored = ScoredPad(pad, contact, SearchSettings(), RulesSettings(max_common_track_mm=None), size)
    scored.terms(["penalty"])
    # 2. what the run needs in the last steps, where common tracks count, and as soon as the search has ended
    later = [term.name for term in TERMS if not term.name.startswith("expected_error")]
    replace(scored, rules=RulesSettings()).terms(later)
    from padforge.fabricate.checks.surface import TriangleMesh

    TriangleMesh.weld(np.eye(4, 3), [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]).find_self_intersections(1)
    # 3. what it needs later
    sys.stdin.read()
    from padforge.sense.localizer.features import NOW
    from padforge.sense.localizer.moments import PHASES
    from padforge.sense.localizer.press_sampler import PressSampler
    from padforge.sense.localizer.scaler import TrainingPresses
    from padforge.sense.signals.press_detection import PressDetector

    PressDetector(2).update(np.arange(9.0), np.zeros((9, 2)))
    quick_signals(pad, positions, contact, sensitivity=np.ones((len(pad.knots), 2)))
    features, now = np.ones((1, 2, 1), np.float32), np.ones((2, len(NOW), 0), np.float32)
    known, targets = np.ones((1, 2), bool), np.zeros((1, 2), np.float32)
    presses = TrainingPresses(features, known, known[:, :0], targets, 0.0, now, now, 1.0, 0.0)
    sampler = PressSampler(presses, np.ones((2, 2, 2, 1), np.float32), 1, rng, PHASES[0]["press"], ())
    sampler.inputs(sampler.draw(1), targets, 1.0)


if __name__ == "__main__":
    main()
