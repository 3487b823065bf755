"""A 3D printer of this machine: its firmware, and the pseudo-terminal at which it listens."""
