"""The program as people call it: in a process of its own, or in this one, which spares its imports."""

import subprocess
import sys
from contextlib import chdir

from tests.stress.door import Ended, call


def padforge(*arguments, cwd):
    command = [sys.executable, "-m", "padforge", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def called(*arguments, cwd, limit_s=60) -> Ended:
    """What a command ends with, in this process."""
    with chdir(cwd):
        return call(*arguments, limit_s=limit_s)
