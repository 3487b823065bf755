from dataclasses import replace

from design.pad.morphology import Morphology
from fabricate.dispensing.files import dispensing
from fabricate.mould.plan import Plan
from fabricate.settings import DEFAULTS, DispenserSettings
from tests.fabricate.dispensing.machines import run_gcode


def test_places_speeds_and_height_are_those_of_the_settings():
    dispenser = DispenserSettings(origin_mm=(50.0, -20.0), travel_height_mm=7.5, travel_mm_s=40.0, feed_mm_s=6.0)
    plan = Plan(Morphology.straight(1), replace(DEFAULTS, dispenser=dispenser))
    text = dispensing(plan, ["gcode"]).texts["laying.gcode"]
    assert "; the pad's middle is at X50 Y-20;" in text
    run = run_gcode(text)
    (_, horizontal), (_, vertical) = run.laid()
    # turned over, a horizontal fibre starts on the right
    assert horizontal.corners.tolist() == [[50 + 43.25, -20.0, -0.9], [50 - 43.25, -20.0, -0.9]]
    assert vertical.corners.tolist() == [[50.0, -20 - 43.25, -0.1], [50.0, -20 + 43.25, -0.1]]
    assert horizontal.speeds.tolist() == vertical.speeds.tolist() == [6.0]
    heights = {z for way in run.ways for z in way.corners[:, 2].tolist()}
    assert heights == {7.5, -0.9, -0.1}


def test_it_begins_with_units_and_a_lift_before_anything_goes_sideways():
    lines = dispensing(Plan(Morphology.straight(1)), ["gcode"]).texts["laying.gcode"].splitlines()
    code = [line for line in lines if not line.startswith(";")]
    assert code[:2] == ["G21", "G90"]
    assert code[2].startswith("M0 ")
    assert code[3] == "G1 Z5 F1800"
    assert code[4].startswith("G1 X")
