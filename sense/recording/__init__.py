"""Recordings of readings and presses, on disk."""
