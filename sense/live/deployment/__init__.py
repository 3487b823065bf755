"""The localizer on other machines: as an ONNX graph, and as a C header for microcontrollers."""
