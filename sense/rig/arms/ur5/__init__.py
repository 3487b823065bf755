"""The UR arm, in a process of its own."""
