"""Open datasets with LeRobot, and write what it reads of each as JSON beside its folder: `FOLDER ...`."""

import json
import sys
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]

for folder in sys.argv[1:]:
    dataset = LeRobotDataset("padforge/test", root=folder)
    (frames,) = torch.utils.data.DataLoader(dataset, batch_size=len(dataset))
    about = {
        "fps": dataset.fps,
        "robot_type": dataset.meta.robot_type,
        "features": {name: feature["names"] for name, feature in dataset.features.items()},
        "episodes": [[each["dataset_from_index"], each["dataset_to_index"]] for each in dataset.meta.episodes],
        "tasks": frames.pop("task"),
        "stats": {
            name: {key: value.tolist() for key, value in statistics.items()}
            for name, statistics in dataset.meta.stats.items()
        },
        "frames": {name: values.tolist() for name, values in frames.items()},
    }
    Path(folder).with_suffix(".json").write_text(json.dumps(about), encoding="utf-8")
