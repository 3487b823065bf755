"""A session of presses on a rig."""
