from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from padforge.design.common.plotting import ALARM, FAINT, HORIZONTAL, INK, PAPER, VERTICAL
from padforge.design.morphology import Morphology
from padforge.fabricate.checks import Finding
from padforge.fabricate.mesh import mould_mesh
from padforge.fabricate.outputs.drawings import orientation_sentence
from padforge.fabricate.outputs.pictures import (
    CARE,
    FLOOR,
    NUMBER,
    RIDGE,
    WALL,
    draw_findings,
    draw_mould,
    draw_tracks,
    mesh_relief,
    mould_relief,
)
from padforge.fabricate.plan import Plan, fibre_layers
from tests.fabricate.planted import level_pad, with_settings
from tests.helpers.less import small_pictures

PLAN = Plan(level_pad(1.8, 1.2))
PIXELS = 450
"""Longer side of the axes of pictures whose pixels are looked at, half of the usual one."""
SMALL = 150_000
"""Bytes that a picture may have: it goes into git."""


def finding(status, *positions: tuple[float, float], name: str = "wall") -> Finding:
    return Finding(name, status, 0.0, 1.0, "planted", positions)


POSITIONS = [(-6.0, 3.0), (0.0, 4.0), (7.0, 3.0)]
UNMARKED = finding("pass", *POSITIONS), finding("fail")
MARKED = finding("fail", (0, 0)), finding("warn", (6, -4), name="bend")
SWAPPED = finding("fail", (6, -4)), finding("warn", (0, 0), name="bend")


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        assert image.mode == "P"
        return np.asarray(image.convert("RGB"))


def has_colour(picture: np.ndarray, colour: str) -> np.ndarray:
    """Return which pixels have this colour, as nearly as a palette of 256 gives it."""
    return np.abs(picture - np.array([*bytes.fromhex(colour[1:])], np.int16)).max(axis=2) <= 10


@pytest.fixture(scope="module")
def mould_picture(tmp_path_factory) -> Callable[..., np.ndarray]:
    """Draw PLAN's mould with findings, each picture once."""
    path = tmp_path_factory.mktemp("pictures") / "mould.png"

    @cache
    def picture(*findings: Finding) -> np.ndarray:
        with pytest.MonkeyPatch.context() as patch:
            small_pictures(patch, PIXELS)
            draw_mould(PLAN, findings, path)
        return pixels(path)

    return picture


