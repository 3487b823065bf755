"""The localizer in other programs, as an ONNX model."""

import os

# Set before onnxruntime is loaded, which otherwise stores an identifier of the user and reports to its maker.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
