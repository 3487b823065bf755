"""The localizer on other machines: as an ONNX graph, and as a C header for microcontrollers."""

import os

# read as onnxruntime is loaded, which else leaves a file with a number of its user and tells its maker what is run
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
