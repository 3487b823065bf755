import math
import re
from dataclasses import dataclass

import numpy as np
import pytest
import shapely
from scipy.spatial import KDTree

from padforge.design.morphology import Array, Morphology
from padforge.fabricate.export import Fabrication
from padforge.fabricate.fibre_placement import gcode, plan_toolpath
from padforge.fabricate.outputs.laying_page import laying_document
from padforge.fabricate.plan import Plan
from tests.fabricate.planted import exact_fibre, level_pad, with_settings

G_CODE = re.compile(r"([A-Z])([-+]?\d+(?:\.\d+)?)")


@dataclass
class Way:
    """What a machine did between two pauses: corners (n, 3) mm, speeds (n - 1,) mm/s, and whether it was laying."""

    corners: Array
    speeds: Array
    lays: list[bool]


def run_gcode(text: str) -> list[tuple[str, Way]]:
    """What a machine asks for at every pause, and the way that it goes then.

    G1, G21, G90 and M0 are as the standard has them, modal; all else is refused, as G0, which heeds no speed.
    """
    run, asked = [], []
    corners, speeds, lays = [], [], []
    highest, speed = -math.inf, math.nan
    at: dict[str, float] = {}
    for line in [*text.splitlines(), "M0"]:
        code = re.sub(r"\([^()]*\)", "", line.partition(";")[0])
        words = G_CODE.findall(code)
        assert "".join(map("".join, words)) == "".join(code.split())
        target = dict(at)
        for letter, number in words:
            match letter + number:
                case "G1" | "G21" | "G90":
                    pass
                case "M0":
                    run += [(message, Way(np.array(corners), np.array(speeds), lays)) for message in asked]
                    asked = ["".join(re.findall(r"\(([^()]*)\)", line))]
                    corners, speeds, lays = corners[-1:], [], []
                case _ if letter == "F":
                    speed = float(number) / 60
                case _:
                    assert letter in "XYZ"
                    target[letter] = float(number)
        if target != at:
            level, at = at.get("Z") == target.get("Z"), target
            highest = max(highest, at["Z"])
            if {"X", "Y"} <= at.keys():
                speeds += [speed] if corners else []
                lays += [level and at["Z"] < highest] if corners else []
                corners.append([at["X"], at["Y"], at["Z"]])
    return run


def placed_fibres(run: list[tuple[str, Way]]) -> list[tuple[int, Way]]:
    """The fibres, 0.., that were placed, in that order."""
    for message, way in run:
        assert all(way.lays) if "fasten" in message else not any(way.lays)
    return [(int(message.split()[1].strip(",:")) - 1, way) for message, way in run if "fasten" in message]


def exact_path(plan: Plan, fibre: int) -> Array:
    """(n, 2) a fibre from lead to lead by scipy's PCHIP, on the pad turned over, from its middle."""
    mould, line = plan.settings.mould, exact_fibre(plan.pad, fibre)
    ends = line[[0, -1]]
    ends[:, plan.family(fibre)] += np.array([-1, 1]) * (mould.border_mm + mould.exit_mm + mould.lead_mm)
    return np.vstack([ends[:1], line, ends[1:]]) * (-1, 1)


def max_distance(one: Array, other: Array, points: int) -> float:
    """How far `points` places of either polyline (n, 2) lie at most from the other one, mm, to a micrometre."""
    dense = [shapely.get_coordinates(shapely.segmentize(shapely.LineString(line), 0.004)) for line in (one, other)]
    looked_at = [line[np.linspace(0, len(line) - 1, points).astype(int)] for line in dense]
    return max(float(KDTree(dense[1 - i]).query(looked_at[i])[0].max()) for i in (0, 1))


OTHER = with_settings(mould={"exit_mm": 0.0, "border_mm": 1.5, "lead_mm": 10.0}, pad={"deep_family": "vertical"})
PLANS = {
    "other settings": lambda: Plan(Morphology.random(2, 3, seed=5, pitch_mm=8.0), OTHER),
    "shrunk": lambda: Plan(Morphology.straight(1), with_settings(silicone={"shrinkage": 0.03})),
    "many levels": lambda: Plan(level_pad(1.8, 1.2)),
}


def program(plan: Plan) -> str:
    return gcode(plan, Fabrication(plan, [], []).toolpath)


