"""Callback for the progress of long functions."""

from collections.abc import Callable

OnProgress = Callable[[int, int, str], None]
"""Called with the number of completed steps, of all steps (0 if unknown), and a short description or ""."""


def ignore_progress(done: int, total: int, what: str) -> None:
    """Do nothing."""
