"""Filters and press detection: from voltages to presses."""

from pathlib import Path

from padforge.design.common.compilation import announce_compilation
from padforge.design.common.parallel import clear_stale_kernels

announce_compilation()
clear_stale_kernels(Path(__file__).parent)
