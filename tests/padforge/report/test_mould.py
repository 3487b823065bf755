import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from matplotlib.colors import to_rgb

from padforge.common.files import sha256
from padforge.common.page import PageSection
from padforge.common.plotting import HORIZONTAL, VERTICAL
from padforge.common.settings import Spec
from padforge.design import Morphology
from padforge.fabricate import FabricationSettings, build
from padforge.fabricate.outputs import report
from padforge.fabricate.outputs.report import PackedMesh, fabrication_sections, pack_mesh
from padforge.report import write_report
from tests.helpers.chromium import SOFTWARE_GL, Chromium
from tests.helpers.golden import Golden
from tests.helpers.page_script import shown


def unpacked(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) mm and triangles (m, 3) of the mesh in a page."""
    found = re.search(r'<script type="application/json" id="mould-mesh">(.*?)</script>', text)
    assert found
    data = json.loads(found[1])
    steps = np.frombuffer(base64.b64decode(data["vertices"]), "<u2").reshape(-1, 3)
    kind = "<u4" if data["wide"] else "<u2"
    triangles = np.frombuffer(base64.b64decode(data["triangles"]), kind).reshape(-1, 3)
    return np.array(data["low"]) + steps / 65535 * np.array(data["size"]), triangles


def test_mesh_in_report_is_the_mould(made: Path, page: Path) -> None:
    vertices, triangles = unpacked(page.read_text())
    mould = trimesh.load_mesh(made / "mould.stl", process=False)
    half_step = np.ptp(mould.vertices, axis=0) / 65535 / 2
    assert (np.abs(vertices[triangles] - mould.triangles).max(axis=(0, 1)) <= 1.001 * half_step).all()
    assert len(vertices) < len(mould.vertices) / 4


@pytest.mark.slow
def test_large_mesh_uses_wide_indices(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(report, "MAX_BYTES", 10**8)
    sphere = trimesh.creation.uv_sphere(radius=30, count=[257, 257])
    sphere.export(tmp_path / "mould.stl")
    mesh = pack_mesh(tmp_path / "mould.stl")
    assert mesh
    assert mesh.triangles.max() + 1 == len(mesh.vertices) > 65536
    assert volume(mesh) == pytest.approx(sphere.volume, rel=1e-4)


def test_section_names_sizes_and_colours_heights_from_the_lowest_point_of_the_mesh(made: Path, tmp_path: Path) -> None:
    """Tops of ridges are where the family has its height above the floor, wherever the mesh begins."""
    document = json.loads((made / "fabrication.json").read_text())
    mould = trimesh.load_mesh(made / "mould.stl", process=False)
    mould.apply_translation((3.0, 4.0, 100.0))
    document["settings"]["mould"]["floor_mm"] = 1.5
    document["sizes"]["pad_mm"] = [120.0, 30.25]
    document["fibres"] = [fibre | {"depth_mm": 0.9} for fibre in document["fibres"]]  # of a pad that has shrunk
    section = section_of(mould, document, tmp_path)
    data = json.loads("".join(section.body).partition('id="mould-mesh">')[2].partition("</script>")[0])
    colours = {"horizontal": HORIZONTAL, "vertical": VERTICAL}
    tops = {fibre["ridge_mm"]: colours[fibre["fibre"].split()[0]] for fibre in document["fibres"]}
    expected = [[101.5 + height, *to_rgb(colour)] for height, colour in sorted(tops.items())]
    assert np.array(data["tops"]) == pytest.approx(np.array(expected))
    assert data["low"] == pytest.approx(mould.bounds[0], abs=1e-4)
    size = " x ".join(f"{side:.4g}" for side in np.ptp(mould.vertices, axis=0))
    assert f"The mould, {size} mm. Tops of" in "".join(section.body)
    assert section.figures[0] == ("120 x 30.25 mm", "pad, as it is cast")


def section_of(mould: Any, document: dict[str, Any], folder: Path) -> PageSection:
    mould.export(folder / "mould.stl")
    document["sha256"] = {"mould.stl": sha256(folder / "mould.stl")}
    return fabrication_sections(folder, document)[0]


def finger(x: float, y: float, number: int = 1, **held: bool) -> dict[str, Any]:
    return {"pointerId": number, "clientX": x, "clientY": y} | held


KEYS = ("ArrowLeft", "ArrowRight ArrowRight ArrowUp", "Shift+ArrowRight Shift+ArrowUp Shift+ArrowUp", "Ctrl++ x")
BUTTONS = (("out", 2), ("in", 20), ("out", 20), ("reset", 1), ("above", 1))
FINGERS = (
    *(("down", finger(100, 100)), ("move", finger(130, 115)), ("move", finger(190, 100, shiftKey=True))),
    *(("down", finger(190, 200, 2)), ("move", finger(190, 300, 2)), ("up", finger(190, 300, 2))),
    *(("cancel", finger(190, 100)), ("move", finger(0, 0))),
)
ON_VIEW = (
    ("at first", "size", {"width": 600, "height": 300}),
    *((keys, "canvas keydown", keys) for keys in (*KEYS, "0", "+ + -", "Home")),
    *((f"{name} x {n}", f"{name} click", [{}] * n) for name, n in BUTTONS),
    ("no farther", "canvas keydown", "ArrowDown"),
    *((f"{kind} {event}", f"canvas pointer{kind}", event) for kind, event in FINGERS),
    ("the page is scrolled", "canvas wheel", {"deltaMode": 0, "deltaY": 100}),
    ("a pinch on a touchpad", "canvas wheel", {"deltaMode": 0, "deltaY": 10, "ctrlKey": True}),
    ("focus", "canvas focus", {}),
    ("five lines of the wheel", "canvas wheel", {"deltaMode": 1, "deltaY": -5}),
    ("a narrow page", "size", {"width": 200, "height": 300}),
    *((f"context {event}", f"canvas webglcontext{event}", {}) for event in ("lost", "restored")),
)


def test_view_draws_this_of_a_mould(made: Path, tmp_path: Path, golden: Golden) -> None:
    """What is given to WebGL of a box, and what is given again after each action, if it has changed."""
    box = trimesh.creation.box((60.0, 40.0, 8.0)).apply_translation((3.0, 4.0, 100.0))
    section = section_of(box, json.loads((made / "fabrication.json").read_text()), tmp_path)
    golden("padforge/mould_view.txt", shown("".join([*section.body, f"<script>{section.script}</script>"]), ON_VIEW))


@pytest.mark.parametrize("deep", ["horizontal", "vertical"])
def test_key_of_colours_gives_numbers_the_family_of_their_height(tmp_path: Path, deep: str) -> None:
    settings = FabricationSettings.from_spec(Spec({"pad": {"deep_family": deep}}))
    document = build(Morphology.straight(2), tmp_path, ["stl"], settings).to_dict()
    heights = {fibre["fibre"].split()[0]: fibre["ridge_mm"] for fibre in document["fibres"]}
    low = min(heights, key=lambda family: heights[family])  # as high as the numbers
    assert (low, document["settings"]["mould"]["shallow_ridge_height_mm"]) != (deep, heights[deep])
    section, _ = fabrication_sections(tmp_path, document)
    first, second = (" and the numbers" * (family == low) for family in ("horizontal", "vertical"))
    key = f"Tops of horizontal ridges{first} are blue, of vertical ones{second} orange."
    assert key in "".join(section.body)


def test_oversized_mesh_is_simplified_or_omitted(made: Path, pad: Path, monkeypatch) -> None:
    mould = pack_mesh(made / "mould.stl")
    assert mould
    assert mould.tolerance_mm == 0
    monkeypatch.setattr(report, "MAX_BYTES", mould.nbytes * 4 // 5)
    coarse = pack_mesh(made / "mould.stl")
    assert coarse
    assert coarse.tolerance_mm > 0
    assert coarse.nbytes <= report.MAX_BYTES
    assert volume(coarse) == pytest.approx(volume(mould), rel=0.01)
    monkeypatch.setattr(report, "MAX_BYTES", 1000)
    assert pack_mesh(made / "mould.stl") is None
    text = write_report(pad).read_text()
    assert "mould.stl is too large to be turned" in text
    assert "<canvas" not in text


def volume(mesh: PackedMesh) -> float:
    vertices = mesh.low_mm + mesh.vertices / 65535 * mesh.size_mm
    return float(trimesh.Trimesh(vertices, mesh.triangles, process=False).volume)


@pytest.fixture
def chromium(tmp_path: Path) -> Iterator[Chromium]:
    with Chromium(tmp_path / "profile", *SOFTWARE_GL) as chromium:
        yield chromium


def changed(one: np.ndarray, other: np.ndarray) -> float:
    """Share of pixels that differ clearly."""
    return float((np.abs(one - other).max(axis=-1) > 20).mean())


@pytest.mark.slow
def test_browser_draws_and_rotates_mould(chromium: Chromium, page: Path) -> None:
    chromium.open(page.as_uri())
    assert chromium.ask("document.getElementById('mould-view').hidden") is False
    first = chromium.picture("canvas")
    blue = (first[..., 2] - first[..., 0] > 60).sum()
    orange = (first[..., 0] - first[..., 2] > 100).sum()
    assert min(blue, orange) > 200
    chromium.ask("document.querySelector('canvas').focus()")
    chromium.press("ArrowLeft")
    assert changed(chromium.picture("canvas"), first) > 0.02
    chromium.press("0")
    assert changed(chromium.picture("canvas"), first) < 0.001

    chromium.open(page.as_uri(), width=360, height=740)
    assert chromium.ask("document.scrollingElement.scrollWidth <= innerWidth") is True
    assert chromium.ask("document.querySelectorAll('details').forEach(each => each.open = true)") is None
    assert chromium.ask("document.scrollingElement.scrollWidth <= innerWidth") is True
    assert chromium.complaints == []
    asked = {address.split(",")[0][:20] for address in chromium.requests if address != page.as_uri()}
    assert asked <= {"data:image/png;base6", "data:image/svg+xml;b"}
    loaded = "performance.getEntriesByType('resource').filter(each => !each.name.startsWith('data:')).length"
    assert chromium.ask(loaded) == 0

    # On paper there is the picture instead, and nothing is folded.
    chromium.call("Emulation.setEmulatedMedia", media="print")
    assert chromium.ask("document.querySelector('canvas').getClientRects().length") == 0
    assert chromium.ask("document.querySelector('img[alt*=\"from above\"]').getClientRects().length") == 1
    chromium.ask("dispatchEvent(new Event('beforeprint'))")
    assert chromium.ask("document.querySelectorAll('details:not([open])').length") == 0


@pytest.mark.slow
def test_report_without_webgl_shows_picture(tmp_path: Path, page: Path) -> None:
    with Chromium(tmp_path / "profile", "--disable-gpu", "--disable-3d-apis") as chromium:
        chromium.open(page.as_uri())
        assert chromium.ask("document.getElementById('mould-view').hidden") is True
        assert chromium.ask("document.querySelector('canvas').getClientRects().length") == 0
        picture = "document.querySelector('img[alt*=\"from above\"]')"
        assert chromium.ask(f"{picture}.complete && {picture}.naturalWidth > 0 && {picture}.clientWidth > 200") is True
        assert chromium.complaints == []
