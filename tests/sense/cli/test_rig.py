"""`record` and `doctor`."""

import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from padforge.benchmarks.twin import printed_pad
from padforge.common.files import sha256
from padforge.design import Contact, Morphology
from padforge.fabricate import MouldSettings, build
from padforge.fabricate.settings import DEFAULTS
from padforge.sense import Recording
from padforge.sense.formats.ros_recording import import_bag
from padforge.sense.live import outputs
from padforge.sense.rig import operation
from padforge.sense.rig.doctor import Diagnosis
from padforge.sense.settings import RigSettings
from tests.emulators.boards import EmulatedLineBoard, emulated_header
from tests.emulators.finger import Finger
from tests.emulators.rigs import emulate_printer, printer_settings
from tests.helpers.rigs import rig_toml
from tests.sense.rig.fakes import PAD, RIG, FakeArm, FakeBoard, Time

EMULATED = pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here")


def test_record_writes_beside_its_pad(padforge_sense) -> None:
    assert padforge_sense("record", "--presses", "4")[0] == 0
    assert Recording.open("out/pad/recording").source["rig"]["presses"] == 4
    Morphology.random(2, 3, 1).save(Path("mine/morphology.json"))
    code, out, _ = padforge_sense("record", "--presses", "4", "--seed", "7", "--morphology", "mine/morphology.json")
    assert code == 0
    assert out.endswith(" -> mine/recording\n")
    assert Recording.open("mine/recording").source["rig"]["seed"] == 7


def test_record_follows_the_depth_of_the_contact_and_says_if_the_pad_is_designed_for_another(padforge_sense) -> None:
    Path("soft.toml").write_text("[contact]\ndepth_mm = 2\n[rig]\npresses = 4\n")
    assert padforge_sense("record", "--spec", "soft.toml", "--out", "soft")[::2] == (0, "")
    assert set(Recording.open("soft").depths_mm) == {2.0}
    origin = {"settings": {"contact": Contact(depth_mm=2.0).model_dump(mode="json")}}
    Morphology.from_layout(PAD.knots, PAD.layout, origin).save("pad/morphology.json")
    code, _, err = padforge_sense("record", "--presses", "4", "--morphology", "pad/morphology.json")
    assert (code, err) == (0, "[rig] presses 5 mm deep, the pad is designed for presses of 2 mm\n")


def test_record_refuses_a_depth_that_the_cast_pad_does_not_have(padforge_sense) -> None:
    thin = replace(DEFAULTS, mould=MouldSettings(silicone_mm=4.0))
    Path("thin").mkdir()
    PAD.save("thin/morphology.json")
    build(PAD, "thin", ["svg"], thin)
    line = "padforge: [rig] presses 5 mm deep, allowed is less than 4 mm, by thin/fabrication.json\n"
    for rig in ("simulated", "ur5", "hand"):
        code, _, err = padforge_sense("record", "--rig", rig, "--morphology", "thin/morphology.json")
        assert (code, err) == (2, line)
    assert not Path("thin/recording").exists()


def test_record_writes_an_mcap_file_as_export_does(padforge_sense, monkeypatch: pytest.MonkeyPatch) -> None:
    code, out, err = padforge_sense("record", "--presses", "4", "--mcap", "--out", "rec")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "rec -> rec.mcap"
    assert import_bag("rec.mcap") == Recording.open("rec")
    Path("same").mkdir()
    assert padforge_sense("export", "rec", "same/rec.mcap")[0] == 0
    assert Path("same/rec.mcap").read_bytes() == Path("rec.mcap").read_bytes()
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    code, _, err = padforge_sense("record", "--presses", "4", "--mcap", "--out", "other")
    assert (code, err) == (2, "padforge: other.mcap: MCAP needs rosbags: pip install 'padforge[formats]'\n")
    assert not Path("other").exists()


