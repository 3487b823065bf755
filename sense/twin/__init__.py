"""The twin is the as-built model (digital twin) of a printed pad, identified from a recording of presses."""

from pathlib import Path

from padforge.design.common.compilation import clear_stale_kernels

clear_stale_kernels(Path(__file__).parent)
