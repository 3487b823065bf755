"""The localizer: from presses to places."""

from pathlib import Path

from padforge.design.common.compilation import clear_stale_kernels

clear_stale_kernels(Path(__file__).parent)
