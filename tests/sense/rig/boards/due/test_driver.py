"""The converter through a real pseudo-terminal and real pyserial, against the emulated board and its faults."""

import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest

from design.common.errors import InputError
from sense.rig.boards import block_reader
from sense.rig.boards.due.driver import Arduino
from sense.rig.devices.protocols import ConverterSamples, RigFault
from sense.rig.emulators.due_board import EmulatedBoard
from tests.sense.rig.boards.reading import STEP_V, fault_of, joined, read_for, waves

pytest.importorskip("serial")
pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here")


@pytest.fixture(autouse=True)
def soon_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where times need not be exact, connecting need not take long."""
    monkeypatch.setattr(block_reader, "SETTLE_S", 0.15)


@contextmanager
def connected(board: EmulatedBoard, rate_hz: float = 1000.0, **options: Any) -> Iterator[Arduino]:
    with board, closing(Arduino(board.port, rate_hz, **options)) as converter:
        converter.connect()
        yield converter


def check(
    samples: ConverterSamples, board: EmulatedBoard, within_s: float = 0.05, inputs: Sequence[int] = range(12)
) -> np.ndarray:
    """Every reading is what the board read at that index, at the right time; returns the indices."""
    index = np.arange(len(samples.times_s)) + np.cumsum(samples.missing)
    truth = board.truth_s(index)
    assert samples.volts == pytest.approx(waves(truth)[:, list(inputs)], abs=0.501 * STEP_V)
    assert (np.diff(samples.times_s) > 0).all()
    assert np.abs(samples.times_s - truth).max() < within_s
    return index


def test_a_second_without_a_gap_right_to_a_step_and_on_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    board = EmulatedBoard(waves, skew_ppm=150)
    with board, closing(Arduino(board.port, 1000)) as converter:
        said = converter.connect()
        assert said.items() >= {"name": "padforge-due", "firmware": "1.0.0", "channels": 12, "bits": 12}.items()
        assert said["rate_hz"] == pytest.approx(1000)
        begun = time.process_time(), time.monotonic()
        samples = read_for(converter, 1.0)
        share = (time.process_time() - begun[0]) / (time.monotonic() - begun[1])
        assert len(samples.times_s) > 900
        assert not samples.missing.any()
        check(samples, board, within_s=5e-3)
        assert share < 0.2  # the emulated board included
        assert converter.statistics()["blocks"] == len(samples.times_s) / 16
        assert converter.statistics().keys() == {"blocks", "damaged", "missing", "overruns", "skew_ppm"}


@pytest.mark.parametrize(
    ("rate_hz", "options"),
    [(10.0, {}), (4000.0, {}), (1000.0, {"inputs": range(8), "averaging": 16}), (500.0, {"inputs": (11, 3, 0)})],
)
def test_other_rates_channels_and_averages(rate_hz: float, options: dict[str, Any]) -> None:
    board = EmulatedBoard(waves)
    with connected(board, rate_hz, **options) as converter:
        samples = read_for(converter, 0.1)
        assert len(samples.times_s) > 0.2 * rate_hz
        check(samples, board, inputs=options.get("inputs", range(12)))


def test_a_sample_is_complete_a_period_after_the_one_before() -> None:
    """Of the board itself, which is the truth of the tests here."""
    board = EmulatedBoard(waves, skew_ppm=1000)
    with connected(board, 500.0):
        assert board._started_s is not None
        since_s = board.truth_s(np.array([0, 9])) - board._started_s
        assert since_s == pytest.approx([2e-3 * 1.001, 20e-3 * 1.001], rel=1e-4)
        block = board._block(32, board.truth_s(32 + np.arange(4)))
        assert (block.first, block.time_us, len(block.counts)) == (32, 36 * 2000, 4)


def test_garbled_bytes_cost_samples_that_are_counted_and_never_give_a_wrong_one() -> None:
    board = EmulatedBoard(waves, seed=3)
    with connected(board) as converter:
        board.garble(2e-3)
        samples = read_for(converter, 0.75)
        board.garble(0)
        samples = joined([samples, read_for(converter, 0.1)])
        index = check(samples, board)
        statistics = converter.statistics()
        assert statistics["damaged"] > 5
        assert statistics["missing"] == samples.missing.sum() > 50
        assert statistics["overruns"] == 0
        assert index[-1] + 1 == len(index) + statistics["missing"]


def test_samples_the_board_drops_are_missing_and_counted() -> None:
    board = EmulatedBoard(waves)
    with connected(board) as converter:
        board.overrun(160)
        samples = read_for(converter, 0.3)
        check(samples, board)
        assert samples.missing.max() == samples.missing.sum() == 160
        assert converter.statistics()["overruns"] == 160


def test_unplugging_is_noticed_at_once_after_the_last_samples() -> None:
    board = EmulatedBoard(waves)
    with connected(board) as converter:
        board.unplug()
        assert len(converter.read().times_s) >= 96
        assert fault_of(converter.read, "lost", "the board is gone") < 2
        converter.close()
        fault_of(converter.read, "refused", "not connected")
        fault_of(converter.connect, "refused", "there is no such port")


def test_a_board_that_falls_silent_is_stale_after_a_second_and_comes_back_after_connecting_anew() -> None:
    board = EmulatedBoard(waves)
    with connected(board) as converter:
        board.stall()
        assert 0.5 < fault_of(converter.read, "stale") < 2.5
        board.stall(False)
        converter.connect()
        check(read_for(converter, 0.2), board)


def test_a_board_that_has_lost_conversions_ends_the_reading() -> None:
    board = EmulatedBoard(waves)
    with connected(board) as converter:
        board.halt()
        fault_of(converter.read, "data", "lost conversions")


def test_a_host_that_never_reads_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block_reader, "UNREAD_S", 0.4)
    board = EmulatedBoard(waves)
    with connected(board) as converter:
        time.sleep(0.5)
        check(converter.read(), board)
        fault_of(converter.read, "data", "nobody has read")


@pytest.mark.parametrize(
    ("options", "match"),
    [({"silent": True}, "no padforge board answers.*native USB port"), ({"firmware": (9, 1, 0)}, "firmware 9.1.0")],
)
def test_a_board_that_is_not_ours_is_refused(options: dict[str, Any], match: str) -> None:
    with EmulatedBoard(waves, **options) as board:
        assert fault_of(Arduino(board.port, 1000).connect, "refused", match) < 5


def test_an_input_the_board_has_not_is_refused_before_it_is_opened() -> None:
    with pytest.raises(RigFault, match=r"channels: fibre 2 is on input 12, an Arduino Due has 0 to 11") as caught:
        Arduino("port", 1000, (3, 12))
    assert caught.value.cause == "refused"


def test_a_rate_the_board_cannot_keep_is_refused_by_it() -> None:
    with EmulatedBoard(waves) as board:
        fault_of(Arduino(board.port, 10_000, averaging=16).connect, "refused", "12 channels at 10000 Hz")


def test_a_port_in_use_is_refused_and_free_again_after_close() -> None:
    with EmulatedBoard(waves) as board:
        first, second = Arduino(board.port, 1000), Arduino(board.port, 1000)
        first.connect()
        fault_of(second.connect, "refused", "another program uses it")
        first.close()
        first.close()
        second.connect()
        second.close()
    assert not any(thread.name == f"reader of {board.port}" for thread in threading.enumerate())


@pytest.mark.parametrize("values", [{"rate_hz": 9}, {"rate_hz": 10_001}, {"averaging": 0}])
def test_settings_out_of_range_are_named(values: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"{next(iter(values))} is .*expected"):
        Arduino("port", **{"rate_hz": 1000, **values})
