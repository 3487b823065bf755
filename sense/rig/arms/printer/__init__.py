"""A 3D printer with a probe clamped beside its nozzle."""
