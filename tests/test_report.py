"""The report: one page that holds everything, lets nothing in, and is honest about files it cannot read."""

import base64
import json
import re
import shutil
from collections.abc import Iterator
from html import escape
from pathlib import Path

import numpy as np
import pytest
import trimesh

from design.common.errors import InputError
from design.common.figures import save_figure
from design.common.files import provenance
from design.pad.morphology import Morphology
from design.report.plan_drawing import draw_plan
from design.settings import Contact, PadSettings, RulesSettings, SearchSettings
from fabricate import build
from fabricate.report.mould_view import Packed, packed
from padforge import write_report
from tests.chromium import CHROMIUM, SOFTWARE_GL, Chromium

HOSTILE = '</script><img src="x" onerror="document.title=1"> & <b>'
PAD = Morphology.random(2, 2, seed=1)
MOST_PAGE_BYTES = 8_000_000


def written(path: Path, document: dict) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(document))


def design_document() -> dict:
    used = {"pad": PadSettings(grid=2), "contact": Contact(), "search": SearchSettings(), "rules": RulesSettings()}
    settings = {name: section.model_dump(mode="json") for name, section in used.items()}
    return {
        "format": "padforge-design/1",
        "terms": {"ambiguity_lost_0": 0.1, "ambiguity_lost_1": 0.2, "information": 9.5},
        "violations": [],
        "provenance": provenance("padforge design", 3) | {"settings": settings},
    }


def errors(by_subset: dict[tuple[int, ...], float]) -> dict:
    rows = []
    for lost in sorted({len(each) for each in by_subset}):
        means = [mean for each, mean in by_subset.items() if len(each) == lost]
        names = ("mean_mm", "std_mm", "max_mm", "median_mm", "p95_mm", "within_r50", "within_r90")
        values = dict.fromkeys(names, 0.5) | {"mean_mm": float(np.mean(means)), "max_mm": max(means)}
        rows.append({"lost": lost, "subsets": len(means), **values})
    return {"errors": rows, "by_subset": [{"lost": list(lost), "mean_mm": mean} for lost, mean in by_subset.items()]}


def calibration_document() -> dict:
    found = {(): 1.0, (0,): 1.5, (1,): 4.25, (2,): 1.25, (3,): 2.0}
    pairs = {(one, two): found[one,] + found[two,] for two in range(4) for one in range(two)}
    return {
        "format": "padforge-calibration/1",
        **errors(found | pairs),
        "split": "random",
        "test_presses": 12,
        "idle_share": [0.1, 0.2, 0.3, 0.4],
        "provenance": provenance("padforge sense calibrate", 0),
    }


