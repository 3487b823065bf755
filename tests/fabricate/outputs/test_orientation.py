"""Orientation: the drawing against the frame of the rig's presses, and the sentence on every page."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from padforge.design.morphology import Morphology
from padforge.fabricate.outputs.drawings import TURN_DEG, orientation_sentence, orientation_svg
from padforge.fabricate.plan import Plan
from padforge.sense.rig.config import RobotFrame
from padforge.sense.settings import RigSettings
from tests.fabricate.planted import with_settings

SVG = "{http://www.w3.org/2000/svg}"
DOCS = Path(__file__).parents[3] / "docs"
POSES = {"mould": (False, 0.0), "turned": (True, 0.0), "used": (True, TURN_DEG)}
PADS = [Morphology.straight(1), Morphology.random(3, 2, seed=4), Morphology.straight(12, pitch_mm=6.0)]


def draw(pad: Morphology) -> ElementTree.Element:
    return ElementTree.fromstring(orientation_svg(Plan(pad)))


def panel(root: ElementTree.Element, name: str) -> ElementTree.Element:
    (group,) = (group for group in root.findall(f"{SVG}g") if group.get("id") == name)
    return group


def matrix(transform: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the linear part and the shift of an SVG transform: points (n, 2) -> points @ linear + shift."""
    x, y, turn, across, down = map(float, re.findall(r"-?[\d.]+", transform))
    assert re.sub(r"[-\d. ]", "", transform) == "translate()rotate()scale()"
    cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    return np.diag([across, down]) @ np.array([[cos, sin], [-sin, cos]]), np.array([x, y])


@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("pad", PADS)
def test_panels_match_frame_of_rig(pad, name):
    """Fibres, axes and numbers are drawn where `RobotFrame`, which poses the rig's presses, has them."""
    plan, (mirrored, turn_deg) = Plan(pad), POSES[name]
    group = panel(draw(pad), name)
    (use,) = group.findall(f"{SVG}use")
    linear, shift = matrix(use.get("transform", ""))
    rig = RigSettings(pad_mm=(0.0, 0.0), contact_mm=0.0, pad_angle_deg=turn_deg, mirrored=mirrored)
    frame, scale = RobotFrame.from_settings(rig), np.sqrt(abs(np.linalg.det(linear)))
    starts = np.array([line.coords[0] for line in plan.lines])
    expected = np.array([frame.pose(start, 0.0)[:2] for start in starts])
    drawn = starts * (1, -1) @ linear + shift
    np.testing.assert_allclose((drawn - shift) * (1, -1) / scale, expected, atol=0.02)
    texts = [
        (text.text, np.array([float(text.get("x", "")), float(text.get("y", ""))])) for text in group.iter(f"{SVG}text")
    ]
    numbers = [position for text, position in texts if text and text.isdigit()]
    assert [text for text, _ in texts if text and text.isdigit()] == [str(n + 1) for n in range(len(starts))]
    for fibre, position in enumerate(numbers):
        assert int(np.argmin(np.hypot(*(drawn - position).T))) == fibre
        assert np.hypot(*(position - shift)) > np.hypot(*(drawn[fibre] - shift))
    for axis, unit in zip("xy", np.eye(2), strict=True):
        (label,) = (position for text, position in texts if text == axis)
        to = np.array(frame.pose(unit, 0.0)[:2]) * (1, -1)
        np.testing.assert_allclose((label - shift) / np.hypot(*(label - shift)), to, atol=0.01)


def test_side_views_number_fibres_as_panels():
    root = draw(Morphology.straight(4))
    by_panel: dict[int, list[tuple[float, str]]] = {0: [], 1: [], 2: []}
    for text in panel(root, "sides").iter(f"{SVG}text"):
        x = float(text.get("x", ""))
        by_panel[int(x // 64)].append((x, text.text or ""))
    rows = ["".join(name for _, name in sorted(numbers)) for numbers in by_panel.values()]
    assert rows == ["5678", "8765", "8765"]


@pytest.mark.parametrize("pad", PADS)
def test_orientation_svg_is_small_and_has_the_sentence(pad):
    text = orientation_svg(Plan(pad))
    assert len(text) < 40_000
    root = ElementTree.fromstring(text)
    assert root.findtext(f"{SVG}desc") == orientation_sentence((4, 4), "edges")
    assert " ".join(line.text or "" for line in root.findall(f"{SVG}text")[-3:]) == orientation_sentence(
        (4, 4), "edges"
    )
    width, height = map(float, root.get("viewBox", "").split()[2:])
    for label in root.iter(f"{SVG}text"):
        assert 0 < float(label.get("x", "")) < width
        assert 0 < float(label.get("y", "")) < height


def test_orientation_svg_omits_absent_numbers():
    plan = Plan(Morphology.straight(2), with_settings({"number_mm": 0.0}))
    assert 'class="cast"' not in orientation_svg(plan)
    assert orientation_svg(Plan(Morphology.straight(2))).count('class="cast"') == 4


def test_bench_page_has_orientation_sentence():
    page = " ".join((DOCS / "howto-pad.md").read_text(encoding="utf-8").split())
    assert page.count(orientation_sentence((4, 4), "edges")) == 1
    assert page.count("with its tracks up") >= 2  # under an arm, in the holder
    assert "with its tracks down" not in page
