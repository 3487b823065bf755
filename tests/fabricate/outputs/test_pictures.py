import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from padforge.common.plotting import FAINT, HORIZONTAL, PAPER, VERTICAL
from padforge.design.morphology import Morphology
from padforge.fabricate.mesh import mesh_arrays, mould_mesh
from padforge.fabricate.outputs import pictures
from padforge.fabricate.outputs.laying_page import laying_document
from padforge.fabricate.plan import Plan, fibre_layers
from padforge.sense.rig.config import RobotFrame
from padforge.sense.settings import RigSettings
from tests.fabricate.planted import level_pad, with_settings


def faces_of(figure: Figure) -> tuple[np.ndarray, list[str]]:
    """Return the corners (m, 3, 2) of the triangles of a mesh, in drawing order, and their colours."""
    [faces] = figure.axes[0].collections
    corners = np.array([np.asarray(path.vertices)[:3] for path in faces.get_paths()])
    return corners, [to_hex(colour) for colour in np.asarray(faces.get_facecolor())]


def colour_at(faces: tuple[np.ndarray, list[str]], x: float, y: float) -> str:
    """Return the colour of the uppermost triangle at a position, mm."""
    corners, colours = faces
    sides, ways = np.roll(corners, -1, axis=1) - corners, np.array([x, y]) - corners
    cross = sides[..., 0] * ways[..., 1] - sides[..., 1] * ways[..., 0]
    return colours[np.flatnonzero((cross >= 0).all(axis=1) | (cross <= 0).all(axis=1))[-1]]


def test_mould_picture_has_colours_by_family_and_height(tmp_path, figures):
    mould: dict[str, object] = {"wall_draft_deg": 10.0, "ridge_draft_deg": 8.0, "pins": True}
    keep_outs = [[[8, 8], [9, 8], [9, 9], [8, 9]], [-9.0, -9.0, 2.0, 4.0]]
    plan = Plan(level_pad(1.8, 1.2), with_settings(mould, pad={"keep_out_mm": keep_outs}))
    pictures.draw_mould(plan, *mesh_arrays(mould_mesh(plan)), [], tmp_path / "mould.png")
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
    """A roof that rises by 10 along x, under a small plate at 7 in its upper left corner, all 20 above z = 0."""
    vertices = [[0, 0, 0], [10, 0, 10], [10, 10, 10], [0, 10, 0], [1, 7, 7], [3, 7, 7], [3, 9, 7], [1, 9, 7.0]]
    triangles = [[4, 5, 6], [4, 6, 7], [0, 1, 2], [0, 2, 3]]
    pictures.draw_findings(np.add(vertices, (0, 0, 20)), triangles, [], tmp_path / "mesh.png")
    plate, roof = (colour_at(faces_of(figures[0]), 2, y) for y in (8, 3))
    assert sum(bytes.fromhex(plate[1:])) < sum(bytes.fromhex(roof[1:]))  # the ramp darkens with height
    assert figures[0].axes[0].get_xlim() == (0, 10)
    assert [text.get_text() for text in figures[0].axes[1].texts] == ["0 mm", "10 mm above the lowest point"]


# Orientation

POSES = {0: (False, 0.0), 1: (True, 0.0), 2: (True, pictures.TURN_DEG)}
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
    pictures.draw_orientation(plan, tmp_path / "orientation.svg")
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
            assert np.hypot(*(number - expected)) < 5
            assert np.hypot(*number) > np.hypot(*expected)
        for axis, unit in zip("xy", np.eye(2), strict=True):
            if panel < 2:  # in the last one there are the axes of the arm as well
                direction = np.array(frame.pose(unit, 0.0)[:2])
                assert texts[axis] / np.hypot(*texts[axis]) == pytest.approx(direction, abs=0.01)


def test_section_is_of_the_narrowest_crossing(tmp_path, figures):
    """Of a pad of three depths whose first crossing is a wide one."""
    plan = Plan(Morphology.random((1, 2), 2, seed=1))
    crossings = laying_document(plan, 1.0)["crossings"]
    pictures.draw_crossing(plan, tmp_path / "crossing.svg")
    assert crossings["table"][0][-1] > crossings["gap_mm"]
    [*_, gap] = [text.get_text() for text in figures[0].axes[0].texts]
    assert gap == f"{crossings['gap_mm']:.2g} mm"


def test_fibres_are_drawn_as_wide_as_they_are(tmp_path, figures):
    pictures.draw_tracks(Plan(level_pad(1.0, 2.0), with_settings(fibre={"diameter_mm": 2.0})), tmp_path / "tracks.png")
    [axes] = figures[0].axes
    x_min, x_max = axes.get_xlim()
    points_per_mm = 72 * figures[0].get_figwidth() * axes.get_position().width / (x_max - x_min)
    widths = [line.get_linewidth() for line in axes.lines if line.get_color() in (HORIZONTAL, VERTICAL)]
    assert widths == pytest.approx([2.0 * points_per_mm] * 4, rel=1e-3)
