"""Rigs: what presses a pad and reads its fibres."""
