import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from design import Morphology, Twin
from design.common.files import sha256
from design.pad.twin import TwinChannel
from sense import Recording
from sense.twin.benchmark import printed_pad


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
    code, out, err = padforge_sense("record", "--rig", "ur5", "--plan", plan, "--spec", "rig.toml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert not Path("out").exists()


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
