from dataclasses import dataclass

from lerobot.robots import Robot, RobotConfig  # pyright: ignore[reportMissingImports]
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig  # pyright: ignore[reportMissingImports]


class Device:
    """What both are: calibrated, and connected as they are told."""

    is_connected, is_calibrated = False, True
    action_features = observation_features = {"elbow.pos": float, "wrist.pos": float}  # noqa: RUF012
    feedback_features: dict[str, type] = {}  # noqa: RUF012

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def send_feedback(self, feedback: dict[str, float]) -> None: ...


@RobotConfig.register_subclass("virtual_arm")
@dataclass(kw_only=True)
class VirtualArmConfig(RobotConfig):
    start: float = 0.0


class VirtualArm(Device, Robot):
    config_class, name = VirtualArmConfig, "virtual_arm"

    def __init__(self, config: VirtualArmConfig) -> None:
        super().__init__(config)  # pyright: ignore[reportCallIssue]
        self.positions = {"elbow.pos": config.start, "wrist.pos": config.start}
        self.cameras = {}

    def get_observation(self) -> dict[str, float]:
        return self.positions

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.positions = action
        return action


@TeleoperatorConfig.register_subclass("virtual_leader")
@dataclass(kw_only=True)
class VirtualLeaderConfig(TeleoperatorConfig): ...


class VirtualLeader(Device, Teleoperator):
    config_class, name = VirtualLeaderConfig, "virtual_leader"
    position = 0.0

    def get_action(self) -> dict[str, float]:
        self.position += 1.0
        return {"elbow.pos": self.position, "wrist.pos": -self.position}
