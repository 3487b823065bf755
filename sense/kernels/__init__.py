"""Compiled kernels: pure functions on arrays of readings."""
