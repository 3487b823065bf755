"""Diagnoses of a rig before a long run; nothing moves."""

import numpy as np
import pytest

from padforge.sense.rig.doctor import examine_arm, examine_board
from tests.sense.rig.fakes import FIBRES, RIG, FakeArm, FakeBoard, Time


class Rig:
    """An arm and a board in virtual time; readings of a channel can be replaced."""

    def __init__(self) -> None:
        self.time = Time()
        self.arm = FakeArm(self.time)
        self.board = FakeBoard(self.arm)

    def replace_readings(self, channel, volts) -> None:
        read = self.board.model.volts

        def replaced(positions_mm, depths_mm):
            values = read(positions_mm, depths_mm)
            values[:, channel - 1] = volts(values[:, channel - 1])
            return values

        self.board.model.volts = replaced

    def examine_board(self):
        with self.time.of_all():
            return {row.name: row for row in examine_board(self.board)}

    def examine_arm(self, **settings):
        rig = RIG.model_copy(update=settings)
        with self.time.of_all():
            return {row.name: row for row in examine_arm(self.arm, rig)}


def test_examine_moves_nothing():
    rig = Rig()
    rows = rig.examine_board() | rig.examine_arm()
    assert {diagnosis.status for diagnosis in rows.values()} <= {"ok", "warn"}
    assert rows["rate"].message == "1000.0 Hz of 1000"
    assert rows["samples"].message.startswith("0 of")
    assert {f"channel {number}" for number in range(1, FIBRES + 1)} < set(rows)
    assert "channel 0" not in rows
    assert rig.arm.moves == []


@pytest.mark.parametrize(
    ("volts", "status", "word"),
    [
        (lambda volts: 0.0, "fail", "dead"),
        (lambda volts: 3.3, "fail", "saturated"),
        (lambda volts: 1.5, "warn", "never changes"),
        (lambda volts: volts + 0.05 * np.random.default_rng(0).standard_normal(len(volts)), "warn", "noisy"),
    ],
)
def test_examine_board_names_a_channel_without_a_fibre(volts, status, word):
    rig = Rig()
    rig.replace_readings(3, volts)
    rows = rig.examine_board()
    assert rows["channel 3"].status == status
    assert word in rows["channel 3"].message
    assert rows["channel 2"].status == "ok"


def test_examine_fails_devices_that_are_lost_late_or_stopped():
    rig = Rig()
    rig.board.lose = 7
    samples = rig.examine_board()["samples"]
    assert (samples.status, samples.message.split()[0]) == ("fail", "7")
    identity = rig.board.connect() | {"inputs": [14, 3, 0, 1]}
    rig.board.connect = lambda: identity | {"rate_hz": 1020.0, "warning": "its lines have no check"}
    rows = rig.examine_board()
    assert rows["channel 1"].message.startswith("input 14 rests at")
    assert (rows["rate"].status, rows["board"].status) == ("fail", "warn")
    rig = Rig()
    rig.board.lost = rig.arm.lost = True
    assert [row.status for row in (*rig.examine_board().values(), *rig.examine_arm().values())] == ["fail", "fail"]
    for kind in ("protective", "emergency"):
        rig = Rig()
        setattr(rig.arm, f"{kind}_stop", True)
        safety = rig.examine_arm()["safety"]
        assert (safety.status, safety.message) == ("fail", f"{kind} stop")


@pytest.mark.parametrize(
    ("force_n", "settings", "name", "status", "words"),
    [
        (0.3, {"max_force_n": 60.0}, "force", "ok", "0.3 N, stopped beyond 60 N"),
        (None, {"max_force_n": 60.0}, "force", "fail", 'no force; [rig] max_force_n is 60, allowed is "unwatched'),
        (None, {"max_force_n": None}, "force", "warn", "no force stops the arm"),
        (0.0, {"tcp_mm": (0.0, 0.0, 150.05)}, "tcp", "ok", "150.05"),
        (0.0, {"tcp_mm": (0.0, 0.0, 149.0)}, "tcp", "fail", "149.0]; allowed what the controller says, [0.0, 0.0, 150"),
    ],
)
def test_examine_arm_checks_force_and_tcp(monkeypatch, force_n, settings, name, status, words):
    rig = Rig()
    rig.arm.force_n = force_n
    monkeypatch.setattr(rig.arm, "connect", lambda: {"tcp": [0.0, 0.0, 150.0, 0.0, 0.0, 0.0]})
    row = rig.examine_arm(**settings)[name]
    assert row.status == status
    assert words in row.message


def test_examine_arm_tells_the_usual_rate_and_the_longest_gap():
    """Of states 10 ms apart but for one gap of half a second."""
    rig = Rig()
    times_s = np.cumsum([0.0, *[0.01] * 60, 0.5, *[0.01] * 60])
    rig.arm.drain = lambda: np.column_stack([times_s, np.zeros((len(times_s), 9))])
    row = rig.examine_arm()["states"]
    assert (row.status, row.message) == ("warn", "100 Hz, longest gap 500 ms")
