"""Run modules with LeRobot, one after the other: `python run.py MODULE ARGUMENTS + MODULE ARGUMENTS`."""

import runpy
import sys

import torch

try:
    import torchvision  # noqa: F401  # pyright: ignore[reportMissingImports]
except RuntimeError:  # PyPI's Linux wheel needs CUDA for its operators; LeRobot imports it and calls none of them here
    operators = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        operators.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

words = sys.argv[1:]
while words:
    end = words.index("+") if "+" in words else len(words)
    sys.argv, words = words[:end], words[end + 1 :]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
