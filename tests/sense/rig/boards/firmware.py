"""Sketches for boards, compile_sketch for this computer with stand-ins for their chips."""

import shutil
import subprocess
from pathlib import Path

import pytest

STUBS = Path(__file__).parent / "stub"


def compile_sketch(stub: str, sketch: Path, folder: Path, *defines: str) -> Path:
    """Compile a sketch with a stub for its chip into `folder`; skip the test without g++."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("there is no g++")
    path = folder / "board"
    flags = ["-std=gnu++11", "-Wall", "-Wextra", "-Werror", *(f"-D{name}" for name in defines)]
    subprocess.run([compiler, *flags, "-I", STUBS, "-I", sketch, STUBS / f"{stub}.cpp", "-o", path], check=True)
    return path


def run_sketch(program: Path, script: list[str]) -> bytes:
    """Return what the board sends while it runs a script, see the stubs."""
    text = "\n".join(script).encode()
    return subprocess.run([program], input=text, capture_output=True, check=True, timeout=20).stdout
