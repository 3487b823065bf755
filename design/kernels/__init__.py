"""Compiled kernels: pure functions on arrays, in grid units."""

from pathlib import Path

from padforge.design.common.parallel import forget_outdated

forget_outdated(Path(__file__).parent)
