"""Run a module with LeRobot: `python run.py MODULE ARGUMENTS`."""

import runpy
import sys

import torch

try:
    import torchvision  # noqa: F401  # pyright: ignore[reportMissingImports]
except RuntimeError:  # PyPI's Linux wheel needs CUDA for its operators; LeRobot imports it and calls none of them here
    operators = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        operators.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

sys.argv = sys.argv[1:]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
