"""The robot `padforge` of LeRobot, which the package in `plugins/lerobot_robot_padforge` makes known to it."""
