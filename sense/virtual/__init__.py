"""Emulated devices: a rig without hardware."""
