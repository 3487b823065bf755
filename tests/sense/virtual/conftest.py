"""The clock by which tests of whole rigs go."""

from collections.abc import Iterator

import pytest

from tests.helpers.steady_clock import SteadyClock, steady_clock


@pytest.fixture
def steady() -> Iterator[SteadyClock]:
    """The clock of rigs stands still for all while one of their threads gets no processor."""
    with steady_clock() as clock:
        yield clock
