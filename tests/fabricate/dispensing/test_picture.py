from xml.etree import ElementTree

import numpy as np
import pytest

from design.pad.morphology import Morphology
from fabricate.dispensing.course import laying_steps
from fabricate.dispensing.picture import ways_svg
from fabricate.mould.plan import Plan
from tests.fabricate.dispensing.machines import apart, exact_course
from tests.fabricate.planted import level_pad

SVG = "{http://www.w3.org/2000/svg}"


def points(path: ElementTree.Element) -> np.ndarray:
    places = path.attrib["d"].removeprefix("M").split("L")
    return np.array([[float(part) for part in place.split(",")] for place in places]) * (1, -1)


@pytest.fixture(scope="module", params=[Morphology.random(2, 3, seed=2), level_pad(1.8, 1.2)], ids=["random", "levels"])
def drawn(request) -> tuple[Plan, ElementTree.Element]:
    plan = Plan(request.param)
    return plan, ElementTree.fromstring(ways_svg(plan, laying_steps(plan, 0.3)))


def test_it_shows_every_fibre_as_it_is_laid_in_true_size(drawn):
    plan, root = drawn
    assert [root.get(key, "")[-2:] for key in ("width", "height")] == ["mm", "mm"]
    left, top, width, height = map(float, root.attrib["viewBox"].split())
    assert (f"{width:g}mm", f"{height:g}mm") == (root.get("width"), root.get("height"))
    paths = {path.attrib["id"]: points(path) for path in root.findall(f"{SVG}g/{SVG}path")}
    assert set(paths) == {f"fibre-{number}" for number in range(1, 5)}
    for fibre in range(4):
        line = paths[f"fibre-{fibre + 1}"]
        assert apart(line, exact_course(plan, fibre), 500) < 0.006
        assert (line * (1, -1) > (left, top)).all()
        assert (line * (1, -1) < (left + width, top + height)).all()


def test_it_tells_numbers_order_and_depths(drawn):
    plan, root = drawn
    steps = laying_steps(plan, 0.3)
    texts = [text.text or "" for text in root.iter(f"{SVG}text")]
    order = [stroke.fibre + 1 for step in steps for stroke in step.strokes]
    assert texts[: 2 * len(order)] == [
        word for turn, number in enumerate(order, 1) for word in (f"{number}", f"{turn}.")
    ]
    layers = [group.attrib["id"] for group in root.findall(f"{SVG}g")]
    assert layers == [step.layer.name for step in steps]
    for number, step in enumerate(steps, 1):
        assert any(text.startswith(f"{number}. ") and f"{step.layer.depth_mm:.3g} mm deep" in text for text in texts)


def test_ways_above_the_pad_go_from_where_one_is_cut_to_where_the_next_is_fastened(drawn):
    plan, root = drawn
    strokes = [stroke for step in laying_steps(plan, 0.3) for stroke in step.strokes]
    (travel,) = (path for path in root.findall(f"{SVG}path") if path.get("id") == "travel")
    ways = [part for part in travel.attrib["d"].split("M") if part]
    assert len(ways) == len(strokes) - 1
    for way, before, after in zip(ways, strokes, strokes[1:], strict=False):
        ends = [[float(part) for part in place.split(",")] for place in way.split("L")]
        assert np.array(ends) * (1, -1) == pytest.approx(np.array([before.places_mm[-1], after.places_mm[0]]), abs=1e-3)


def test_the_box_does_not_run_through_what_is_written_below(drawn):
    _, root = drawn
    (box,) = (path for path in root.findall(f"{SVG}path") if path.get("id") == "box")
    (clip,) = root.findall(f"{SVG}clipPath")
    assert box.get("clip-path") == f"url(#{clip.get('id')})"
    (frame,) = clip
    end = float(frame.attrib["y"]) + float(frame.attrib["height"])
    written = [text for text in root.iter(f"{SVG}text") if text.get("text-anchor") == "start"]
    assert min(float(text.get("y", "")) for text in written) - 1.25 > end
