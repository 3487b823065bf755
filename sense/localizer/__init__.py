"""The localizer: from presses to places."""

from pathlib import Path

from padforge.design.common.compilation import announce_compilation
from padforge.design.common.parallel import clear_stale_kernels

announce_compilation()
clear_stale_kernels(Path(__file__).parent)
