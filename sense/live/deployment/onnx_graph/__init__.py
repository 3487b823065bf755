"""The localizer as nodes of an ONNX graph."""
