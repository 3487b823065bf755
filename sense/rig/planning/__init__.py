"""Where a rig presses."""
