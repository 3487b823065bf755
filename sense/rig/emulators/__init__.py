"""Devices that are not there: emulated board and arm, a live pad, the whole rig."""
