"""How much is tried: little every day, as much as the profile says under `--hypothesis-profile=stress`; on how much."""

import os
import sys

import hypothesis
import pytest

EVERY_DAY, STRESS = "padforge", "stress"
"""Names of the profiles."""
hypothesis.settings.register_profile(EVERY_DAY, deadline=None, derandomize=True)
hypothesis.settings.register_profile(STRESS, deadline=None, max_examples=1000, print_blob=True)


def few(examples: int) -> hypothesis.settings:
    """Settings of a test that tries `examples` cases in everyday runs, and as many as the profile says under stress."""
    default = hypothesis.settings.default
    assert default is not None
    stressed = default.max_examples >= hypothesis.settings.get_profile(STRESS).max_examples
    return hypothesis.settings(max_examples=default.max_examples if stressed else examples)


LONG = pytest.mark.skipif(few(1).max_examples == 1, reason="takes long; --hypothesis-profile=stress runs it")
"""Marks what ordinary days go without: cases of a kind that is tried on a smaller one as well."""


def on_one_thread() -> None:
    """Begin this program anew where libraries would compute on a thread a core: they read it as they are loaded."""
    one = {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    if not one.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | one)
