"""The localizer in other programs, as an ONNX model."""

import os

# read as onnxruntime is loaded, which else leaves a file with a number of its user and tells its maker what is run
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
