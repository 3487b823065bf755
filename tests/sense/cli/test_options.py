import os
import sys

import pytest

from sense.cli.options import typed_keys


@pytest.mark.skipif(os.name != "posix", reason="keys are read of POSIX terminals alone")
def test_keys_are_read_as_they_are_typed_and_the_terminal_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    import termios

    ours, theirs = os.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        before = termios.tcgetattr(terminal)
        with typed_keys() as typed:
            assert typed() == ""
            os.write(ours, b"sb")  # no newline
            assert typed() == "sb"
            assert typed() == ""
        assert termios.tcgetattr(terminal) == before
    os.close(ours)


def test_where_there_is_no_terminal_nothing_is_typed(monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull) as nothing:  # noqa: PTH123
        monkeypatch.setattr(sys, "stdin", nothing)
        with typed_keys() as typed:
            assert typed() == ""
