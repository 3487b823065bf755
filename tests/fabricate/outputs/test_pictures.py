from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from padforge.common.plotting import ALARM, FAINT, HORIZONTAL, PAPER, VERTICAL
from padforge.design.morphology import Morphology
from padforge.fabricate.checks import Finding
from padforge.fabricate.mesh import mould_mesh
from padforge.fabricate.outputs.drawings import orientation_sentence
from padforge.fabricate.outputs.pictures import (
    CARE,
    TURN_DEG,
    draw_findings,
    draw_mould,
    draw_orientation,
    draw_tracks,
)
from padforge.fabricate.plan import Plan, fibre_layers
from padforge.sense.rig.config import RobotFrame
from padforge.sense.settings import RigSettings
from tests.fabricate.planted import level_pad, with_settings
from tests.helpers.less import small_pictures

PLAN = Plan(level_pad(1.8, 1.2))
SMALL = 200_000
"""Bytes that a picture may have: it goes into git."""


def make_finding(status, *positions: tuple[float, float], name: str = "wall") -> Finding:
    return Finding(name, status, 0.0, 1.0, "planted", positions)


def mesh_of(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    mesh = mould_mesh(plan).to_mesh()
    return np.asarray(mesh.vert_properties, dtype=float), np.asarray(mesh.tri_verts, dtype=np.intp)


def pixels_of(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), np.int16)


def count_colour(picture: np.ndarray, colour: str) -> int:
    """Return how many pixels have this colour, as nearly as a palette of 256 gives it."""
    return int((np.abs(picture - np.array([*bytes.fromhex(colour[1:])])).max(axis=2) <= 10).sum())


def faces_of(figure: Figure) -> tuple[np.ndarray, list[str]]:
    """Return the corners (m, 3, 2) of the triangles of a mesh, in drawing order, and their colours."""
    [faces] = figure.axes[0].collections
    corners = np.array([np.asarray(path.vertices)[:3] for path in faces.get_paths()])
    return corners, [to_hex(colour) for colour in np.asarray(faces.get_facecolor())]


def colour_at(faces: tuple[np.ndarray, list[str]], x: float, y: float) -> str:
    """Return the colour of the uppermost triangle at a position, mm."""
    corners, colours = faces
    (a, b, c), point = np.moveaxis(corners, 1, 0), np.array([x, y])
    cross = [
        u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] for u, v in ((b - a, point - a), (c - b, point - b), (a - c, point - c))
    ]
    signs = np.array(cross)
    return colours[np.flatnonzero((signs >= 0).all(axis=0) | (signs <= 0).all(axis=0))[-1]]


def test_mould_picture_has_colours_by_family_and_height(tmp_path, figures):
    mould: dict[str, object] = {"wall_draft_deg": 10.0, "ridge_draft_deg": 8.0, "pins": True}
    keep_outs = [[[8, 8], [9, 8], [9, 9], [8, 9]], [-9.0, -9.0, 2.0, 4.0]]
    plan = Plan(level_pad(1.8, 1.2), with_settings(mould, pad={"keep_out_mm": keep_outs}))
    draw_mould(plan, *mesh_of(plan), [], tmp_path / "mould.png")
    faces = faces_of(figures[0])
    for layer in fibre_layers(plan):
        for fibre in layer.fibres:
            ahead = plan.lines[fibre].interpolate(1.0)  # in the exit, where no ridge crosses
            assert colour_at(faces, ahead.x, ahead.y) == layer.colour
    digits = [number for number in plan.numbers if number is not None]
    assert colour_at(faces, *digits[0].representative_point().coords[0]) == "#8a867d"
    assert colour_at(faces, 0.0, -14.0) == PAPER
    edge = plan.tray.bounds[2] - 0.5
    for position in ((edge, 1.0), (8.5, 8.5), (-9.0, -9.0)):
        assert colour_at(faces, *position) == FAINT
    assert colour_at(faces, -9.0, -7.5) == "#b4b0a7"  # the head of a screw, around its hole


