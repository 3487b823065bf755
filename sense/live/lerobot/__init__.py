"""The plugin of LeRobot: `--robot.discover_packages_path=padforge.sense.live.lerobot` loads its modules."""
