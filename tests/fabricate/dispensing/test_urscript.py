import re
from dataclasses import replace

import pytest

from design.pad.morphology import Morphology
from fabricate.dispensing.files import dispensing
from fabricate.mould.plan import Plan
from fabricate.settings import DEFAULTS, DispenserSettings


def script(**keys: object) -> list[str]:
    settings = replace(DEFAULTS, dispenser=DispenserSettings.model_validate(keys))
    return dispensing(Plan(Morphology.random(1, 2, seed=3), settings), ["urscript"]).texts["laying.script"].splitlines()


def test_an_arm_that_does_not_know_where_the_pad_lies_stands_still():
    lines = [line.strip() for line in script()]
    assert lines.index("halt") < min(i for i, line in enumerate(lines) if line.startswith("move"))
    assert "[dispenser] arm_pose" in lines[lines.index("halt") - 1]


def test_the_pose_of_the_pad_is_as_the_settings_say():
    lines = [line.strip() for line in script(arm_pose=[0.4, -0.25, 0.1, 0.0, 0.0, 1.5])]
    assert "pad = p[0.4, -0.25, 0.1, 0, 0, 1.5]" in lines
    assert "halt" not in lines


def test_it_is_one_program_whose_blocks_end():
    lines = script(arm_pose=[0.4, -0.25, 0.1, 0.0, 0.0, 0.0])
    code = [line.strip() for line in lines if not line.strip().startswith("#")]
    assert (code[0], code[-1]) == ("def padforge_laying():", "end")
    assert sum(line.startswith("def ") for line in code) == code.count("end") == 2
    assert all(line.count("(") == line.count(")") and line.count('"') % 2 == 0 for line in code)


def test_speeds_and_accelerations_are_those_of_the_settings_in_metres():
    lines = script(feed_mm_s=8.0, travel_mm_s=40.0, acceleration_mm_s2=250.0)
    moves = [re.search(r"(movel|movep)\(.*a=([\d.]+), v=([\d.]+)", line) for line in lines]
    found = [(move[1], float(move[2]), float(move[3])) for move in moves if move]
    assert {a for _, a, _ in found} == {0.25}
    assert {v for kind, _, v in found if kind == "movel"} == {0.04, 0.008}
    assert max(v for kind, _, v in found if kind == "movep") == pytest.approx(0.008)
