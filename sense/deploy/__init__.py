"""The localizer on other machines: ONNX models, and C headers for microcontrollers."""

import os
from pathlib import Path

from padforge.design.common.compilation import clear_stale_kernels

clear_stale_kernels(Path(__file__).parent)
# read as onnxruntime is loaded, which else leaves a file with a number of its user and tells its maker what is run
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
