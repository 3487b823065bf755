import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from design import Contact, Morphology, Twin
from design.common.files import sha256
from design.common.settings import commented_toml
from design.pad.twin import TwinChannel
from design.settings import PadSettings
from sense import Recording
from sense.rig import operation
from sense.rig.emulators.finger import pressed_by_finger
from sense.rig.planning.setup import Setup
from sense.settings import RigSettings
from sense.twin.benchmark import printed_pad
from tests.sense.rig.devices.fakes import PAD, RIG, FakeArm, FakeConverter, Time

PAD_IT_IS = ("--morphology", "pad.json")


def test_a_recording_lies_in_the_folder_of_its_pad(padforge_sense) -> None:
    assert padforge_sense("record", "--presses", "4")[0] == 0
    assert Recording.open("out/pad/recording").source["rig"]["presses"] == 4
    Morphology.random(2, 3, 1).save(Path("mine/morphology.json"))
    code, out, _ = padforge_sense("record", "--presses", "4", "--seed", "7", "--morphology", "mine/morphology.json")
    assert code == 0
    assert out.endswith(" -> mine/recording\n")
    assert Recording.open("mine/recording").source["rig"]["seed"] == 7


def test_a_recording_in_the_way_is_left_alone(few) -> None:
    before = Path("rec/readings.bin").read_bytes()
    code, _, err = few("record", "--seed", "9", "--out", "rec")
    assert code == 2
    assert "never written over" in err
    assert Path("rec/readings.bin").read_bytes() == before


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        ("serpentine", "[rig] plan: got 'serpentine', expected uniform, grid, boustrophedon, adaptive or a .csv file"),
        ("absent.csv", "absent.csv: cannot be read"),
        ("adaptive", "[rig] plan is adaptive, which needs --model"),
    ],
)
def test_a_plan_that_cannot_be_is_one_line(padforge_sense, plan: str, said: str) -> None:
    Path("rig.toml").write_text('[rig]\nport = "none"\n')
    Morphology.straight(2).save(Path("morphology.json"))
    code, out, err = padforge_sense("record", "--rig", "ur5", "--plan", plan, "--spec", "rig.toml", "--out", "run")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert not Path("run").exists()


