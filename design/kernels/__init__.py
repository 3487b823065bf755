"""Compiled kernels: pure functions on arrays, in grid units."""
