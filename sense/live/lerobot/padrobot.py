"""A robot of LeRobot with a pad: another robot with the observations of a pad added, or a pad alone.

LeRobot finds the class of a robot by the name of its config without `Config`, in a module of that name in lower case.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus  # pyright: ignore[reportMissingImports]
from lerobot.robots import Robot, RobotConfig, make_robot_from_config  # pyright: ignore[reportMissingImports]

from padforge.common.command_line import load_spec
from padforge.common.validation import InputError
from padforge.sense.live.pad_sensor import PadSensor
from padforge.sense.settings import RigSettings


@RobotConfig.register_subclass("padforge")
@dataclass(kw_only=True)
class PadRobotConfig(RobotConfig):
    """Options of the pad, those of `padforge sense live`, and of the other robot."""

    model: Path = Path("out/pad")
    rig: str = "simulated"
    spec: Path | None = None
    robot: dict[str, Any] | None = None  # type and options; a `RobotConfig` would be recursive


class PadRobot(Robot):
    """The robot of `config.robot`, if any, with additional observations `pad.NAME`."""

    config_class = PadRobotConfig
    name = "padforge"

    def __init__(self, config: PadRobotConfig) -> None:
        super().__init__(config)
        self._sensor = PadSensor(config.rig, config.model, load_spec(config.spec).section(RigSettings))
        robot = None if config.robot is None else draccus.decode(RobotConfig, config.robot)
        self._robot = None if robot is None else make_robot_from_config(robot)
        self._pad_features = {f"pad.{name}": float for name in self._sensor.names}
        if self._robot is not None and (common := self._pad_features.keys() & self._robot.observation_features.keys()):
            raise InputError(f"--robot.robot has an observation {min(common)}, which is the pad's")

    @property
    def cameras(self) -> dict[str, Any]:
        return {} if self._robot is None else getattr(self._robot, "cameras", {})

    @property
    def observation_features(self) -> dict[str, Any]:
        return self._pad_features if self._robot is None else self._robot.observation_features | self._pad_features

    @property
    def action_features(self) -> dict[str, Any]:
        return {} if self._robot is None else self._robot.action_features

    @property
    def is_connected(self) -> bool:
        return self._sensor.is_connected and (self._robot is None or self._robot.is_connected)

    @property
    def is_calibrated(self) -> bool:
        return self._robot is None or self._robot.is_calibrated

    def connect(self, calibrate: bool = True) -> None:
        self._sensor.connect()  # first, so that no arm is powered if the pad is missing
        if self._robot is not None:
            try:
                self._robot.connect(calibrate)
            except BaseException:
                self._sensor.close()
                raise

    def calibrate(self) -> None:
        if self._robot is not None:
            self._robot.calibrate()

    def configure(self) -> None:
        if self._robot is not None:
            self._robot.configure()

    def get_observation(self) -> dict[str, Any]:
        pad = {f"pad.{name}": value for name, value in self._sensor.read().items()}
        return pad if self._robot is None else self._robot.get_observation() | pad

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return action if self._robot is None else self._robot.send_action(action)

    def disconnect(self) -> None:
        self._sensor.close()
        if self._robot is not None:
            self._robot.disconnect()
