"""A thread that waits for the disk, so that whoever watches the arm never does."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, Self


class DiskThread:
    """Does what it is given in its order, in a thread of its own; after a failure it does nothing more.

    A context, which it is ended with.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "disk")
        self._last: Future[None] = Future()
        self._last.set_result(None)

    def do(self, call: Callable[..., Any], *arguments: Any, **more: Any) -> None:
        """Give it a call to make after all that it was given before."""
        before = self._last

        def work() -> None:
            before.result()
            call(*arguments, **more)

        self._last = self._pool.submit(work)

    def idle(self, within_s: float = 0.0) -> bool:
        """Wait for so long at most; whether all it was given is done. Raises what a call that failed did raise."""
        done = bool(wait([self._last], within_s).done)
        if done:
            self._last.result()
        return done

    def end(self) -> None:
        """Wait until all is done that could be; raises nothing."""
        self._pool.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()
