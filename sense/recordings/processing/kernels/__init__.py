"""Compiled kernels: pure functions on arrays of readings."""

from pathlib import Path

from padforge.design.common.parallel import forget_outdated

forget_outdated(Path(__file__).parent)
