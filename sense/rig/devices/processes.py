"""Starts a module of this package as a process of its own."""

import os
import platform
import subprocess
import sys
from pathlib import Path

from padforge.design.common.validation import InputError

ROOT = Path(__file__).parents[3]


def require_rig_system() -> None:
    """Raise InputError where rigs and their emulators, which need what POSIX has, cannot run."""
    if (here := platform.system()) not in ("Linux", "Darwin"):
        raise InputError(f"a rig needs Linux or macOS, this is {here}; allowed here is --rig simulated")


def start(module: str, *arguments: str, stderr: int | None = None) -> subprocess.Popen[bytes]:
    """Run `python -m module` with pipes to its stdin and stdout.

    It finds this package wherever it is started from, and no code of the folder it is started in, which may be
    anybody's. An interrupt from the keyboard does not reach it: its parent decides what is to end first.
    """
    path = os.pathsep.join((str(ROOT), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        env=os.environ | {"PYTHONPATH": path},
        start_new_session=True,
    )