def test_mesh_picture_has_upper_faces_on_top(tmp_path, figures):
    """A roof that rises along x, from 0 to 10, under a small plate at 7 in its upper left corner."""
    vertices = [[0, 0, 0], [10, 0, 10], [10, 10, 10], [0, 10, 0], [1, 7, 7], [3, 7, 7], [3, 9, 7], [1, 9, 7.0]]
    draw_findings(vertices, [[4, 5, 6], [4, 6, 7], [0, 1, 2], [0, 2, 3]], [], tmp_path / "mesh.png")
    plate, roof = (colour_at(faces_of(figures[0]), 2, y) for y in (8, 3))
    assert sum(bytes.fromhex(plate[1:])) < sum(bytes.fromhex(roof[1:]))  # the ramp darkens with height
    assert figures[0].axes[0].get_xlim() == (0, 10)


def test_pictures_are_small_and_show_layers_and_marks(tmp_path, monkeypatch):
    """By pixels, of a mesh that is closed, and of one that is invisible from above."""
    small_pictures(monkeypatch, 300)
    draw_mould(PLAN, *mesh_of(PLAN), [make_finding("fail", (0, 0))], tmp_path / "mould.png")
    mould = pixels_of(tmp_path / "mould.png")
    for colour in (*(layer.colour for layer in fibre_layers(PLAN)), PAPER, FAINT, ALARM):
        assert count_colour(mould, colour) > 20
    draw_findings([[100, 0, 3], [130, 0, 3], [130, 0, 3.0]], [[0, 1, 2]], [], tmp_path / "mesh.png")
    assert not count_colour(pixels_of(tmp_path / "mesh.png"), ALARM)


def test_only_failures_and_warnings_are_marked(tmp_path, figures):
    findings = [make_finding("pass", (1, 2)), make_finding("fail"), make_finding("warn", (6, -4), name="bend")]
    draw_mould(PLAN, *mesh_of(PLAN), findings, tmp_path / "mould.png")
    marks = [line for line in figures[0].axes[0].lines if not str(line.get_label()).startswith("_")]
    assert [(line.get_label(), line.get_markeredgecolor()) for line in marks] == [("warn: bend (1)", CARE)]
    assert np.array(marks[0].get_xydata()).tolist() == [[6, -4]]


@pytest.mark.slow
def test_pictures_of_a_dense_pad_are_small(tmp_path, published):
    plan = Plan(Morphology.load(published / "20para.mat"))
    findings = [make_finding("fail", *map(tuple, plan.clash_positions_mm.tolist()))]
    draw_mould(plan, *mesh_of(plan), findings, tmp_path / "mould.png")
    draw_tracks(plan, tmp_path / "tracks.png")
    draw_findings(*mesh_of(plan), findings, tmp_path / "mesh.png")
    assert all(path.stat().st_size < SMALL for path in tmp_path.iterdir())


# Orientation

POSES = {0: (False, 0.0), 1: (True, 0.0), 2: (True, TURN_DEG)}
WIDTH_MM = 64.0


def texts_in(figure: Figure, panel: int, low: float, high: float) -> dict[str, np.ndarray]:
    """Return the positions of texts of a panel between two heights, from its middle."""
    middle = (panel + 0.5) * WIDTH_MM
    positions = {
        text.get_text(): np.array(text.get_position())
        for text in figure.axes[0].texts
        if text.get_horizontalalignment() == "center"
        and abs(text.get_position()[0] - middle) < WIDTH_MM / 2
        and low < text.get_position()[1] < high
    }
    return {text: position - (middle, 0) for text, position in positions.items()}


def test_panels_match_frame_of_rig(tmp_path, figures):
    """Fibres, axes and numbers are drawn where `RobotFrame`, which poses the rig's presses, has them."""
    plan = Plan(Morphology.random(3, 2, seed=4))
    draw_orientation(plan, tmp_path / "orientation.svg")
    scale = 21.0 / plan.tray.bounds[2]
    tracks = [np.array(line.get_xydata()) for line in figures[0].axes[0].lines if len(line.get_xydata()) > 1]
    order = [fibre for layer in fibre_layers(plan) for fibre in layer.fibres]
    for panel, (mirrored, turn_deg) in POSES.items():
        rig = RigSettings(pad_mm=(0.0, 0.0), contact_mm=0.0, pad_angle_deg=turn_deg, mirrored=mirrored)
        frame = RobotFrame.from_settings(rig)
        texts = texts_in(figures[0], panel, -28, 28)
        for fibre, track in zip(order, tracks[panel * len(order) :], strict=False):
            expected = scale * np.array(frame.pose(np.array(plan.lines[fibre].coords[0]), 0.0)[:2])
            assert track[0] - ((panel + 0.5) * WIDTH_MM, 0) == pytest.approx(expected, abs=1e-6)
            number = texts[str(fibre + 1)]
            assert np.hypot(*(number - expected)) < 4
            assert np.hypot(*number) > np.hypot(*expected)
        for axis, unit in zip("xy", np.eye(2), strict=True):
            if panel < 2:  # in the last one there are the axes of the arm as well
                assert texts[axis] / np.hypot(*texts[axis]) == pytest.approx(
                    np.array(frame.pose(unit, 0.0)[:2]), abs=0.01
                )


