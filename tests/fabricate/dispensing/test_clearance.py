from dataclasses import replace

import numpy as np
import pytest

from design.pad.morphology import Morphology
from fabricate.checks.findings import Finding
from fabricate.dispensing.clearance import check_course
from fabricate.dispensing.course import laying_steps
from fabricate.mould.plan import Plan
from fabricate.settings import DEFAULTS, DispenserSettings, MouldSettings


def findings(pad: Morphology, mould: dict[str, object] | None = None, **dispenser: object) -> dict[str, Finding]:
    plan = Plan(
        pad,
        replace(
            DEFAULTS,
            mould=MouldSettings.model_validate(mould or {}),
            dispenser=DispenserSettings.model_validate(dispenser),
        ),
    )
    return {finding.name: finding for finding in check_course(plan, laying_steps(plan, 0.3))}


PAD = Morphology.straight(2)  # 33.75 mm, with leads 97.75 mm
EDGE = 33.75 / 2 + 2 + 30


def test_by_default_the_needle_can_go_its_way():
    found = findings(Morphology.random(3, 5, seed=4))
    assert {finding.status for finding in found.values()} == {"pass"}
    assert 0.38 < float(str(found["dispenser_tip"].limit)) <= 0.4


@pytest.mark.parametrize(
    ("keys", "room", "places"),
    [
        ({"origin_mm": [EDGE, EDGE]}, 0.0, None),
        ({"origin_mm": [EDGE - 0.5, 110.0]}, -0.5, [(EDGE, -5.625), (EDGE, 5.625)]),
        ({"box_mm": [0.0, 220.0, 0.0, 110 + EDGE - 2, -5.0, 9.0]}, -2.0, [(-5.625, EDGE), (5.625, EDGE)]),
        ({"box_mm": [0.0, 220.0, 0.0, 220.0, -0.5, 9.0]}, -0.4, [(-EDGE, -5.625), (-EDGE, 5.625)]),
        ({"travel_height_mm": 10.0, "box_mm": [0.0, 220.0, 0.0, 220.0, -5.0, 9.0]}, -1.0, None),
    ],
)
def test_the_box_holds_all_ways_or_it_is_told_where_not(keys, room, places):
    found = findings(PAD, **keys)["dispenser_box"]
    assert found.measured == pytest.approx(room, abs=1e-9)
    assert found.status == ("pass" if room == 0 else "fail")
    if places is not None:
        assert np.array(sorted(found.places_mm)) == pytest.approx(np.array(places))
    else:
        assert len(found.places_mm) == (4 if room else 0)


@pytest.mark.parametrize(
    ("tip", "mould", "status"),
    [
        (0.37, {}, "pass"),
        (0.41, {}, "fail"),
        (0.64, {"ridge_width_mm": 0.7}, "pass"),
        (0.71, {"ridge_width_mm": 0.7}, "fail"),
        (0.41, {"ridge_width_mm": 0.4, "exit_mm": 0.0}, "fail"),
    ],
)
def test_a_needle_wider_than_a_track_would_cut_the_silicone(tip, mould, status):
    found = findings(PAD, mould, tip_mm=tip)["dispenser_tip"]
    assert found.status == status
    assert found.measured == tip
    assert bool(found.places_mm) == (status == "fail")
    assert all(max(map(abs, place)) < EDGE - 29 for place in found.places_mm)
