"""Ctrl-C, and whatever else ends a program, at an arm in motion: never missed, and never in the way of its retreat."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


class Interrupts:
    """A context that notes the first signal to end, and then does with it what was done before.

    More signals are passed over until what is `held` is through.
    An exception that a signal raises is lost where it happens to meet a callback of C code or a finalizer, so that it
    has to be asked for as well. Only the main thread hears signals; in another one nothing is done.
    """

    def __init__(self) -> None:
        self._heard = self._held = False
        self._before: dict[int, Any] = {}

    @contextmanager
    def held(self) -> Iterator[None]:
        """Within, signals are passed over: what is done is short, and has to come to its end."""
        self._held = True
        yield
        self._heard = self._held = False

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal has come."""
        if self._heard:
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for name in set(_SIGNALS) & set(dir(signal)):
                number = getattr(signal, name)
                if callable(before := signal.getsignal(number)):  # else it is ignored, as under nohup, or not ours
                    self._before[number] = before
                    signal.signal(number, self._handler(before))
        return self

    def __exit__(self, *error: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _handler(self, before: Callable[[int, FrameType | None], Any]) -> Callable[[int, FrameType | None], None]:
        def hear(number: int, frame: FrameType | None) -> None:
            if not (self._held or self._heard):
                self._heard = True
                before(number, frame)

        return hear
