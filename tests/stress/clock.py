"""What stress tests share: a clock that ends what hangs, and how many cases are tried.

Everyday runs try few cases of each kind; `pytest tests/stress --hypothesis-profile=stress` tries a thousand.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

import hypothesis

LIMIT_S = 10
"""Beyond this a call counts as hung."""


class Hung(BaseException):
    """Work did not end in time; no code under test catches this."""


@contextmanager
def ends_in_time(limit_s: float = LIMIT_S) -> Iterator[None]:
    """Raise Hung in the main thread where the body takes longer than `limit_s`."""

    def ring(number: int, frame: object) -> None:
        raise Hung(f"not done after {limit_s} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def few(examples: int) -> hypothesis.settings:
    """Settings of a test that tries `examples` cases in everyday runs, and as many as the profile says under stress."""
    default = hypothesis.settings.default
    assert default is not None
    stressed = default.max_examples >= hypothesis.settings.get_profile("stress").max_examples
    return hypothesis.settings(max_examples=default.max_examples if stressed else examples)
