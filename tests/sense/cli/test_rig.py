from pathlib import Path

import pytest

from design import Morphology
from sense import Recording


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