def mesh_of(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    mesh = mould_mesh(plan).to_mesh()
    return np.asarray(mesh.vert_properties, dtype=float), np.asarray(mesh.tri_verts, dtype=np.intp)


@pytest.mark.parametrize(
    "mould",
    [
        {},
        {"exit_mm": 0.0, "wall_draft_deg": 0.0, "number_mm": 0.0},
        {"border_mm": 2.0, "wall_draft_deg": 10.0, "ridge_draft_deg": 8.0, "pins": True},
    ],
)
def test_mould_relief_matches_mesh(mould):
    plan = Plan(level_pad(1.8, 1.2), with_settings(mould))
    drawn, classes = mould_relief(plan, 300, 300)
    meshed, _ = mesh_relief(*mesh_of(plan), 300)
    assert drawn.shape == meshed.shape
    error = np.abs(meshed - plan.settings.mould.floor_mm - drawn)
    assert (error > 0.01).mean() < 2e-4  # pixels whose middle lies on an edge fall on either side
    kinds = {FLOOR, WALL, *(RIDGE + layer for layer in range(3))}
    assert set(np.unique(classes)) == kinds | ({NUMBER} if plan.settings.mould.number_mm else set())
    for layer, height in enumerate(plan.heights_mm):
        assert drawn[classes == RIDGE + layer].max() == pytest.approx(height)


def test_mesh_relief_of_slope_and_plate_above():
    """A roof that rises along x, from 0 to 10, under a small plate at 7 in its upper left corner."""
    vertices = np.array(
        [[0, 0, 0], [10, 0, 10], [10, 10, 10], [0, 10, 0], [1, 7, 7], [3, 7, 7], [3, 9, 7], [1, 9, 7.0]]
    )
    triangles = np.array([[4, 5, 6], [4, 6, 7], [0, 1, 2], [0, 3, 2]])
    heights, bounds = mesh_relief(vertices, triangles, 100)
    assert bounds == pytest.approx((0, 0, 10, 10))
    x, y = np.meshgrid(np.arange(0.05, 10, 0.1), np.arange(9.95, 0, -0.1))
    plate = (x > 1) & (x < 3) & (y > 7) & (y < 9)
    assert heights == pytest.approx(np.where(plate, 7, x))


def test_mesh_relief_of_slivers_upright_faces_and_gaps():
    vertices = np.array([[0, 0, 1], [20, 0, 1], [20, 10, 3], [0, 0, 9], [20, 1e-9, 9.0]])
    triangles = np.array([[0, 1, 2], [0, 1, 3], [0, 3, 4], [0, 0, 0]])
    heights, bounds = mesh_relief(vertices, triangles, 40)
    assert heights.shape == (20, 40)
    assert bounds == pytest.approx((0, 0, 20, 10))
    assert heights[-1, -1] == pytest.approx(1.05)
    assert heights[0, 0] == -np.inf
    assert heights.max() <= 3


def test_layers_have_different_colours(mould_picture):
    picture = mould_picture(*UNMARKED)

    def share(colour: str) -> float:
        return has_colour(picture, colour).sum() / PIXELS**2

    for layer in fibre_layers(PLAN):
        assert share(layer.colour) > 1.3e-3
    assert {HORIZONTAL, VERTICAL} < {layer.colour for layer in fibre_layers(PLAN)}
    assert share(PAPER) > 0.39
    assert share(FAINT) > 0.04


def test_marks_are_at_positions_of_findings(mould_picture):
    scale = PIXELS / (2 * PLAN.tray.bounds[2])  # pixels a mm
    for colour, order in ((ALARM, 1), (CARE, -1)):  # the swapped picture warns where this one fails
        first, second = (has_colour(mould_picture(*marks), colour) for marks in (MARKED, SWAPPED)[::order])
        middles = [np.argwhere(one & ~other).mean(axis=0) for one, other in ((first, second), (second, first))]
        assert middles[1] - middles[0] == pytest.approx(np.array([4, 6]) * scale, abs=0.7)


def test_only_failures_and_warnings_are_marked(mould_picture):
    def marked(*findings: Finding) -> tuple[int, int]:
        picture = mould_picture(*findings)
        return int(has_colour(picture, ALARM).sum()), int(has_colour(picture, CARE).sum())

    assert marked(*UNMARKED) == (0, 0)
    one, cared = marked(*MARKED)
    three = marked(finding("fail", *POSITIONS))[0]
    assert three == pytest.approx(2 * one, rel=0.15)  # one more is in the legend
    assert cared > 0


def test_tracks_have_fibres_and_crossings_of_one_family(tmp_path, monkeypatch):
    small_pictures(monkeypatch, PIXELS)
    for name, plan in (("crossed", PLAN), ("level", Plan(level_pad(1.0, 2.0)))):
        draw_tracks(plan, tmp_path / name)
        picture = pixels(tmp_path / name)
        for layer in fibre_layers(plan):
            assert has_colour(picture, layer.colour).mean() > 1e-3
    drawn = slice(60, 470), slice(80, 500)  # without title, axes and legend, whose ink it is as well
    assert has_colour(pixels(tmp_path / "crossed")[drawn], INK).sum() > 8
    assert not has_colour(pixels(tmp_path / "level")[drawn], INK).any()


def test_draw_findings_marks_any_mesh(tmp_path, monkeypatch):
    small_pictures(monkeypatch, PIXELS)
    vertices = np.array([[100, 50, 3], [130, 50, 3], [130, 60, 3], [100, 60, 5.0]])
    path = tmp_path / "mesh.tmp"
    counts = []
    for place in ((110.0, 55.0), (120.0, 55.0)):
        draw_findings(vertices, [[0, 1, 2], [0, 2, 3]], [finding("fail", place)], path)
        counts.append(has_colour(pixels(path), ALARM))
    middles = [np.argwhere(counts[i] & ~counts[1 - i]).mean(axis=0) for i in (0, 1)]
    assert middles[1] - middles[0] == pytest.approx([0, PIXELS / 3], abs=0.7)
    draw_findings(vertices[:3] * (1, 0, 1), [[0, 1, 2]], [], path)  # invisible from above
    assert not has_colour(pixels(path), ALARM).any()


@pytest.mark.slow
def test_pictures_are_small(tmp_path, published):
    plan = Plan(Morphology.load(published / "20para.mat"))
    findings = [finding("fail", *map(tuple, plan.clash_positions_mm.tolist()))]
    draw_mould(plan, findings, tmp_path / "mould")
    draw_tracks(plan, tmp_path / "tracks")
    draw_findings(*mesh_of(plan), findings, tmp_path / "mesh")
    assert all(path.stat().st_size < SMALL for path in tmp_path.iterdir())


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """Figures that would have been written."""
    saved: list[Figure] = []
    monkeypatch.setattr("padforge.design.common.plotting.save_figure", lambda figure, *_: saved.append(figure))
    return saved


def test_mould_picture_has_the_size_of_the_mould_as_title(tmp_path, figures):
    draw_mould(Plan(Morphology.straight((1, 2), (12.0, 10.0))), [], tmp_path / "mould.png")
    walls = 2 * (2 + 2 + 6 * np.tan(np.radians(2)))
    size = f"{3 * 12 + walls:.4g} x {2 * 10 + walls:.4g} x 8 mm"  # with a floor of 2 mm below 6 mm of silicone
    assert figures[0].axes[0].get_title(loc="left") == f"Mould from above, {size}"


def test_fibres_are_drawn_as_wide_as_they_are(tmp_path, figures):
    draw_tracks(Plan(level_pad(1.0, 2.0), with_settings(fibre={"diameter_mm": 2.0})), tmp_path / "tracks.png")
    [axes] = figures[0].axes
    x_min, x_max = axes.get_xlim()
    points_per_mm = 72 * figures[0].get_figwidth() * axes.get_position().width / (x_max - x_min)
    widths = [line.get_linewidth() for line in axes.lines if line.get_color() in (HORIZONTAL, VERTICAL)]
    assert widths == pytest.approx([2.0 * points_per_mm] * 4, rel=1e-3)


def test_colours_of_a_mesh_are_named_by_height_above_its_lowest_point(tmp_path, figures):
    corners = [(x, y, z) for z, x0 in ((1, 0), (3, 0), (6, 10)) for x in (x0, x0 + 10) for y in (0, 10)]
    faces = [(k, k + 2, k + 1) for k in (0, 4, 8)] + [(k + 1, k + 2, k + 3) for k in (0, 4, 8)]
    draw_findings(np.array(corners, float), faces, [], tmp_path / "mesh.png")
    assert [text.get_text() for text in figures[0].axes[1].texts] == ["2 mm", "5 mm above the lowest point"]


def legend_of(figure: Figure) -> dict[str, Any]:
    """Return the entries of a legend with their handles."""
    [legend] = figure.legends
    return dict(zip([text.get_text() for text in legend.get_texts()], legend.legend_handles, strict=True))


def test_legend_of_the_mould_names_every_colour_with_its_height(tmp_path, figures):
    plan = Plan(level_pad(1.8, 1.2), with_settings({"silicone_mm": 5.5}))
    findings = [finding("warn", (1, 2), (3, 4), name="bend"), finding("fail", (5, 6)), finding("pass", (7, 8))]
    draw_mould(plan, findings, tmp_path / "mould.png")
    entries = legend_of(figures[0])
    colours = {layer.depth_mm: layer.colour for layer in fibre_layers(plan)}
    patches = {label: to_hex(entry.get_facecolor()) for label, entry in entries.items() if isinstance(entry, Patch)}
    assert patches == {
        "floor": PAPER,
        "wall, 5.5 mm": FAINT,
        "mirrored numbers, 0.4 mm": "#8a867d",
        "horizontal ridges, 2 mm": colours[2.0],
        "horizontal ridges, 1.2 mm": colours[1.2],
        "vertical ridges, 0.4 mm": colours[0.4],
    }
    assert list(entries)[len(patches) :] == ["fail: wall (1)", "warn: bend (2)"]
    [axes] = figures[0].axes
    marks = {line.get_label(): line for line in axes.lines if not str(line.get_label()).startswith("_")}
    assert {label: (line.get_marker(), line.get_markeredgecolor()) for label, line in marks.items()} == {
        "fail: wall (1)": ("o", ALARM),
        "warn: bend (2)": ("D", CARE),
    }
    assert np.array(marks["warn: bend (2)"].get_xydata()).tolist() == [[1, 2], [3, 4]]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (mm)", "y (mm)")
    x_min, y_min, x_max, y_max = plan.tray.bounds
    assert (*axes.get_xlim(), *axes.get_ylim()) == pytest.approx((x_min, x_max, y_min, y_max))
    draw_mould(Plan(plan.pad, with_settings({"number_mm": 0.0})), [], tmp_path / "mould.png")
    assert not any("numbers" in label for label in legend_of(figures[1]))


@pytest.mark.parametrize("leads", ["edges", "one side"])
def test_tracks_are_labelled_by_depth_with_a_number_at_every_start(tmp_path, figures, leads):
    plan = Plan(level_pad(1.8, 1.2), with_settings(pad={"leads": leads}))
    draw_tracks(plan, tmp_path / "tracks.png")
    [axes] = figures[0].axes
    crossings = len(plan.crossings)
    assert axes.get_title(loc="left") == f"Fibres as they lie in the tray, from above: 4 fibres, {crossings} crossings"
    entries = legend_of(figures[0])
    layers = fibre_layers(plan)
    labels = [f"{('horizontal', 'vertical')[layer.family]}, {layer.depth_mm:g} mm deep" for layer in layers]
    assert list(entries) == [*labels, "2 crossings of one family"]
    assert [entries[label].get_color() for label in labels] == [layer.colour for layer in layers]
    numbers = [text for text in axes.texts if text.get_text().isdigit()]
    ends = 1 + (leads == "one side")
    assert sorted(text.get_text() for text in numbers) == sorted(list("1234") * ends)
    for text in numbers:
        fibre = int(text.get_text()) - 1
        line = np.array(plan.lines[fibre].coords)
        assert np.hypot(*(line[[0, -1]][:ends] - text.xy).T).min() < 3.5  # within the wall
        assert text.get_color() == (HORIZONTAL, VERTICAL)[plan.family(fibre)]
        below = leads == "one side" or plan.family(fibre) == 1
        assert (text.get_ha(), text.get_va()) == (("center", "top") if below else ("right", "center"))
    bar = axes.lines[-1].get_xdata()
    assert bar[1] - bar[0] == pytest.approx(10)
    assert [text.get_text() for text in axes.texts if "mm" in text.get_text()] == ["10 mm"]
    note = " ".join(text.get_text() for text in figures[0].texts)
    assert note == orientation_sentence((2, 2), leads)


def test_title_of_a_mesh_has_its_sides(tmp_path, figures):
    draw_findings([[0, 0, 1], [30, 0, 1], [30, 10, 6.5]], [[0, 1, 2]], [finding("warn", (4, 5))], tmp_path / "a.png")
    assert figures[0].axes[0].get_title(loc="left") == "Mesh from above, 30 x 10 x 5.5 mm"
    assert list(legend_of(figures[0])) == ["warn: wall (1)"]


@pytest.mark.parametrize("count", [0, 4])
def test_legend_has_room_below_the_axes(tmp_path, figures, count):
    """In rows of three: neither it nor the note reaches the label of the axes or the edge of the picture."""
    names = [finding("warn", (1.0, 1.0), name=f"check_{number}") for number in range(count)]
    draw_findings([[0, 0, 1], [30, 0, 1], [30, 10, 6.5]], [[0, 1, 2]], names, tmp_path / "mesh.png")
    draw_tracks(PLAN, tmp_path / "tracks.png")
    for figure in figures:
        figure.draw_without_rendering()
        label = figure.axes[0].xaxis.label.get_window_extent()
        boxes = [each.get_window_extent() for each in (*figure.legends, *figure.texts)]
        assert len(figure.legends) == (count > 0 or figure is figures[1])
        for box in boxes:
            assert 0 <= box.y0 < box.y1 < label.y0
            assert all(box.y1 < bar.get_window_extent().y0 + 2 for bar in figure.axes[1:])  # of colours
        notes = [text.get_window_extent() for text in figure.texts]
        assert all(lower.y1 <= upper.y0 + 2 for upper, lower in pairwise(notes))
        assert all(note.y1 <= legend.get_window_extent().y0 + 2 for note in notes for legend in figure.legends)
