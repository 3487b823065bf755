"""The program as people call it, in a process of its own."""

import subprocess
import sys


def padforge(*arguments, cwd):
    command = [sys.executable, "-m", "padforge", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