def study_document() -> dict:
    return {
        "format": "padforge-study-drift/1",
        "title": "Drift",
        "text": ["First.", "Second."],
        "rows": [{"pad": "square", "error": 1.25, "kept": True}, {"pad": "ours", "error": None, "kept": False}],
        "provenance": provenance("padforge study drift"),
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what every stage leaves, and a study."""
    folder = tmp_path_factory.mktemp("made")
    PAD.save(folder / "morphology.json")
    build(PAD, folder, ["stl", "png"], inputs=[folder / "morphology.json"])
    save_figure(draw_plan(PAD, Contact()), folder / "design.svg")
    written(folder / "design.json", design_document())
    written(folder / "calibration.json", calibration_document())
    source = {"kind": "simulated", "rig": {"rate_hz": 13.3, "depth_mm": 5.0}}
    made_by = provenance("padforge sense record")
    start = {"format": "padforge-recording/1", "fibres": 4, "source": source, "provenance": made_by}
    written(folder / "recording" / "start.json", start)
    written(folder / "studies" / "drift.json", study_document())
    shutil.copy(folder / "tracks.png", folder / "studies" / "drift.png")
    return folder


@pytest.fixture
def pad(made: Path, tmp_path: Path) -> Path:
    """A copy of it, to be changed."""
    return shutil.copytree(made, tmp_path / "pad")


@pytest.fixture(scope="module")
def page(made: Path) -> Path:
    return write_report(made)


def unpacked(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) mm and triangles (m, 3) of the mesh in a page."""
    found = re.search(r'<script type="application/json" id="mould-mesh">(.*?)</script>', text)
    assert found
    data = json.loads(found[1])
    steps = np.frombuffer(base64.b64decode(data["vertices"]), "<u2").reshape(-1, 3)
    kind = "<u4" if data["wide"] else "<u2"
    triangles = np.frombuffer(base64.b64decode(data["triangles"]), kind).reshape(-1, 3)
    return np.array(data["low"]) + steps / 65535 * np.array(data["size"]), triangles


def test_every_stage_has_its_section_and_a_link_to_it(page: Path) -> None:
    text = page.read_text()
    titles = re.findall(r'<h2 id="(.*?)">(.*?)</h2>', text)
    names = ["Fibres", "Mould", "Making the pad", "Recording", "Calibration", "Robustness", "Studies", "Provenance"]
    assert [title for _, title in titles] == names
    assert all(f'<a href="#{anchor}">{title}</a>' in text for anchor, title in titles)
    assert text.count("data:image/") == 4  # plan, mould, tracks, and the study's figure
    assert page.stat().st_size < MOST_PAGE_BYTES


def test_nothing_comes_from_elsewhere_and_only_known_scripts_run(page: Path) -> None:
    text = page.read_text()
    assert "http://" not in text
    assert "https://" not in text
    policy = re.search(r'http-equiv="Content-Security-Policy" content="(.*?)"', text)
    assert policy
    assert policy[1].startswith("default-src 'none'")
    assert "script-src 'sha256-" in policy[1]
    assert "script-src 'unsafe" not in policy[1]


def test_the_mesh_in_the_page_is_the_mould(made: Path, page: Path) -> None:
    vertices, triangles = unpacked(page.read_text())
    mould = trimesh.load_mesh(made / "mould.stl", process=False)
    half_step = np.ptp(mould.vertices, axis=0) / 65535 / 2
    assert (np.abs(vertices[triangles] - mould.triangles).max(axis=(0, 1)) <= 1.001 * half_step).all()
    assert len(vertices) < len(mould.vertices) / 4


def test_a_mesh_of_many_vertices_has_wide_numbers(tmp_path: Path) -> None:
    sphere = trimesh.creation.uv_sphere(radius=30, count=[257, 257])
    sphere.export(tmp_path / "mould.stl")
    mesh = packed(tmp_path / "mould.stl", most_bytes=10**8)
    assert mesh
    assert mesh.triangles.max() + 1 == len(mesh.vertices) > 65536
    assert volume(mesh) == pytest.approx(sphere.volume, rel=1e-4)


def test_a_mesh_that_is_too_large_is_made_coarser_or_left_out(made: Path, pad: Path, monkeypatch) -> None:
    whole = packed(made / "mould.stl")
    assert whole
    assert whole.tolerance_mm == 0
    coarse = packed(made / "mould.stl", most_bytes=whole.nbytes * 4 // 5)
    assert coarse
    assert coarse.tolerance_mm > 0
    assert coarse.nbytes <= whole.nbytes * 4 // 5
    assert volume(coarse) == pytest.approx(volume(whole), rel=0.01)
    assert packed(made / "mould.stl", most_bytes=1000) is None
    monkeypatch.setattr("fabricate.report.sections.packed", lambda path: None)
    text = write_report(pad).read_text()
    assert "mould.stl is too large to be turned" in text
    assert "<canvas" not in text


def volume(mesh: Packed) -> float:
    vertices = mesh.low_mm + mesh.vertices / 65535 * mesh.size_mm
    return float(trimesh.Trimesh(vertices, mesh.triangles, process=False).volume)


def test_text_from_files_is_escaped(pad: Path) -> None:
    design, mould, study = design_document(), json.loads((pad / "fabrication.json").read_text()), study_document()
    design["violations"] = [{"rule": HOSTILE, "fibres": [HOSTILE], "measured": 1, "limit": 2, "place_mm": None}]
    design["provenance"] |= {"command": HOSTILE, "inputs": {HOSTILE.replace("/", ""): HOSTILE}}
    design["terms"][HOSTILE] = HOSTILE
    mould["findings"][0] |= {"message": HOSTILE, "name": HOSTILE}
    mould["silicone"]["name"] = HOSTILE
    study |= {"title": HOSTILE, "text": [HOSTILE], "rows": [{HOSTILE: HOSTILE}]}
    for name, document in (("design", design), ("fabrication", mould), ("studies/drift", study)):
        written(pad / f"{name}.json", document)
    text = write_report(pad.rename(pad.with_name("<b>&"))).read_text()
    assert text.count(escape(HOSTILE)) >= 10
    assert "<img src=" not in text
    assert "<b>&" not in text
    assert text.count("<script") == text.count("</script>") == 3


def test_rules_and_checks_have_their_verdicts(pad: Path) -> None:
    design, mould = design_document(), json.loads((pad / "fabrication.json").read_text())
    broken = {"rule": "min_gap_mm", "fibres": [1, 2], "measured": 0.25, "limit": 0.8, "place_mm": [1.0, 2.0]}
    design["violations"] = [broken]
    mould["findings"][0] |= {"status": "warn", "message": "thin", "places_mm": [[k, 0.5] for k in range(5)]}
    written(pad / "design.json", design)
    written(pad / "fabrication.json", mould)
    text = write_report(pad).read_text()
    assert re.search(r'<td class="fail">fail</td><td.*?>min_gap_mm</td>', text)
    assert re.search(r'<td class="pass">pass</td><td.*?>border_mm</td>', text)
    assert "(1.0, 2.0)" in text
    assert '<td class="warn">warn</td><td>thin</td>' in text.replace(' class="short"', "")
    assert "(0.0, 0.5) (1.0, 0.5) (2.0, 0.5) and 2 more" in text


def test_the_laying_guide_is_that_of_the_bench(made: Path, page: Path) -> None:
    document, text = json.loads((made / "fabrication.json").read_text()), page.read_text()
    for fibre in document["fibres"]:
        assert f"{fibre['cut_mm']:.1f} mm</td>" in text
    assert f"The mould holds {document['silicone_volume_ml']:.1f} ml" in text
    for line in (made / "laying.md").read_text().split("\n"):
        if line.startswith(("1. ", "2. ")):
            assert escape(line[3:]) in text


def test_the_loss_that_hurts_most_is_named(page: Path) -> None:
    text = page.read_text()
    assert "of one fibre, 2 (4.25 mm); of two fibres, 2 and 4 (6.25 mm)" in text
    assert "<title>without 2 and 4: 6.25 mm</title>" in text
    assert text.count("<title>without ") == 4 + 6


def test_a_study_of_robustness_takes_the_place_of_the_calibration(pad: Path) -> None:
    ways = {"one network": errors({(): 1.0, (0,): 7.5, (1,): 3.0}), "retrained": errors({(): 1.0, (0,): 2, (1,): 8.5})}
    document = {"format": "padforge-robustness/1", "ways": ways, "test_presses": 9, "provenance": provenance("x")}
    written(pad / "robustness.json", document)
    text = write_report(pad).read_text()
    assert "of one fibre, 1 (7.50 mm)" in text
    assert "of one fibre, 2 (8.50 mm)" in text
    assert "4.25 mm" not in text


def test_provenance_says_which_inputs_are_the_ones_here(pad: Path) -> None:
    assert "(the one here)" in write_report(pad).read_text()
    (pad / "morphology.json").write_text("{}")
    assert "(not the one here)" in write_report(pad).read_text()


@pytest.mark.parametrize("name", ["design", "fabrication", "calibration", "studies/drift"])
def test_a_stage_alone_is_enough(made: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "studies").mkdir()
    shutil.copy(made / f"{name}.json", tmp_path / f"{name}.json")
    text = write_report(tmp_path).read_text()
    assert "Provenance" in text
    assert "<figure><img" not in text


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("[1]")
    with pytest.raises(InputError, match=r"no design\.json"):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


DAMAGED = {
    "design.json": ['{"format": "padforge-design/1", "terms": {}}', '{"format": "padforge-design/2"}', "{", "[]"],
    "fabrication.json": ['{"format": "padforge-fabrication/1", "findings": []}'],
    "calibration.json": ['{"format": "padforge-calibration/1", "errors": []}'],
    "robustness.json": ['{"format": "padforge-robustness/1", "ways": {"x": {"by_subset": [{"lost": [1]}]}}}'],
    "recording/start.json": ['{"format": "padforge-recording/1", "fibres": 4}'],
    "mould.stl": ["solid nothing", ""],
    "mould.png": ["", "no picture"],
    "design.svg": ["<svg", ""],
    "studies/drift.json": [
        "{",
        '{"format": "padforge-study-drift/1"}',
        '{"format": "padforge-study-drift/1", "title": "a", "text": "b", "rows": []}',
        '{"format": "padforge-study-drift/1", "title": "a", "text": [], "rows": [{"a": 1}, {"b": 1}]}',
    ],
}


@pytest.mark.parametrize(("name", "content"), [(name, text) for name, texts in DAMAGED.items() for text in texts])
def test_a_damaged_file_is_named_in_one_line(pad: Path, name: str, content: str) -> None:
    (pad / name).write_text(content)
    with pytest.raises(InputError) as told:
        write_report(pad)
    assert str(told.value).startswith(f"{pad / name}: ")
    assert "\n" not in str(told.value)


def test_a_torn_picture_is_named(pad: Path) -> None:
    whole = (pad / "mould.png").read_bytes()
    (pad / "mould.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"mould\.png: not a picture"):
        write_report(pad)


@pytest.fixture
def chromium(tmp_path: Path) -> Iterator[Chromium]:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    with Chromium(tmp_path / "profile", *SOFTWARE_GL) as chromium:
        yield chromium


def changed(one: np.ndarray, other: np.ndarray) -> float:
    """Share of pixels that differ clearly."""
    return float((np.abs(one - other).max(axis=-1) > 20).mean())


def test_a_browser_draws_the_mould_and_turns_it(chromium: Chromium, page: Path) -> None:
    chromium.open(page.as_uri())
    assert chromium.ask("document.getElementById('mould-view').hidden") is False
    first = chromium.picture("canvas")
    blue = (first[..., 2] - first[..., 0] > 60).sum()
    orange = (first[..., 0] - first[..., 2] > 100).sum()
    assert min(blue, orange) > 200
    chromium.ask("document.querySelector('canvas').focus()")
    seen = [first]
    for key in ("ArrowLeft", "ArrowUp", "+"):
        chromium.press(key)
        seen.append(chromium.picture("canvas"))
        assert changed(seen[-1], seen[-2]) > 0.02
    chromium.press("0")
    assert changed(chromium.picture("canvas"), first) < 0.001
    box = chromium.ask("(({x, y, width, height}) => [x + width / 2, y + height / 2])"
                       "(document.querySelector('canvas').getBoundingClientRect())")  # fmt: skip
    for kind, right in (("mousePressed", 0), ("mouseMoved", 90), ("mouseReleased", 90)):
        at = {"x": box[0] + right, "y": box[1], "button": "left", "buttons": 1, "clickCount": 1}
        chromium.call("Input.dispatchMouseEvent", type=kind, **at)
    chromium.wait_for_frames()
    assert changed(chromium.picture("canvas"), first) > 0.02

    chromium.open(page.as_uri(), width=360, height=740)
    assert chromium.ask("document.scrollingElement.scrollWidth <= innerWidth") is True
    assert chromium.ask("document.querySelectorAll('details').forEach(each => each.open = true)") is None
    assert chromium.ask("document.scrollingElement.scrollWidth <= innerWidth") is True
    assert chromium.complaints == []
    assert {address.split(",")[0][:20] for address in chromium.requests if address != page.as_uri()} <= {
        "data:image/png;base6",
        "data:image/svg+xml;b",
    }
    assert (
        chromium.ask("performance.getEntriesByType('resource').filter(each => !each.name.startsWith('data:')).length")
        == 0
    )

    # On paper there is the picture instead, and nothing is folded.
    chromium.call("Emulation.setEmulatedMedia", media="print")
    assert chromium.ask("document.querySelector('canvas').getClientRects().length") == 0
    assert chromium.ask("document.querySelector('img[alt*=\"from above\"]').getClientRects().length") == 1
    chromium.ask("dispatchEvent(new Event('beforeprint'))")
    assert chromium.ask("document.querySelectorAll('details:not([open])').length") == 0
    chromium.call("Emulation.setEmulatedMedia", media="")

    # A context that is lost comes back.
    chromium.ask(
        "void (lose = document.querySelector('canvas').getContext('webgl2').getExtension('WEBGL_lose_context'))"
    )
    hidden = "new Promise(done => setTimeout(() => done(document.getElementById('mould-view').hidden), 100))"
    chromium.ask("lose.loseContext()")
    assert chromium.ask(hidden) is True
    chromium.ask("lose.restoreContext()")
    assert chromium.ask(hidden) is False
    assert len(np.unique(chromium.picture("canvas").reshape(-1, 3), axis=0)) > 100


def test_without_webgl_the_picture_stands_there(tmp_path: Path, page: Path) -> None:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    with Chromium(tmp_path / "profile", "--disable-gpu", "--disable-3d-apis") as chromium:
        chromium.open(page.as_uri())
        assert chromium.ask("document.getElementById('mould-view').hidden") is True
        assert chromium.ask("document.querySelector('canvas').getClientRects().length") == 0
        picture = "document.querySelector('img[alt*=\"from above\"]')"
        assert chromium.ask(f"{picture}.complete && {picture}.naturalWidth > 0 && {picture}.clientWidth > 200") is True
        assert chromium.complaints == []
