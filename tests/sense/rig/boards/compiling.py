"""Sketches for boards, compiled for this computer with stand-ins for their chips."""

import shutil
import subprocess
from pathlib import Path

import pytest

STUBS = Path(__file__).parent / "stub"


def compiled(stub: str, sketch: Path, folder: Path, *defines: str) -> Path:
    """The program of the sketch in a folder behind a stub, run by a script from its standard input, in `folder`.

    The test is skipped without g++.
    """
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("there is no g++")
    path = folder / "board"
    flags = ["-std=gnu++11", "-Wall", "-Wextra", "-Werror", *(f"-D{each}" for each in defines)]
    subprocess.run([compiler, *flags, "-I", STUBS, "-I", sketch, STUBS / f"{stub}.cpp", "-o", path], check=True)
    return path


def sent(program: Path, script: list[str]) -> bytes:
    """What the board sends as the script is run."""
    text = "\n".join(script).encode()
    return subprocess.run([program], input=text, capture_output=True, check=True, timeout=20).stdout
