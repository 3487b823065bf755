import numpy as np
import pytest

from sense.rig.devices.protocols import RigFault
from sense.rig.diagnostics import examine_arm, examine_converter
from tests.sense.rig.devices.fakes import FIBRES, RIG, FakeArm, FakeConverter, Time


def found(diagnoses):
    return {diagnosis.name: diagnosis for diagnosis in diagnoses}


@pytest.fixture
def rig():
    time = Time()
    arm = FakeArm(time)
    return time, arm, FakeConverter(arm)


def test_a_healthy_rig(rig):
    time, arm, converter = rig
    looked = found(examine_converter(converter, time, time.sleep) + examine_arm(arm, RIG, time, time.sleep))
    assert {diagnosis.status for diagnosis in looked.values()} <= {"ok", "warn"}
    assert looked["rate"].found == "1000.0 Hz of 1000"
    assert looked["samples"].found.startswith("0 of")
    assert {f"channel {number}" for number in range(1, FIBRES + 1)} < set(looked)
    assert "channel 0" not in looked
    assert arm.moves == []


@pytest.mark.parametrize(
    ("volts", "status", "word"), [(0.0, "fail", "dead"), (3.3, "fail", "saturated"), (1.5, "warn", "never changes")]
)
def test_a_channel_without_a_fibre(rig, volts, status, word):
    time, _, converter = rig
    model = converter.model

    class Broken:
        def volts(self, places, depths):
            read = model.volts(places, depths)
            read[:, 2] = volts
            return read

    converter.model = Broken()
    looked = found(examine_converter(converter, time, time.sleep))
    assert looked["channel 3"].status == status
    assert word in looked["channel 3"].found
    assert looked["channel 2"].status == "ok"


def test_a_noisy_channel_and_lost_samples(rig):
    time, arm, converter = rig
    arm.hook = lambda arm: None
    converter.lose = 7
    model = converter.model
    rng = np.random.default_rng(0)

    class Noisy:
        def volts(self, places, depths):
            read = model.volts(places, depths)
            read[:, 0] += 0.05 * rng.standard_normal(len(read))
            return read

    converter.model = Noisy()
    looked = found(examine_converter(converter, time, time.sleep))
    assert looked["channel 1"].status == "warn"
    assert (looked["samples"].status, looked["samples"].found.split()[0]) == ("fail", "7")


def test_devices_that_are_not_there(rig):
    time, arm, converter = rig
    converter.lost = True
    arm.lost = True
    assert [d.status for d in examine_converter(converter, time, time.sleep)] == ["fail"]
    assert [d.status for d in examine_arm(arm, RIG, time, time.sleep)] == ["fail"]


def test_an_arm_that_was_stopped(rig):
    time, arm, _ = rig
    arm.protective_stop = True
    looked = found(examine_arm(arm, RIG, time, time.sleep))
    assert (looked["safety"].status, looked["safety"].found) == ("fail", "protective stop")


@pytest.mark.parametrize(
    ("force_n", "max_force_n", "status", "words"),
    [
        (0.3, 60.0, "ok", "0.3 N, stopped beyond 60 N"),
        (None, 60.0, "fail", 'tells no force; [rig] max_force_n is 60, allowed is "unwatched"'),
        (None, None, "warn", "no force stops the arm"),
    ],
)
def test_a_force_that_nobody_watches(rig, force_n, max_force_n, status, words):
    time, arm, _ = rig
    arm.force_n = force_n
    looked = found(examine_arm(arm, RIG.model_copy(update={"max_force_n": max_force_n}), time, time.sleep))
    assert looked["force"].status == status
    assert words in looked["force"].found


@pytest.mark.parametrize(
    ("tcp_mm", "status", "words"),
    [
        ((0.0, 0.0, 150.05), "ok", "150.05"),
        (
            None,
            "fail",
            "tcp_mm is unknown; allowed x, y and z of the tip as measured; the controller says [0.0,",
        ),
        ((0.0, 0.0, 149.0), "fail", "tcp_mm is [0.0, 0.0, 149.0]; allowed what the controller says, [0.0, 0.0, 150.0]"),
    ],
)
def test_a_tip_that_is_not_where_the_controller_thinks(rig, tcp_mm, status, words):
    time, arm, _ = rig
    arm.connect = lambda: {"tcp": [0.0, 0.0, 150.0, 0.0, 0.0, 0.0]}
    looked = found(examine_arm(arm, RIG.model_copy(update={"tcp_mm": tcp_mm}), time, time.sleep))
    assert looked["tcp"].status == status
    assert words in looked["tcp"].found


def test_a_fault_is_told_with_its_advice():
    fault = RigFault("refused", "the port is in use", "close the other program")
    assert str(fault) == "the port is in use; close the other program"
    assert (fault.exit_code, RigFault("lost", "gone").exit_code) == (2, 1)