def test_a_real_rig_is_told_which_pad_lies_under_its_arm(padforge_sense) -> None:
    """By an option, or by the folder the recording goes to; then its fibres need as many inputs."""
    Path("rig.toml").write_text('[rig]\nport = "none"\nchannels = [4, 0, 7]\n')
    words = ("record", "--rig", "ur5", "--spec", "rig.toml")
    code, out, err = padforge_sense(*words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "--morphology is needed" in err
    assert "none at out/pad/morphology.json" in err
    Morphology.straight(2).save(Path("out/pad/morphology.json"))
    Morphology.straight(5).save(Path("other.json"))
    for more, fibres in (((), 4), (("--out", "out/pad/mine"), 4), (("--morphology", "other.json"), 10)):
        code, out, err = padforge_sense(*words, *more)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert f"[rig] channels: got 3 inputs, the pad has {fibres} fibres" in err
    code, _, err = padforge_sense("doctor", "--rig", "ur5", "--spec", "rig.toml", "--morphology", "other.json")
    assert code == 2
    assert "got 3 inputs, the pad has 10 fibres" in err


def test_more_fibres_than_the_board_has_inputs_are_refused(padforge_sense) -> None:
    Path("rig.toml").write_text('[rig]\nport = "none"\n')
    Morphology.straight(7).save(Path("morphology.json"))
    code, _, err = padforge_sense("record", "--rig", "ur5", "--spec", "rig.toml", "--out", "run")
    assert (code, err.count("\n")) == (2, 1)
    assert "fibre 13 is on input 12, an Arduino Due has 0 to 11" in err


PRINTER = """
[pad]
grid = 2
[rig]
rate_hz = 50.0
readings_per_press = 30
clearance_mm = 1.0
depth_mm = 1.0
travel_mm_s = 400.0
"""


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here")
def test_a_printer_is_practised_on_through_its_drivers(padforge_sense) -> None:
    pytest.importorskip("serial")
    Path("pad.toml").write_text(PRINTER)
    Morphology.straight(2).save("morphology.json")
    pad = ("--morphology", "morphology.json", "--spec", "pad.toml")
    code, out, _ = padforge_sense("record", "--rig", "printer", "--through-drivers", "--presses", "2", *pad)
    assert (code, out[:10]) == (0, "2 presses,")
    assert Recording.open("recording").source["rig"]["tcp_mm"] == [30.0, 0.0, -20.0]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--rig", "printer"), "[rig] tcp_mm is unknown, allowed are x, y and z of the probe's tip from the nozzle"),
        (
            ("--rig", "mine", "--through-drivers"),
            "--through-drivers: got --rig mine, allowed are simulated, ur5, printer",
        ),
    ],
)
def test_a_rig_that_cannot_be_is_one_line(padforge_sense, arguments: tuple[str, ...], said: str) -> None:
    Path("rig.toml").write_text('[rig]\nport = "none"\n')
    Morphology.straight(4).save("morphology.json")
    code, out, err = padforge_sense("record", "--morphology", "morphology.json", "--spec", "rig.toml", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert not Path("recording").exists()


@pytest.fixture
def twin(padforge_sense) -> Twin:
    """`twin.json`, of four fibres one of which no channel reads."""
    made = printed_pad(Morphology.random(2, 3, 5), np.random.default_rng(3))
    made.save("twin.json")
    return made


def test_a_twin_is_recorded_as_it_was_wired_and_another_pad_as_planned(padforge_sense, twin: Twin) -> None:
    assert padforge_sense("record", "--twin", "twin.json", "--presses", "4", "--out", "own")[0] == 0
    own = Recording.open("own")
    assert own.fibres == len(twin.channels)
    assert own.source["kind"] == "simulated"
    assert own.source["contact"] == twin.contact().model_dump(mode="json")
    made_by = json.loads(Path("own/start.json").read_text())["provenance"]
    assert made_by["inputs"]["twin.json"] == sha256(Path("twin.json"))
    Morphology.straight(3).save("other.json")
    assert padforge_sense("record", "--twin", "twin.json", "--morphology", "other.json", "--out", "other")[0] == 0
    assert Recording.open("other").fibres == 6


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ("--rig", "ur5"),
            "--twin is of the simulated pad, allowed with --rig simulated and without --through-drivers",
        ),
        (("--through-drivers",), "--twin is of the simulated pad"),
        (("--twin", "torn.json"), "torn.json: "),
        (("--twin", "pad.json"), "pad.json: "),
        (("--twin", "dead.json"), "twin: none of its channels reads a fibre"),
        (("--twin", "absent.json"), "absent.json: "),
        (("--morphology", "large.json"), "[pad] grid: got 270, input should be less"),
    ],
)
def test_a_twin_that_cannot_be_recorded_is_one_line(
    padforge_sense, twin: Twin, arguments: tuple[str, ...], said: str
) -> None:
    Path("torn.json").write_text(Path("twin.json").read_text()[:500])
    twin.morphology.save("pad.json")
    replace(twin, channels=(TwinChannel(0, None, 0.0, 0.0, 0.0),)).save("dead.json")
    Morphology.straight(270).save("large.json")
    code, out, err = padforge_sense("record", "--twin", "twin.json", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert not Path("recording").exists()


@pytest.fixture
def an_arm(monkeypatch: pytest.MonkeyPatch) -> FakeArm:
    """Any rig is this arm, whose controller has the tip 150 mm from the flange, and a board; neither acts."""
    arm = FakeArm(Time())

    @contextmanager
    def opened(kind: str, setup: Setup, *more: object) -> Iterator[tuple[FakeArm, FakeConverter, RigSettings]]:
        yield arm, FakeConverter(arm), setup.rig

    class Idle:
        def __init__(self, *devices: object, **more: object) -> None:
            pass

        def run(self, *plan: object) -> None:
            pass

    monkeypatch.setattr(arm, "connect", lambda: {"tcp": [0.0, 0.0, 150.0, 0.0, 0.0, 0.0]})
    monkeypatch.setattr(operation, "opened_rig", opened)
    monkeypatch.setattr(operation, "Session", Idle)
    return arm


def dry_run(padforge_sense, **settings: object) -> tuple[int, str]:
    """Exit code and stderr of a dry run with settings of `[rig]` beside those of the fakes."""
    tables = {"pad": PadSettings(grid=PAD.grid), "rig": RIG.model_copy(update=settings)}
    Path("rig.toml").write_text(commented_toml({"pad": PadSettings, "rig": RigSettings}, tables))
    PAD.save(PAD_IT_IS[1])
    code, _, err = padforge_sense("record", "--rig", "ur5", "--dry-run", "--spec", "rig.toml", *PAD_IT_IS)
    return code, err


@pytest.mark.usefixtures("an_arm")
@pytest.mark.parametrize(
    ("tcp_mm", "said"), [(None, "[rig] tcp_mm is unknown"), ((0.0, 0.0, 0.0), "[rig] tcp_mm is [0.0, 0.0, 0.0]")]
)
def test_nothing_moves_before_the_tool_is_known(padforge_sense, tcp_mm: object, said: str) -> None:
    code, err = dry_run(padforge_sense, tcp_mm=tcp_mm)
    assert (code, err.count("\n")) == (2, 1)
    assert said in err
    assert not Path("out").exists()


@pytest.mark.usefixtures("an_arm")
@pytest.mark.parametrize(("max_force_n", "said"), [(60.0, ""), (None, "no force stops the arm")])
def test_a_force_that_nobody_watches_is_told_at_the_start(padforge_sense, max_force_n: object, said: str) -> None:
    code, err = dry_run(padforge_sense, tcp_mm=(0.0, 0.05, 150.0), max_force_n=max_force_n)
    assert code == 0
    assert said in err
    assert ("force" in err) == bool(said)


HAND = "[pad]\ngrid = 2\n[rig]\npresses = 2\nreadings_per_press = 10\n"


def test_a_finger_records_through_the_drivers_and_goes_on(padforge_sense) -> None:
    """In real time, which the board needs."""
    Path("pad.toml").write_text(HAND)
    by_hand = ("record", "--rig", "hand", "--through-drivers", "--out", "rec")
    code, out, err = padforge_sense(*by_hand)
    assert code == 0
    assert "http://127.0.0.1:" in err
    recording = Recording.open("rec")
    assert recording.known.sum() == 2
    assert recording.source["kind"] == "hand"
    *told, last = out.splitlines()
    assert sum(line.startswith("counted: x ") for line in told) == 2
    assert last.startswith(f"{len(recording.presses_mm)} presses")
    code, out, err = padforge_sense(*by_hand)
    assert (code, out) == (2, "")
    assert "never written over" in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--dry-run",), "--dry-run and --model need an arm"),
        (("--model", "."), "--dry-run and --model need an arm"),
        (("--resume",), "no board is found"),
    ],
)
def test_what_a_hand_cannot_do_is_one_line(
    padforge_sense, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    monkeypatch.setattr("sense.rig.boards.due.serial_link.find_ports", list)
    Morphology.straight(2).save("pad.json")
    code, out, err = padforge_sense("record", "--rig", "hand", *PAD_IT_IS, *arguments)
    assert (code, out) == (2, "")
    assert said in err.splitlines()[-1]
    assert not Path("out/pad/recording").exists()


def test_each_device_is_looked_over_where_the_other_is_not_there(padforge_sense) -> None:
    Path("rig.toml").write_text(
        '[rig]\nport = "no-such-port"\nprinter_port = "neither"\npad_mm = [0, 0]\ncontact_mm = 9\n'
        "box_mm = [-9, 9, -9, 9, 0, 99]\n"
    )
    code, out, err = padforge_sense("doctor", "--rig", "printer", "--spec", "rig.toml")
    assert (code, err) == (1, "")
    assert "fail board: no-such-port: there is no such port" in out
    assert "fail arm: [rig] tcp_mm is unknown" in out
    code, _, err = padforge_sense("doctor", "--rig", "crane", "--spec", "rig.toml")
    assert (code, err.count("\n")) == (2, 1)
    assert "arms: got 'crane', allowed are" in err


def test_the_board_alone_is_looked_over_for_a_hand(padforge_sense, monkeypatch: pytest.MonkeyPatch) -> None:
    from sense.rig import operation

    pad, rig = Morphology.straight(2), RigSettings()
    with pressed_by_finger(pad, Contact(), rig) as (converter, _):
        monkeypatch.setattr(operation, "opened_board", lambda *setup: nullcontext(converter))
        code, out, _ = padforge_sense("doctor", "--rig", "hand")
    assert code == 0
    assert "arm" not in out


def test_the_emulated_board_of_a_finger_is_looked_over_as_well(padforge_sense) -> None:
    Path("pad.toml").write_text(HAND + 'port = "/dev/nosuch"\n')
    code, out, _ = padforge_sense("doctor", "--rig", "hand", "--through-drivers")
    assert code == 0
    assert "name padforge-due" in out
