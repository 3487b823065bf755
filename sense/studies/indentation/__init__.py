"""Depth, force and shape of what presses."""
