"""One thread for the libraries of a program that keeps the cores busy itself."""

import os
import sys


def on_one_thread() -> None:
    """Begin this program anew where libraries would compute on a thread a core: they read it as they are loaded."""
    one = {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    if not one.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | one)
