"""Students of the quickly trained localizer, and their headers compiled for this computer."""

import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from padforge.sense import Recording
from padforge.sense.arrays import Array, Mask
from padforge.sense.deploy.c_header import StudentNetwork, distill, quantize, render_header
from padforge.sense.deploy.streaming import MemoryBudget
from padforge.sense.localizer.calibration import split_unseen
from padforge.sense.localizer.model import LocalizerModel
from tests.sense.conftest import QUICK

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
BUDGET = MemoryBudget(40_000, 8_000)
SHORT = QUICK.model_copy(update={"epochs": 4})


class Output(NamedTuple):
    """Output of the C program: bytes of state and tables; a row an event.

    Its columns are n, kind, x, y, r50, r90, n_failed, n_readings, is_final, and depth and force where they are there.
    """

    state: int
    tables: int
    events: Array

    @property
    def positions(self) -> Array:
        """The events that have a position."""
        return self.events[(self.events[:, 1].astype(int) & 2) > 0]


def tutorial_code(name: str, language: str) -> str:
    """The code in the tutorial that follows the comment of a name."""
    text = (ROOT / "docs" / "howto-microcontroller.md").read_text(encoding="utf-8")
    match = re.search(rf"<!-- {name} -->\n```{language}\n(.*?)```", text, re.DOTALL)
    assert match is not None
    return match[1]


def compile_c(source: Path, folder: Path, *flags: str) -> Path:
    """Compile a C99 source with `localizer.h` in a folder; the test is skipped where there is no compiler."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler, cc")
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O2", *flags]
    subprocess.run(["cc", *strict, "-I", folder, source, "-o", folder / "program", "-lm"], check=True)
    return folder / "program"


@pytest.fixture(scope="session")
def student(recording: Recording, localizer: LocalizerModel) -> StudentNetwork:
    return distill(recording, localizer, split_unseen(recording, localizer, SHORT)[0], BUDGET, SHORT)


@pytest.fixture(scope="session")
def quantized(student: StudentNetwork) -> StudentNetwork:
    """The same in int8."""
    networks = {name: quantize(weights) for name, weights in student.model.networks.items()}
    return replace(student, model=replace(student.model, networks=networks), quantized=True)


@pytest.fixture(scope="session")
def deep_student(deep_recording: Recording, deep_localizer: LocalizerModel) -> StudentNetwork:
    """A student that predicts depth and force."""
    training, _ = split_unseen(deep_recording, deep_localizer, SHORT)
    return distill(deep_recording, deep_localizer, training, BUDGET, SHORT)


def build_program(
    student: StudentNetwork, folder: Path, *flags: str, budget: MemoryBudget = BUDGET, text: str = ""
) -> Callable[..., Output]:
    """Build a program that takes readings, whether the pad is pressed, and failed fibres."""
    (folder / "localizer.h").write_text(text or render_header(student, budget, ["of a test"]))
    path = compile_c(HERE / "driver.c", folder, *flags)

    def run(readings: Array, pressed: Mask | None = None, failed: tuple[int, ...] = ()) -> Output:
        held = np.full(len(readings), -1) if pressed is None else pressed
        rows = np.column_stack([readings, held]).astype(np.float32).tobytes()
        mask = "".join("0" if fibre in failed else "1" for fibre in range(student.model.fibres))
        lines = subprocess.run([path, mask], input=rows, capture_output=True, check=True).stdout.split(b"\n")
        state, tables = map(int, lines[0].split())
        events = np.array([line.split() for line in lines[1:-1]], float)
        return Output(state, tables, events if len(events) else np.empty((0, 9)))

    return run


@pytest.fixture(scope="session")
def program(student: StudentNetwork, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Output]:
    return build_program(student, tmp_path_factory.mktemp("program"))