def test_record_simulates_a_twin(padforge_sense) -> None:
    twin = printed_pad(Morphology.random(2, 3, 5), np.random.default_rng(3))
    twin.save("twin.json")
    assert padforge_sense("record", "--twin", "twin.json", "--presses", "4", "--out", "measured")[0] == 0
    measured = Recording.open("measured")
    assert measured.fibres == len(twin.channels)
    assert measured.source["kind"] == "simulated"
    assert measured.source["contact"] == twin.contact().model_dump(mode="json")
    made_by = json.loads(Path("measured/start.json").read_text())["provenance"]
    assert made_by["inputs"]["twin.json"] == sha256(Path("twin.json"))
    for name, pad in (("planned", twin.morphology), ("other", Morphology.straight(3))):
        pad.save(f"{name}.json")
        words = ("record", "--twin", "twin.json", "--morphology", f"{name}.json", "--presses", "4", "--out", name)
        assert padforge_sense(*words)[0] == 0
    assert not np.array_equal(Recording.open("planned").readings, measured.readings)
    assert Recording.open("other").fibres == 6


@EMULATED
def test_record_with_a_printer(padforge_sense) -> None:
    fast = {"rate_hz": 50, "readings_per_press": 30, "clearance_mm": 1, "depth_mm": 1, "travel_mm_s": 400}
    pad = Morphology.straight(2)
    pad.save("morphology.json")
    rig = printer_settings(RigSettings.model_validate(fast), pad)
    with emulate_printer(pad, Contact(), rig) as (settings, _, _):
        Path("pad.toml").write_text(rig_toml(settings, pad.grid))
        words = ("record", "--rig", "printer", "--presses", "2", "--morphology", "morphology.json")
        code, out, err = padforge_sense(*words)
    assert (code, out[:14]) == (0, "2 presses over"), err
    assert Recording.open("recording").source["rig"]["tcp_mm"] == [30.0, 0.0, -20.0]


@pytest.mark.parametrize(
    ("tcp_mm", "max_force_n", "code", "said"),
    [
        (None, 60.0, 2, "[rig] tcp_mm is unknown"),
        ((0.0, 0.0, 0.0), 60.0, 2, "[rig] tcp_mm is [0.0, 0.0, 0.0]"),
        ((0.0, 0.05, 150.0), 60.0, 0, ""),
        ((0.0, 0.05, 150.0), None, 0, "no force stops the arm"),
    ],
)
def test_record_checks_the_tcp_before_anything_moves(
    padforge_sense, monkeypatch: pytest.MonkeyPatch, tcp_mm: object, max_force_n: object, code: int, said: str
) -> None:
    """The controller has the tip 150 mm from the flange; an unwatched force is announced."""
    arm, session = FakeArm(Time()), Mock()
    monkeypatch.setattr(arm, "connect", lambda: {"tcp": [0.0, 0.0, 150.0, 0.0, 0.0, 0.0]})
    monkeypatch.setattr(operation, "opened_rig", lambda _, setup, *more: nullcontext((arm, FakeBoard(arm), setup.rig)))
    monkeypatch.setattr(operation, "PressLoop", session)
    rig = RIG.model_copy(update={"tcp_mm": tcp_mm, "max_force_n": max_force_n})
    Path("rig.toml").write_text(rig_toml(rig, PAD.grid))
    PAD.save("pad.json")
    words = ("record", "--rig", "ur5", "--dry-run", "--spec", "rig.toml", "--morphology", "pad.json")
    ended, _, err = padforge_sense(*words)
    assert (ended, err.count("\n"), session.called) == (code, bool(said), code == 0)
    assert said in err
    assert not Path("out").exists()


@pytest.fixture
def finger(padforge_sense) -> Iterator[Finger]:
    """One that presses a pad, whose board pad.toml names, in the folder of the command."""
    pad, rig = Morphology.straight(2), RigSettings(presses=2, readings_per_press=10)
    pad.save("morphology.json")
    finger = Finger(pad, Contact(), rig, rig.board_rate_hz)
    with EmulatedLineBoard(finger.volts, emulated_header(rig.board_rate_hz, len(pad.knots))) as board:
        Path("pad.toml").write_text(rig_toml(rig.model_copy(update={"port": board.port}), pad.grid))
        yield finger


