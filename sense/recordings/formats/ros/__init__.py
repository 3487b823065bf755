"""Recordings as bags of ROS 2, of padforge's own form and of anyone's: MCAP and SQLite files, and folders of such."""
