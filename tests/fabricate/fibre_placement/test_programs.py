"""Programs that lay fibres, run by machines that know their words only, and the drawing of their ways."""

import re
from collections.abc import Callable
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from padforge.design.morphology import Morphology
from padforge.fabricate.export import Fabrication
from padforge.fabricate.fibre_placement import gcode, plan_toolpath, summary_lines, urscript
from padforge.fabricate.outputs.drawings import toolpath_svg
from padforge.fabricate.outputs.laying_page import laying_document
from padforge.fabricate.plan import Plan
from tests.fabricate.fibre_placement.machines import Run, apart, exact_course, run_gcode, run_urscript
from tests.fabricate.planted import level_pad, with_settings

ARM = with_settings(mould={"exit_mm": 0.0, "border_mm": 1.5, "lead_mm": 10.0}, pad={"deep_family": "vertical"})


PLANS = {
    "straight": lambda: Plan(Morphology.straight(2)),
    "random": lambda: Plan(Morphology.random(3, 5, seed=2)),
    "other settings": lambda: Plan(Morphology.random(2, 3, seed=5, pitch_mm=8.0), ARM),
    "shrunk": lambda: Plan(Morphology.straight(1), with_settings(silicone={"shrinkage": 0.03})),
    "many levels": lambda: Plan(level_pad(1.8, 1.2)),
}


def program(plan: Plan, language: Callable[..., str]) -> str:
    return language(plan, Fabrication(plan, [], []).toolpath)


