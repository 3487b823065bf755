"""What is said of a rig before a long run; nothing moves."""

import numpy as np
import pytest

from padforge.sense.rig.devices import RigFault
from padforge.sense.rig.doctor import examine_arm, examine_converter
from tests.sense.rig.fakes import FIBRES, RIG, FakeArm, FakeConverter, Time


class Rig:
    """An arm and a board in virtual time; what the board reads of the first channel that is `spoiled` is replaced."""

    def __init__(self) -> None:
        self.time = Time()
        self.arm = FakeArm(self.time)
        self.converter = FakeConverter(self.arm)

    def spoil(self, channel, volts) -> None:
        read = self.converter.model.volts

        def spoiled(positions_mm, depths_mm):
            values = read(positions_mm, depths_mm)
            values[:, channel - 1] = volts(values[:, channel - 1])
            return values

        self.converter.model.volts = spoiled

    def board(self):
        return {each.name: each for each in examine_converter(self.converter, self.time, self.time.sleep)}

    def robot(self, **settings):
        rig = RIG.model_copy(update=settings)
        return {each.name: each for each in examine_arm(self.arm, rig, self.time, self.time.sleep)}


def test_a_healthy_rig_is_not_moved():
    rig = Rig()
    looked = rig.board() | rig.robot()
    assert {diagnosis.status for diagnosis in looked.values()} <= {"ok", "warn"}
    assert looked["rate"].found == "1000.0 Hz of 1000"
    assert looked["samples"].found.startswith("0 of")
    assert {f"channel {number}" for number in range(1, FIBRES + 1)} < set(looked)
    assert "channel 0" not in looked
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
def test_a_channel_without_a_sound_fibre_is_named(volts, status, word):
    rig = Rig()
    rig.spoil(3, volts)
    looked = rig.board()
    assert looked["channel 3"].status == status
    assert word in looked["channel 3"].found
    assert looked["channel 2"].status == "ok"


def test_lost_samples_another_rate_devices_that_are_not_there_and_a_stopped_arm_fail():
    rig = Rig()
    rig.converter.lose = 7
    found = rig.board()["samples"]
    assert (found.status, found.found.split()[0]) == ("fail", "7")
    said = rig.converter.connect()
    rig.converter.connect = lambda: said | {"rate_hz": 1020.0, "warning": "its lines have no check"}
    looked = rig.board()
    assert (looked["rate"].status, looked["board"].status) == ("fail", "warn")
    rig = Rig()
    rig.converter.lost = rig.arm.lost = True
    assert [each.status for each in (*rig.board().values(), *rig.robot().values())] == ["fail", "fail"]
    for kind in ("protective", "emergency"):
        rig = Rig()
        setattr(rig.arm, f"{kind}_stop", True)
        safety = rig.robot()["safety"]
        assert (safety.status, safety.found) == ("fail", f"{kind} stop")


@pytest.mark.parametrize(
    ("force_n", "settings", "name", "status", "words"),
    [
        (0.3, {"max_force_n": 60.0}, "force", "ok", "0.3 N, stopped beyond 60 N"),
        (None, {"max_force_n": 60.0}, "force", "fail", 'no force; [rig] max_force_n is 60, allowed is "unwatched'),
        (None, {"max_force_n": None}, "force", "warn", "no force stops the arm"),
        (0.0, {"tcp_mm": (0.0, 0.0, 150.05)}, "tcp", "ok", "150.05"),
        (0.0, {"tcp_mm": None}, "tcp", "fail", "is unknown; allowed x, y and z of the tip as measured"),
        (0.0, {"tcp_mm": (0.0, 0.0, 149.0)}, "tcp", "fail", "149.0]; allowed what the controller says, [0.0, 0.0, 150"),
    ],
)
def test_a_force_that_nobody_watches_and_a_tip_that_is_elsewhere_are_told(
    monkeypatch, force_n, settings, name, status, words
):
    rig = Rig()
    rig.arm.force_n = force_n
    monkeypatch.setattr(rig.arm, "connect", lambda: {"tcp": [0.0, 0.0, 150.0, 0.0, 0.0, 0.0]})
    looked = rig.robot(**settings)[name]
    assert looked.status == status
    assert words in looked.found


def test_a_fault_is_told_with_its_advice():
    fault = RigFault("refused", "the port is in use", "close the other program")
    assert str(fault) == "the port is in use; close the other program"
    assert (fault.exit_code, RigFault("lost", "gone").exit_code) == (2, 1)
