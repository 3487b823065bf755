"""A student of the quickly trained localizer, and its header compiled for this computer."""

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
from padforge.sense.deploy.c_header import c_header
from padforge.sense.deploy.streaming import Budget
from padforge.sense.deploy.student import Student, as_int8, split, teach
from padforge.sense.localizer.model import LocalizerModel
from tests.sense.conftest import QUICK

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
BUDGET = Budget(40_000, 8_000)
SHORT = QUICK.model_copy(update={"epochs": 4})


class Told(NamedTuple):
    """What the C program tells: bytes of state and tables; a row an event: n, what, x, y, r50, r90, lost, ..."""

    state: int
    tables: int
    events: Array

    @property
    def places(self) -> Array:
        """Those events that have a place."""
        return self.events[(self.events[:, 1].astype(int) & 2) > 0]


Program = Callable[..., Told]


def tutorial(name: str, language: str) -> str:
    """The code in the tutorial that follows the comment of a name."""
    text = (ROOT / "docs" / "tutorial-sense.md").read_text(encoding="utf-8")
    found = re.search(rf"<!-- {name} -->\n```{language}\n(.*?)```", text, re.DOTALL)
    assert found is not None
    return found[1]


def compiled(source: Path, folder: Path, *flags: str) -> Path:
    """A C99 program of a source beside `localizer.h` in a folder; the test is skipped where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler, cc")
    program = folder / "program"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O2", *flags]
    subprocess.run([compiler, *strict, "-I", folder, source, "-o", program, "-lm"], check=True)
    return program


@pytest.fixture(scope="session")
def taught(recording: Recording, localizer: LocalizerModel) -> Student:
    return teach(recording, localizer, split(recording, localizer, SHORT)[0], BUDGET, SHORT)


@pytest.fixture(scope="session")
def quantized(taught: Student) -> Student:
    """The same in int8."""
    weights = as_int8(taught.localizer.weights)
    return replace(taught, localizer=replace(taught.localizer, weights=weights), quantized=True)


@pytest.fixture(scope="session")
def deeply(deep_recording: Recording, deep_localizer: LocalizerModel) -> Student:
    """One that has learnt depth and force."""
    training, _ = split(deep_recording, deep_localizer, SHORT)
    return teach(deep_recording, deep_localizer, training, BUDGET, SHORT)


def program_of(student: Student, folder: Path, *flags: str, budget: Budget = BUDGET, text: str = "") -> Program:
    """A program with the header of a student: takes readings, whether the pad is pressed, and lost fibres."""
    (folder / "localizer.h").write_text(text or c_header(student, budget, ["of a test"]))
    path = compiled(HERE / "driver.c", folder, *flags)

    def run(readings: Array, held: Mask | None = None, lost: tuple[int, ...] = ()) -> Told:
        pressed = np.full(len(readings), -1) if held is None else held
        rows = np.column_stack([readings, pressed]).astype(np.float32).tobytes()
        mask = "".join("0" if fibre in lost else "1" for fibre in range(student.localizer.fibres))
        lines = subprocess.run([path, mask], input=rows, capture_output=True, check=True).stdout.split(b"\n")
        state, tables = map(int, lines[0].split())
        events = np.array([line.split() for line in lines[1:-1]], float)
        return Told(state, tables, events if len(events) else np.empty((0, 7)))

    return run


@pytest.fixture(scope="session")
def program(taught: Student, tmp_path_factory: pytest.TempPathFactory) -> Program:
    """That of the student as it was taught."""
    return program_of(taught, tmp_path_factory.mktemp("program"))
