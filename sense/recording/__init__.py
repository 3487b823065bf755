"""Recordings: what was read and where was pressed, on disk."""