@EMULATED
@pytest.mark.slow
def test_record_by_hand(padforge_sense, finger: Finger, monkeypatch: pytest.MonkeyPatch) -> None:
    """In real time, which the board needs."""

    class WatchedPage(outputs.LivePage):
        def show(self, view: Mapping[str, Any]) -> None:
            super().show(view)
            finger.look(view)

        def read_commands(self) -> list[str]:
            return [*super().read_commands(), *finger.commands()]

    monkeypatch.setattr(outputs, "LivePage", WatchedPage)
    by_hand = ("record", "--rig", "hand", "--out", "rec")
    code, out, err = padforge_sense(*by_hand)
    assert code == 0, err
    assert "http://127.0.0.1:" in err
    recording = Recording.open("rec")
    assert recording.has_position.sum() == 2
    assert recording.source["kind"] == "hand"
    *messages, last = out.splitlines()
    assert sum(line.startswith("counted: x ") for line in messages) == 2
    assert last.startswith(f"{len(recording.presses_mm)} presses")
    code, out, err = padforge_sense(*by_hand)
    assert (code, out) == (2, "")
    assert "never written over" in err


def test_doctor_examines_each_device_without_the_other(padforge_sense) -> None:
    Path("rig.toml").write_text(
        '[rig]\nport = "no-such-port"\nprinter_port = "neither"\npad_mm = [0, 0]\ncontact_mm = 9\n'
        "box_mm = [-9, 9, -9, 9, 0, 99]\n"
    )
    code, out, err = padforge_sense("doctor", "--rig", "printer", "--spec", "rig.toml")
    assert (code, err) == (1, "")
    assert "fail board: no-such-port: there is no such port" in out
    assert "fail arm: neither: there is no such port" in out
    assert "fail place: [rig] tcp_mm is unknown" in out
    Path("rig.toml").write_text('[rig]\nport = "it"\nprinter_port = "it"\n')
    assert (
        "fail arm: [rig] port and printer_port are the same, it"
        in padforge_sense("doctor", "--rig", "printer", "--spec", "rig.toml")[1]
    )


@EMULATED
@pytest.mark.slow
@pytest.mark.usefixtures("finger")
def test_doctor_examines_the_board_alone(padforge_sense) -> None:
    code, out, _ = padforge_sense("doctor")
    assert code == 0
    assert "name emulated" in out
    assert "arm" not in out


def test_doctor_prints_a_line_a_finding_and_ends_as_they_are(padforge_sense, monkeypatch: pytest.MonkeyPatch) -> None:
    said = [Diagnosis("board", "ok", "name it"), Diagnosis("rate", "warn", "slow")]
    examined = Mock(return_value=said)
    monkeypatch.setattr(operation, "diagnose", examined)
    Path("rig.toml").write_text("[pad]\ngrid = 2\n[rig]\nchannels = [3, 1, 4, 0]\n")
    assert padforge_sense("doctor", "--rig", "ur5", "--spec", "rig.toml") == (
        0,
        "ok   board: name it\nwarn rate: slow\n",
        "",
    )
    kind, _, inputs = examined.call_args.args
    assert (kind, list(inputs)) == ("ur5", [3, 1, 4, 0])
    said.append(Diagnosis("arm", "fail", "gone"))
    code, out, _ = padforge_sense("doctor", "--rig", "hand", "--spec", "rig.toml", "--json")
    assert (code, json.loads(out)["passed"]) == (1, False)
    assert json.loads(out)["diagnoses"][2] == {"name": "arm", "status": "fail", "message": "gone"}
    assert examined.call_args.args[0] == "hand"


def test_record_by_hand_takes_no_arm(padforge_sense) -> None:
    PAD.save("pad.json")
    Path("model").mkdir()
    for words in (("--dry-run",), ("--model", "model")):
        code, out, err = padforge_sense("record", "--rig", "hand", "--morphology", "pad.json", *words)
        assert (code, out) == (2, "")
        assert err == "padforge: --dry-run and --model need an arm, allowed with --rig hand are --plan and --resume\n"