@pytest.mark.parametrize("name", [*PLANS, pytest.param("5para_dis", marks=pytest.mark.slow)])
def test_gcode_places_every_fibre_along_its_path(request, name):
    """Once, in the order of the laying page, at its depth, from lead to lead; an empty needle travels above."""
    if name in PLANS:
        plan = PLANS[name]()
    else:
        plan = Plan(Morphology.load(request.getfixturevalue("published") / f"{name}.mat"))
    run, bench = run_gcode(program(plan)), laying_document(plan, 1.0)
    placed = placed_fibres(run)
    assert [fibre + 1 for fibre, _ in placed] == [number for step in bench["laying_order"] for number in step]
    for fibre, way in placed:
        z = plan.settings.fibre.material.diameter_mm - bench["fibres"][fibre]["depth_mm"]
        assert way.corners[:, 2] == pytest.approx(z, abs=1e-6)
        positions = way.corners[:, :2] - plan.settings.dispenser.origin_mm
        assert max_distance(positions, exact_path(plan, fibre), 10_000 // len(placed)) < 0.006
    for way in (way for message, way in run if "fasten" not in message):
        for start, end in zip(way.corners, way.corners[1:], strict=False):
            sideways = abs(start[:2] - end[:2]).max() > 1e-9
            assert not sideways or start[2] == end[2] == plan.settings.dispenser.travel_height_mm


def test_gcode_has_nothing_that_a_firmware_misreads():
    text = program(Plan(Morphology.straight(2)))
    lines = text.splitlines()
    assert text.isascii()
    waits = [line for line in lines if line.startswith("M0")]
    assert len(waits) == 1 + 2 * 4 + 2
    for line in waits:
        assert re.fullmatch(r"M0 \([^();]+\)", line)
        assert not re.search(r"[sSpP]\s*\d", line)
    assert max(len(line) for line in lines if line[0] in "GM") < 80


@pytest.mark.parametrize(
    ("fibres", "start"), [((2, 0), "on the right, nearest"), ((0, 2), "on the right, at the near side")]
)
def test_gcode_of_one_family_says_where_fibre_1_starts(fibres, start):
    text = program(Plan(Morphology.straight(fibres)))
    assert f"; fibre 1 starts {start}\n" in text
    ends = np.vstack([way.corners[[0, -1], :2] for _, way in placed_fibres(run_gcode(text))])
    assert ends[0] == pytest.approx((ends[:, 0].max(), ends[:, 1].min()))


@pytest.mark.parametrize(("acceleration", "max_strain", "feed"), [(9.5, 9e9, 6.0), (26.0, 0.07, 4.0), (9.5, 0.11, 6.0)])
def test_feed_in_a_bend_follows_from_its_radius(acceleration, max_strain, feed):
    """Leads to one side turn by quarters of a circle of 4 mm; all else here is straight. Feeds are tenths of 10 mm/s.

    The machine goes by sqrt(9.5 * 4) = 6.16 mm/s, the fibre by 1 - 0.3 / (2 * 4 * 0.07) = 0.464 of them, or by 0.659.
    """
    dispenser = {"acceleration_mm_s2": acceleration, "feed_mm_s": 10.0}
    rules: dict[str, object] = {"min_mean_bend_radius_mm": 4.0}
    settings = with_settings(pad={"leads": "one side"}, rules=rules, dispenser=dispenser)
    steps = plan_toolpath(Plan(Morphology.straight(2), settings), 0.3, max_strain)
    (horizontal,) = (stroke for step in steps for stroke in step.strokes if stroke.fibre == 0)
    assert (horizontal.feeds_mm_s.min(), horizontal.feeds_mm_s.max()) == (feed, 10.0)
    slow_mm = horizontal.steps_mm[horizontal.feeds_mm_s == feed].sum()
    # beside both quarters the needle has half a diameter to get slower in
    assert slow_mm == pytest.approx(math.pi * 4.0, abs=4 * 2 * 0.3)


def test_fibre_settings_set_depth_and_speed():
    pad = Morphology.random(1, 3, seed=2)

    def seconds(**fibre: object) -> float:
        ways = [way for _, way in placed_fibres(run_gcode(program(Plan(pad, with_settings(fibre=fibre)))))]
        assert ways[0].corners[:, 2] == pytest.approx(float(str(fibre.get("diameter_mm", 0.3))) - 1.2)
        return sum((np.linalg.norm(np.diff(way.corners, axis=0), axis=1) / way.speeds).sum() for way in ways)

    assert seconds(max_strain=0.05) > 1.2 * seconds(max_strain=2.0)
    assert seconds(diameter_mm=0.2) < seconds(diameter_mm=0.39)
