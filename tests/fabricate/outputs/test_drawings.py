# pyright: reportPrivateImportUsage=false
# ezdxf does not mark what its own manual imports as exported.

import io
import re
from pathlib import Path
from xml.etree import ElementTree

import ezdxf
import numpy as np
import pytest
from scipy.interpolate import BPoly, PchipInterpolator

from padforge.design.morphology import Morphology
from padforge.fabricate.outputs.drawings import orientation_sentence, tracks_dxf, tracks_svg
from padforge.fabricate.plan import Plan, fibre_layers
from tests.fabricate.planted import with_settings

DOCS = Path(__file__).parents[3] / "docs"


def assert_on_curve(plan: Plan, fibre: int, positions_mm: np.ndarray) -> None:
    """Assert that positions (n, 2) lie within 0.1 µm of scipy's curve of a fibre, and cover it from end to end."""
    axis, knots = plan.family(fibre), plan.pad.to_mm(plan.pad.knots[fibre])
    curve = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])
    along = np.clip(positions_mm[:, axis], knots[0, axis], knots[-1, axis])
    error = np.abs(positions_mm[:, 1 - axis] - curve(along)) / np.hypot(1, curve(along, 1))
    assert error.max() < 1e-4
    assert np.ptp(along) == pytest.approx(plan.pad.layout.size_mm[0])


def assert_ends(plan: Plan, fibre: int, ends_mm: np.ndarray) -> None:
    """Assert that a fibre starts and ends at the edge of the silicone, level with its knots."""
    axis, mould = plan.family(fibre), plan.settings.mould
    edge = plan.pad.layout.size_mm[0] / 2 + mould.border_mm + mould.exit_mm
    assert ends_mm[:, axis] == pytest.approx([-edge, edge], abs=1e-4)
    level = plan.pad.to_mm(plan.pad.knots[fibre])[[0, -1], 1 - axis]
    assert ends_mm[:, 1 - axis] == pytest.approx(level, abs=1e-4)


@pytest.mark.parametrize("mould", [{"exit_mm": 0.0}, {"border_mm": 2.0}])
def test_tracks_are_exact_curves_in_svg_and_dxf(mould):
    plan = Plan(Morphology.random(3, 3, seed=7), with_settings(mould))
    drawing = ElementTree.fromstring(tracks_svg(plan))
    paths = {path.get("id"): path.get("d", "") for path in drawing.iter("{http://www.w3.org/2000/svg}path")}
    for fibre in range(6):
        path = paths[f"{('horizontal', 'vertical')[fibre // 3]}-{fibre % 3 + 1}"]
        assert re.sub(r"[^A-Z]", "", path) == "MLCCCCL"
        points = np.array(re.findall(r"-?\d+(?:\.\d+)?", path), dtype=float).reshape(-1, 2) * (1, -1)
        assert_ends(plan, fibre, points[[0, -1]])
        beziers = [BPoly(points[1 + 3 * i : 5 + 3 * i, None], [0, 1])(np.linspace(0, 1, 25)) for i in range(4)]
        assert_on_curve(plan, fibre, np.concatenate(beziers))

    document = ezdxf.read(io.StringIO(tracks_dxf(plan)))
    for layer in fibre_layers(plan):
        splines = document.modelspace().query(f'SPLINE[layer=="{layer.name}"]')
        for fibre, spline in zip(layer.fibres, splines, strict=True):
            curve = spline.construction_tool()
            assert curve.degree == 3
            knots, counts = np.unique(curve.knots(), return_counts=True)
            assert counts.tolist() == [4, *[3] * (len(knots) - 2), 4]
            points = np.array([tuple(p)[:2] for p in curve.points(np.linspace(knots[0], knots[-1], 400).tolist())])
            assert_ends(plan, fibre, points[[0, -1]])
            inside = np.abs(points[:, layer.family]) <= plan.pad.layout.size_mm[0] / 2
            control = np.array([tuple(p)[:2] for p in curve.control_points])
            first = 3 * bool(plan.settings.mould.border_mm + plan.settings.mould.exit_mm)
            ends = control[[first, len(control) - 1 - first]]
            assert_on_curve(plan, fibre, np.vstack([ends, points[inside]]))


def test_howto_pages_agree_with_orientation_sentence():
    pad, rig, printer = orientation_sentence((4, 4), "edges"), "the tracks are up", "with its tracks up"
    for page, sentence in {"pad": pad, "rig": rig, "printer": printer}.items():
        assert sentence in " ".join((DOCS / f"howto-{page}.md").read_text(encoding="utf-8").split())
