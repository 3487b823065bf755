"""What is given to the disk thread is done in order, and nobody waits for it who does not ask to."""

import threading

import pytest

from padforge.sense.rig.press_loop import DiskThread


def test_all_is_done_in_order_while_the_caller_goes_on_and_to_its_end() -> None:
    go, done = threading.Event(), []
    with DiskThread() as disk:
        disk.do(go.wait, 5)
        for number in range(9):
            disk.do(done.append, number)
        assert not disk.idle(0.01)
        assert done == []
        go.set()
    assert done == list(range(9))


def test_after_a_failure_nothing_more_is_done_and_it_is_told_whenever_asked() -> None:
    def full() -> None:
        raise OSError(28, "No space left on device")

    done: list[int] = []
    with DiskThread() as disk:
        disk.do(done.append, 1)
        disk.do(full)
        disk.do(done.append, 2)
        for _ in range(2):
            with pytest.raises(OSError, match="No space"):
                disk.idle(5)
    assert done == [1]
