"""LeRobot imports every installed package of such a name, and so knows the robot `padforge`."""

from padforge.sense.live.lerobot.padrobot import PadRobot as PadRobot
from padforge.sense.live.lerobot.padrobot import PadRobotConfig as PadRobotConfig
