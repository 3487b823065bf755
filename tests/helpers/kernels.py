"""Compiles what numba has not kept from an earlier session, before workers would each do the same.

`python -m tests.helpers.kernels design|sense` does it for one half of the packages.
"""

import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("design", "fabricate", "sense")


def missing() -> bool:
    """Whether there is a file of kernels of which nothing is kept that is as new."""
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        if b"\n@njit(cache=True" in path.read_bytes():
            kept = (path.parent / "__pycache__").glob(f"{path.stem}.*.nbi")
            if not any(index.stat().st_mtime >= path.stat().st_mtime for index in kept):
                return True
    return False


def compile_all() -> None:
    """Compile both halves at once."""
    halves = [subprocess.Popen([sys.executable, "-m", "tests.helpers.kernels", half], cwd=ROOT) for half in HALVES]
    for half in halves:
        half.wait()


def design_kernels() -> None:
    """Contacts, criteria, a search and a check of a mould."""
    from padforge.design import (
        Contact,
        Indenter,
        Morphology,
        PadSettings,
        RulesSettings,
        SearchSettings,
        check_rules,
        indented_signals,
        published_objective,
        search,
        signals,
        signals_quantized,
        signals_sparse,
    )
    from padforge.design.objectives.ambiguity import ambiguity_map
    from padforge.design.objectives.published import disorder_area
    from padforge.design.settings import PUBLISHED_CONTACT
    from padforge.fabricate import build, check_mesh

    pad, presses = Morphology.random(2, 3, seed=1), np.array([[1.0, 1.0], [1.5, 2.0]])
    ways = product((None, 30), ("uniform", "inverse_square", "inverse"), ("manhattan", "euclidean"))
    named: list[dict[str, Any]] = [
        {"sides": sides, "weight": weight, "length": length} for sides, weight, length in ways
    ]
    for contact in (Contact(), *(PUBLISHED_CONTACT.model_copy(update=way) for way in named)):
        signals(pad, presses, contact)
        signals_sparse(pad, presses, contact)
    signals_quantized(pad, presses)
    published_objective(pad)
    disorder_area(pad)
    ambiguity_map(pad, presses, Contact(), 1, 0.1)
    indented_signals(pad, presses, 0.1, Indenter())
    check_rules(pad, RulesSettings())
    for contact in (Contact(), PUBLISHED_CONTACT):
        search(PadSettings(grid=1), contact, SearchSettings(knots=1, starts=1, steps=2, max_failures=1))
    with tempfile.TemporaryDirectory() as folder:
        build(Morphology.straight(1), folder, ["stl"])
        check_mesh(Path(folder) / "mould.stl")


def sense_kernels() -> None:
    """Filters, presses, a calibration, health, a twin and places as they come."""
    from padforge.design import Morphology
    from padforge.sense import (
        LocalizerSettings,
        RigSettings,
        calibrate,
        detect_presses,
        identify,
        running_median,
        simulate,
        total_variation,
    )
    from padforge.sense.deploy.streaming import ThresholdDetector

    recording = simulate(Morphology.straight(2), RigSettings(presses=60))
    total_variation(recording.readings, 2.0)
    total_variation(recording.readings, 2.0, "squares", causal=True)
    running_median(recording.readings, 5)
    detect_presses(recording.readings, recording.times_s)
    localizer, _ = calibrate(
        recording, LocalizerSettings(members=1, hidden=8, layers=1, epochs=1, batch=64, max_failures=1)
    )
    localizer.predict(recording)
    ThresholdDetector.fit(recording, np.arange(20))
    identify(recording, Morphology.straight(2))


HALVES = {"design": design_kernels, "sense": sense_kernels}

if __name__ == "__main__":
    HALVES[sys.argv[1]]()
