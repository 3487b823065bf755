"""Compiles what numba has not kept from an earlier session, before every worker would do the same.

`python -m tests.helpers.kernels` does it by hand.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import padforge

PACKAGES = ("design", "fabricate", "sense")


def missing() -> bool:
    """Whether there is a file of kernels of which nothing is kept that is as new."""
    folders = [Path(folder) / package for folder in padforge.__path__ for package in PACKAGES]
    for path in (path for folder in folders for path in folder.rglob("*.py")):
        if b"\n@kernel" in path.read_bytes():
            cached = (path.parent / "__pycache__").glob(f"{path.stem}.*.nbi")
            if not any(index.stat().st_mtime >= path.stat().st_mtime for index in cached):
                return True
    return False


def compile_all() -> None:
    """Compile in a process of its own, so that nothing is imported before the tests say so."""
    subprocess.run([sys.executable, __file__], check=False)


def use_kernels() -> None:
    """Call what has kernels: contacts, objectives, a search, a mould's check, filters, a calibration and a twin."""
    from padforge import design, fabricate, sense
    from padforge.design.objectives.ambiguity import ambiguity_map
    from padforge.design.settings import PUBLISHED_CONTACT
    from padforge.sense.deploy.streaming import ThresholdDetector

    pad, presses = design.Morphology.random(2, 3, seed=1), np.array([[1.0, 1.0], [1.5, 2.0]])
    contacts = design.Contact(), PUBLISHED_CONTACT, PUBLISHED_CONTACT.model_copy(update={"sides": None})
    for contact in contacts:
        design.signals(pad, presses, contact)
        design.signals_sparse(pad, presses, contact)
    design.signals_quantized(pad, presses)
    design.published_objective(pad)
    ambiguity_map(pad, presses, contacts[0], 1, 0.1)
    design.check_rules(pad, design.RulesSettings())
    for contact in contacts[:2]:
        settings = design.SearchSettings(knots=1, starts=1, steps=2, max_failures=1)
        design.search(design.PadSettings(grid=1), contact, settings)
    with tempfile.TemporaryDirectory() as folder:
        fabricate.build(design.Morphology.straight(1), folder, ["stl"])
        fabricate.check_mesh(Path(folder) / "mould.stl")
    straight = design.Morphology.straight(2)
    recording = sense.simulate(straight, sense.RigSettings(presses=60))
    sense.total_variation(recording.readings, 2.0)
    sense.total_variation(recording.readings, 2.0, "squares", causal=True)
    sense.running_median(recording.readings, 5)
    sense.detect_presses(recording.readings, recording.times_s)
    quick = sense.LocalizerSettings(members=1, hidden=8, layers=1, epochs=1, batch=64, max_failures=1)
    localizer, _ = sense.calibrate(recording, quick)
    localizer.predict(recording)
    ThresholdDetector.fit(recording, np.arange(20))
    sense.identify(recording, straight)


if __name__ == "__main__":
    use_kernels()
