"""Formats of recordings: CSV, HDF5, MATLAB, ROS bags and LeRobot datasets."""
