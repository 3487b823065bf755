"""How functions that take long report their progress."""

from collections.abc import Callable

OnProgress = Callable[[int, int, str], None]
"""Called with steps done, steps in all (0 if unknown), and what is being done, in a few words or none."""


def ignore_progress(done: int, total: int, what: str) -> None:
    """Show nothing."""