def test_side_views_number_fibres_as_panels(tmp_path, figures):
    draw_orientation(Plan(Morphology.straight(4)), tmp_path / "orientation.svg")
    views = [texts_in(figures[0], panel, -60, -36) for panel in POSES]
    assert ["".join(sorted(view, key=lambda text: view[text][0])) for view in views] == ["5678", "8765", "8765"]


def test_orientation_picture_has_sentence_titles_and_numbers(tmp_path, figures):
    for settings in (with_settings(), with_settings({"number_mm": 0.0})):
        draw_orientation(Plan(Morphology.straight(2), settings), tmp_path / "orientation.svg")
    note = " ".join(text.get_text() for text in figures[0].texts)
    assert note == orientation_sentence((2, 2), "edges")
    assert {text.get_text() for text in figures[0].axes[0].texts} >= {"1  In the mould", "pad_angle_deg", "arm"}
    cast = [sum(patch.get_gid() == "cast" for patch in figure.axes[0].patches) for figure in figures]
    assert cast == [3 * 4, 0]


def test_mould_picture_has_the_size_of_the_mould_as_title(tmp_path, figures):
    plan = Plan(Morphology.straight((1, 2), (12.0, 10.0)))
    draw_mould(plan, *mesh_of(plan), [], tmp_path / "mould.png")
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
    low, high = (trimesh.creation.box(bounds=[(x, 0, 1), (x + 10, 10, z)]) for x, z in ((0, 3), (10, 6)))
    vertices, faces = np.vstack([low.vertices, high.vertices]), np.vstack([low.faces, high.faces + len(low.vertices)])
    draw_findings(vertices, faces, [], tmp_path / "mesh.png")
    assert [text.get_text() for text in figures[0].axes[1].texts] == ["2 mm", "5 mm above the lowest point"]


def legend_of(figure: Figure) -> dict[str, Any]:
    """Return the entries of a legend with their handles."""
    [legend] = figure.legends
    return dict(zip([text.get_text() for text in legend.get_texts()], legend.legend_handles, strict=True))


def test_legend_of_the_mould_names_every_colour_with_its_height(tmp_path, figures):
    plan = Plan(level_pad(1.8, 1.2), with_settings({"silicone_mm": 5.5}))
    findings = [
        make_finding("warn", (1, 2), (3, 4), name="bend"),
        make_finding("fail", (5, 6)),
        make_finding("pass", (7, 8)),
    ]
    draw_mould(plan, *mesh_of(plan), findings, tmp_path / "mould.png")
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
    plain = Plan(plan.pad, with_settings({"number_mm": 0.0}))
    draw_mould(plain, *mesh_of(plain), [], tmp_path / "mould.png")
    assert not any("numbers" in label for label in legend_of(figures[1]))


def test_tracks_are_labelled_by_depth_with_a_number_at_every_end(tmp_path, figures):
    plan = Plan(level_pad(1.8, 1.2), with_settings(pad={"leads": "one side"}))
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
    assert sorted(text.get_text() for text in numbers) == sorted(list("1234") * 2)
    for text in numbers:
        fibre = int(text.get_text()) - 1
        line = np.array(plan.lines[fibre].coords)
        assert np.hypot(*(line[[0, -1]] - text.xy).T).min() < 3.5  # within the wall
        assert text.get_color() == (HORIZONTAL, VERTICAL)[plan.family(fibre)]
        assert (text.get_horizontalalignment(), text.get_verticalalignment()) == ("center", "top")
    bar = axes.lines[-1].get_xdata()
    assert bar[1] - bar[0] == pytest.approx(10)
    assert [text.get_text() for text in axes.texts if "mm" in text.get_text()] == ["10 mm"]
    note = " ".join(text.get_text() for text in figures[0].texts)
    assert note == orientation_sentence((2, 2), "one side")
