"""Benchmarks: run time against error of the package, beside published and plain implementations."""