def require_laid(plan: Plan, run: Run, limit_mm: float, shift: tuple[float, float]) -> None:
    """Every fibre is laid once, in the order of the laying page, at its depth, along its course, lead to lead."""
    bench = laying_document(plan, 1.0)
    laid = run.laid()
    assert [fibre + 1 for fibre, _ in laid] == [number for step in bench["laying_order"] for number in step]
    for fibre, way in laid:
        page = bench["fibres"][fibre]
        z = plan.settings.fibre.material.diameter_mm - page["depth_mm"]
        assert way.corners[:, 2] == pytest.approx(z, abs=1e-6)
        assert apart(way.corners[:, :2] - shift, exact_course(plan, fibre), 10_000 // len(laid)) < limit_mm


def require_travels_above(plan: Plan, run: Run) -> None:
    """With an empty needle it goes sideways only at the height of travel."""
    fibres = {fibre for fibre, _ in run.laid()}
    assert len(fibres) == 2 * plan.pad.grid
    for message, way in zip(run.asked, run.ways, strict=True):
        if "fasten" not in message:
            for start, end in zip(way.corners, way.corners[1:], strict=False):
                sideways = abs(start[:2] - end[:2]).max() > 1e-9
                assert not sideways or start[2] == end[2] == plan.settings.dispenser.travel_height_mm


LANGUAGES = {"gcode": (gcode, run_gcode, 0.006), "urscript": (urscript, run_urscript, 0.011)}


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize(
    "name", [*PLANS, *(pytest.param(name, marks=pytest.mark.slow) for name in ("1para", "5para_dis", "20para"))]
)
def test_programs_place_every_fibre_along_its_path(request, language, name):
    if name in PLANS:
        plan = PLANS[name]()
    else:
        plan = Plan(Morphology.load(request.getfixturevalue("published") / f"{name}.mat"))
    write, machine, limit_mm = LANGUAGES[language]
    run = machine(program(plan, write))
    require_laid(plan, run, limit_mm, plan.settings.dispenser.origin_mm if language == "gcode" else (0, 0))
    require_travels_above(plan, run)


def test_pauses_are_in_the_order_of_the_work():
    plan = Plan(level_pad(1.8, 1.2))  # three layers
    asked = run_gcode(program(plan, gcode)).asked
    assert asked[1:] == run_urscript(program(plan, urscript)).asked[2:]  # one more: the pad's pose is unknown
    words = [re.sub(r".*?(fasten|cut|seal|zero).*", r"\1", message) for message in asked]
    fibre = ["fasten", "cut"]
    layers = [len(step) for step in laying_document(plan, 1.0)["laying_order"]]
    assert words == ["zero", *(word for count in layers for word in (*(fibre * count), "seal"))]
    assert asked[-1].startswith(f"layer {len(layers)} of {len(layers)}, 0.4 mm deep: seal")


def test_gcode_has_nothing_that_a_firmware_misreads():
    plan = Plan(Morphology.straight(4))
    lines = program(plan, gcode).splitlines()
    assert all(line.isascii() for line in (*lines, program(plan, urscript)))
    waits = [line for line in lines if line.startswith("M0")]
    assert len(waits) == 1 + 2 * 8 + 2
    for line in waits:
        assert re.fullmatch(r"M0 \([^();]+\)", line)
        assert not re.search(r"[sSpP]\s*\d", line)
    assert max(len(line) for line in lines if line[0] in "GM") < 80


def test_fibre_settings_set_depth_and_speed():
    pad = Morphology.random(1, 3, seed=2)

    def seconds(**fibre: object) -> float:
        run = run_gcode(program(Plan(pad, with_settings(fibre=fibre)), gcode))
        ways = [way for _, way in run.laid()]
        assert ways[0].corners[:, 2] == pytest.approx(float(str(fibre.get("diameter_mm", 0.3))) - 1.2)
        return sum((np.linalg.norm(np.diff(way.corners, axis=0), axis=1) / way.speeds).sum() for way in ways)

    assert seconds(max_strain=0.05) > 1.2 * seconds(max_strain=2.0)
    assert seconds(diameter_mm=0.2) < seconds(diameter_mm=0.39)


def test_gcode_has_positions_speeds_and_height_of_the_settings():
    dispenser = {"origin_mm": [50.0, -20.0], "travel_height_mm": 7.5, "feed_mm_s": 6.0}
    plan = Plan(Morphology.straight(1), with_settings(dispenser=dispenser))
    text = program(plan, gcode)
    code = [line for line in text.splitlines() if not line.startswith(";")]
    assert code[:2] == ["G21", "G90"]
    assert [line[:4] for line in code[2:5]] == ["M0 (", "G1 Z", "G1 X"]  # a lift before anything goes sideways
    assert code[3] == "G1 Z7.5 F1800"
    assert "; the pad's middle is at X50 Y-20;" in text
    run = run_gcode(text)
    (_, horizontal), (_, vertical) = run.laid()
    # turned over, a horizontal fibre starts on the right
    assert horizontal.corners.tolist() == [[50 + 43.25, -20.0, -0.9], [50 - 43.25, -20.0, -0.9]]
    assert vertical.corners.tolist() == [[50.0, -20 - 43.25, -0.1], [50.0, -20 + 43.25, -0.1]]
    assert horizontal.speeds.tolist() == vertical.speeds.tolist() == [6.0]
    assert {z for way in run.ways for z in way.corners[:, 2].tolist()} == {7.5, -0.9, -0.1}


def script(**keys: object) -> list[str]:
    plan = Plan(Morphology.random(1, 2, seed=3), with_settings(dispenser=keys))
    return [line.strip() for line in program(plan, urscript).splitlines()]


def test_urscript_halts_while_the_pose_is_unknown():
    lines = script()
    assert lines.index("halt") < min(i for i, line in enumerate(lines) if line.startswith("move"))
    assert "[dispenser] arm_pose" in lines[lines.index("halt") - 1]


def test_urscript_has_pose_speeds_and_accelerations_in_metres():
    pose = [0.4, -0.25, 0.1, 0.0, 0.0, 1.5]
    lines = script(arm_pose=pose, feed_mm_s=8.0, travel_mm_s=40.0, acceleration_mm_s2=250.0)
    assert "pad = p[0.4, -0.25, 0.1, 0, 0, 1.5]" in lines
    assert "halt" not in lines
    code = [line for line in lines if not line.startswith("#")]
    assert (code[0], code[-1]) == ("def padforge_laying():", "end")
    assert sum(line.startswith("def ") for line in code) == code.count("end") == 2
    assert all(line.count("(") == line.count(")") and line.count('"') % 2 == 0 for line in code)
    moves = [re.search(r"(movel|movep)\(.*a=([\d.]+), v=([\d.]+)", line) for line in lines]
    found = [(move[1], float(move[2]), float(move[3])) for move in moves if move]
    assert {a for _, a, _ in found} == {0.25}
    assert {v for kind, _, v in found if kind == "movel"} == {0.04, 0.008}
    assert max(v for kind, _, v in found if kind == "movep") == pytest.approx(0.008)


SVG = "{http://www.w3.org/2000/svg}"


def points(path: ElementTree.Element) -> np.ndarray:
    places = path.attrib["d"].removeprefix("M").split("L")
    return np.array([[float(part) for part in place.split(",")] for place in places]) * (1, -1)


@pytest.mark.parametrize("pad", [Morphology.random(2, 3, seed=2), level_pad(1.8, 1.2)], ids=["random", "levels"])
def test_toolpath_svg_shows_every_fibre_with_its_number_turn_and_depth(pad):
    plan = Plan(pad)
    steps = plan_toolpath(plan, 0.3)
    root = ElementTree.fromstring(toolpath_svg(plan, steps))
    left, top, width, height = map(float, root.attrib["viewBox"].split())
    assert (f"{width:g}mm", f"{height:g}mm") == (root.get("width"), root.get("height"))
    assert [group.attrib["id"] for group in root.findall(f"{SVG}g")] == [step.layer.name for step in steps]
    paths = {path.attrib["id"]: points(path) for path in root.findall(f"{SVG}g/{SVG}path")}
    assert set(paths) == {f"fibre-{number}" for number in range(1, 5)}
    for fibre in range(4):
        line = paths[f"fibre-{fibre + 1}"]
        assert apart(line, exact_course(plan, fibre), 500) < 0.006
        assert (line * (1, -1) > (left, top)).all()
        assert (line * (1, -1) < (left + width, top + height)).all()
    texts = [text.text or "" for text in root.iter(f"{SVG}text")]
    strokes = [stroke for step in steps for stroke in step.strokes]
    turns = [word for turn, each in enumerate(strokes, 1) for word in (f"{each.fibre + 1}", f"{turn}.")]
    assert texts[: len(turns)] == turns
    for number, step in enumerate(steps, 1):
        assert any(text.startswith(f"{number}. ") and f"{step.layer.depth_mm:.3g} mm deep" in text for text in texts)
    # Ways above the pad go from where one is cut to where the next is fastened.
    (travel,) = (path for path in root.findall(f"{SVG}path") if path.get("id") == "travel")
    ways = [part for part in travel.attrib["d"].split("M") if part]
    for way, before, after in zip(ways, strokes[:-1], strokes[1:], strict=True):
        ends = [[float(part) for part in place.split(",")] for place in way.split("L")]
        assert np.array(ends) * (1, -1) == pytest.approx(
            np.array([before.positions_mm[-1], after.positions_mm[0]]), abs=1e-3
        )
    (box,) = (path for path in root.findall(f"{SVG}path") if path.get("id") == "box")
    (clip,) = root.findall(f"{SVG}clipPath")
    assert box.get("clip-path") == f"url(#{clip.get('id')})"
    end = float(clip[0].attrib["y"]) + float(clip[0].attrib["height"])
    written = [text for text in root.iter(f"{SVG}text") if text.get("text-anchor") == "start"]
    assert min(float(text.get("y", "")) for text in written) - 1.25 > end  # the box does not run through it


def test_toolpath_svg_has_the_box_about_the_middle_of_the_pad():
    plan = Plan(Morphology.straight(1), with_settings(dispenser={"origin_mm": [60.0, 100.0]}))
    root = ElementTree.fromstring(toolpath_svg(plan, plan_toolpath(plan, 0.3)))
    (box,) = (path for path in root.findall(f"{SVG}path") if path.get("id") == "box")
    box.set("d", box.attrib["d"].removesuffix("Z"))
    assert points(box).tolist() == [[-60, -100], [160, -100], [160, 120], [-60, 120]]  # of 0 to 220 mm


def test_script_cuts_corners_by_no_more_and_no_less_than_the_tolerance():
    """An arc that begins b before a turn by t passes its corner at R (1 / cos(t / 2) - 1), R = b / tan(t / 2)."""
    plan = Plan(Morphology.straight(1))
    step = plan_toolpath(plan, 0.3)[0]
    turns = np.radians([90.0, 30.0, -5.0, 0.2])
    headings, lengths = np.append(0.0, np.cumsum(turns)), np.array([20.0, 10.0, 5.0, 8.0, 6.0])
    sides = lengths[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
    corners = np.vstack([np.zeros(2), np.cumsum(sides, axis=0)])
    stroke = replace(step.strokes[0], positions_mm=corners, feeds_mm_s=np.full(5, 6.0))
    script = urscript(plan, [replace(step, strokes=(stroke,))])
    blends = np.array(re.findall(r"movep\(.* r=([\d.e-]+)\)", script), float)
    radii = 1000 * blends[:-1] / np.tan(np.abs(turns) / 2)
    passes = radii * (1 / np.cos(turns / 2) - 1)
    assert passes[:3] == pytest.approx(0.005, rel=0.01)
    # no longer than the shorter side has room, and none at the end
    assert 1000 * blends[3:] == pytest.approx([0.4 * 6.0, 0.0])


@pytest.mark.parametrize(
    ("counts", "leads", "where"),
    [
        ((2, 3), "edges", "fibre 1 starts on the right, nearest"),
        ((0, 3), "edges", "fibre 1 starts on the right, at the near side"),
        ((2, 3), "one side", "fibre 1 starts at the near edge"),
    ],
)
def test_programs_say_where_the_first_fibre_starts(counts, leads, where):
    """In words; by its positions all other fibres of its family start farther left or farther away."""
    plan = Plan(Morphology.straight(counts), with_settings(pad={"leads": leads}))
    steps = plan_toolpath(plan, 0.3)
    assert any(line.endswith(where) for line in summary_lines(plan, steps))
    starts = {stroke.fibre: stroke.positions_mm[0] for step in steps for stroke in step.strokes}
    family = [starts[fibre] for fibre in range(counts[0] or counts[1])]
    near = min(y for _, y in family)
    if "right" in where:
        assert starts[0][0] == max(x for x, _ in family)
    assert starts[0][1] == pytest.approx(near)


def test_head_of_a_program_has_lengths_times_and_depths() -> None:
    """Of straight fibres 20 mm apart: sides of three and two pitches, borders, tongues and leads."""
    mould: dict[str, object] = {"border_mm": 2.0, "exit_mm": 3.0, "lead_mm": 40.0}
    settings = with_settings(mould, fibre={"diameter_mm": 0.3}, dispenser={"feed_mm_s": 5.0, "tip_mm": 0.35})
    plan = Plan(Morphology.straight((1, 2), 20.0), settings)
    steps = Fabrication(plan, [], []).toolpath
    lines = list(summary_lines(plan, steps))
    length_m = sum(float(stroke.steps_mm.sum()) for step in steps for stroke in step.strokes) / 1000
    assert length_m == pytest.approx((3 * 20 + 2 * 2 * 20 + 3 * (2 * 5 + 2 * 40)) / 1000)
    minutes = 1000 * length_m / 5 / 60
    assert lines[1] == f"3 fibres in 2 layers, {length_m:.2f} m; {minutes:.1f} minutes of laying"
    assert lines[3].endswith("y away from you; fibre 1 starts on the right, nearest")
    assert lines[4] == "z is 0 where the needle touches the upper face; it goes down to -0.900 mm"  # 0.3 - 1.2
    assert lines[5] == "needle of at most 0.35 mm, pad 6 mm thick"
