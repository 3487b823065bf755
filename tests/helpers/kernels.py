"""Compiles what numba has not kept from an earlier session, before every worker would do the same.

`python -m tests.helpers.kernels` does it by hand; with the name of a task, for that alone.
"""

import subprocess
import sys
from collections.abc import Callable, Mapping

import numpy as np

from padforge.common.compilation import SOURCES, cache_folder


def missing() -> bool:
    """Whether of a file of kernels nothing is cached."""
    sources = [path for folder in SOURCES for path in folder.rglob("*.py") if b"\n@kernel" in path.read_bytes()]
    return any(not any(cache_folder().glob(f"{path.parent.name}_*/{path.stem}.*.nbi")) for path in sources)


def compile_all() -> None:
    """Compile in processes of their own, one a task, so that nothing is imported before the tests say so."""
    processes = [subprocess.Popen([sys.executable, __file__, name]) for name in TASKS]
    for process in processes:
        process.wait()


def use_design() -> None:
    """Call contacts, objectives, rules, and a search under a layer and under a shape."""
    from padforge import design
    from padforge.design.objectives.ambiguity import ambiguity_map
    from padforge.design.settings import PUBLISHED_CONTACT

    pad, presses = design.Morphology.random(2, 3, seed=1), np.array([[1.0, 1.0], [1.5, 2.0]])
    contacts = design.Contact(), PUBLISHED_CONTACT, PUBLISHED_CONTACT.model_copy(update={"sides": None})
    for contact in contacts:
        design.signals(pad, presses, contact)
    design.signals_quantized(pad, presses)
    design.published_objective(pad)
    ambiguity_map(pad, presses, contacts[0], 1, 0.1)
    design.check_rules(pad, design.RulesSettings())
    for contact in contacts[:2]:
        settings = design.SearchSettings(knots=1, starts=1, steps=2, max_failures=1)
        design.search(design.PadSettings(grid=1), contact, settings)


def use_other_stages() -> None:
    from padforge import design, sense
    from padforge.design.twin import PlanTransform
    from padforge.sense.twin.as_built import AsBuiltPad, PadPlan

    readings = np.random.default_rng(0).normal(size=(50, 1))
    sense.total_variation(readings, 2.0)
    sense.total_variation(readings, 2.0, "squares")
    sense.running_median(readings, 5)
    straight = design.Morphology.straight(2)
    recording = sense.simulate(straight, sense.RigSettings(presses=60))
    quick = sense.LocalizerSettings(members=1, hidden=8, layers=1, epochs=1, batch=64, max_failures=1)
    sense.calibrate(recording, quick)
    planned = PadPlan.from_morphology(straight)
    AsBuiltPad.from_plan(planned, (0,), PlanTransform(), 0.5).predict(np.zeros((1, 2)))


TASKS: Mapping[str, Callable[[], None]] = {"design": use_design, "other stages": use_other_stages}
"""What calls the kernels, at once; the few that both call are compiled twice."""


if __name__ == "__main__":
    for name in sys.argv[1:] or TASKS:
        TASKS[name]()
