"""The report: one page that holds everything, lets nothing in, and is honest about files it cannot read."""

import json
import re
import shutil
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape

from padforge.common.files import provenance
from padforge.common.plotting import HORIZONTAL, VERTICAL
from padforge.common.validation import Fault, InputError
from padforge.design.contact import FIBRE_BLUR_MM, contact_press, half_widths_mm, profile_weights
from padforge.design.morphology import Morphology
from padforge.design.report import contact_lines, contact_sections, design_sections, draw_press, press_sections
from padforge.design.settings import Contact, RulesSettings
from padforge.fabricate import build
from padforge.report import write_report
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import Recorder
from padforge.sense.report.sections import (
    calibration_sections,
    fibre_loss_sections,
    loss_chart,
    recording_sections,
)
from tests.helpers.less import blank_pictures
from tests.padforge.report.conftest import (
    HOSTILE,
    contacts_document,
    design_document,
    errors,
    study_document,
    written,
)

MOST_PAGE_BYTES = 8_000_000


def test_every_stage_has_a_linked_section(page: Path) -> None:
    text = page.read_text()
    titles = re.findall(r'<h2 id="(.*?)">(.*?)</h2>', text)
    names = ["Fibres", "Press", "Mould", "Making the pad", "Recording", "Calibration", "Fibre loss", "Contact model"]
    assert [title for _, title in titles] == [*names, "Studies", "Provenance"]
    assert all(f'<a href="#{anchor}">{title}</a>' in text for anchor, title in titles)
    assert text.count("data:image/") == 7  # plan, press, mould, tracks, orientation, crossing, and the study's figure
    assert page.stat().st_size < MOST_PAGE_BYTES


def test_report_loads_nothing_external(page: Path) -> None:
    text = page.read_text()
    assert "http://" not in text
    assert "https://" not in text
    policy = re.search(r'http-equiv="Content-Security-Policy" content="(.*?)"', text)
    assert policy
    assert policy[1].startswith("default-src 'none'")
    assert "script-src 'sha256-" in policy[1]
    assert "script-src 'unsafe" not in policy[1]


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


def test_report_contains_laying_guide(made: Path, page: Path) -> None:
    document, text = json.loads((made / "fabrication.json").read_text()), page.read_text()
    for fibre in document["fibres"]:
        assert f"{fibre['cut_mm']:.1f} mm</td>" in text
    assert f"The mould holds {document['silicone_volume_ml']:.1f} ml" in text
    for line in (made / "laying.md").read_text().split("\n"):
        if line.startswith(("1. ", "2. ")):
            assert escape(line[3:]) in text


def test_fibre_loss_study_replaces_errors_of_calibration(pad: Path) -> None:
    methods = {
        "one network": errors({(): 1.0, (0,): 7.5, (1,): 3.0}),
        "retrained": errors({(): 1.0, (0,): 2, (1,): 8.5}),
    }
    document = {"format": "padforge-fibre-loss/1", "methods": methods, "test_presses": 9, "provenance": provenance("x")}
    written(pad / "fibre_loss.json", document)
    text = write_report(pad).read_text()
    assert "of one fibre, 1 (7.50 mm)" in text
    assert "of one fibre, 2 (8.50 mm)" in text
    assert "4.25 mm" not in text


def test_provenance_compares_inputs_with_files_here(pad: Path) -> None:
    assert "(the one here)" in write_report(pad).read_text()
    (pad / "morphology.json").write_text("{}")
    with pytest.raises(Fault, match=r"fabrication .* is of another pad"):
        write_report(pad)
    text = (pad / "report.html").read_text()
    assert "(not the one here)" in text
    assert text.index("Files of different pads") < text.index("Design rules"), "first thing on the page"


def test_provenance_names_inputs_elsewhere_and_opens_none(pad: Path) -> None:
    """A file of another folder is not this one's, though it could be found from here; a computed input is a command."""
    (pad.parent / "spec.toml").write_text("secret")
    document = json.loads((pad / "fabrication.json").read_text())
    inputs = {"../spec.toml": "ab12", "pad.toml": "cd34", "twin": {"command": "padforge sense identify"}}
    document["provenance"] |= {"inputs": inputs, "command": "made so", "seed": 7, "versions": {"numpy": "2.0"}}
    (pad / "pad.toml").write_text("[pad]")
    written(pad / "fabrication.json", document)
    text = re.sub(r"\s*<[^>]*>\s*", "|", write_report(pad).read_text())
    read = "../spec.toml ab12; pad.toml cd34 (not the one here); twin: padforge sense identify"
    assert f"|made so||7||numpy 2.0||{read}|" in text


def test_report_warns_of_design_of_other_pad(pad: Path) -> None:
    document = json.loads((pad / "design.json").read_text())
    written(pad / "design.json", document | {"morphology_sha256": "0" * 64})
    with pytest.raises(Fault, match=r"design .* is of another pad"):
        write_report(pad)


def test_report_warns_of_errors_on_other_recording(pad: Path) -> None:
    """As a run leaves them that is broken off between recording and calibration, for another pad than before."""
    shutil.rmtree(pad / "recording")
    with Recorder(pad / "recording", 1, {"kind": "simulated"}, {}) as recorder:
        recorder.append(np.arange(4) / 10, np.zeros((4, 1)))
        recorder.begin((0, 0), 1)
        recorder.finish(3)
    document = json.loads((pad / "calibration.json").read_text())
    for of, strange in ((Recording.open(pad / "recording").digest, False), ("0" * 64, True)):
        document["provenance"]["inputs"] = {"recording": of}
        written(pad / "calibration.json", document)
        with pytest.raises(Fault, match=r"calibration .* is of another recording") if strange else nullcontext():
            write_report(pad)
    assert "Files of different pads" in (pad / "report.html").read_text()
    (pad / "recording" / "readings.bin").unlink()
    write_report(pad)


@pytest.mark.parametrize("name", ["design", "calibration"])
def test_report_works_with_one_stage(made: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "studies").mkdir()
    shutil.copy(made / f"{name}.json", tmp_path / f"{name}.json")
    text = write_report(tmp_path).read_text()
    assert "Provenance" in text
    assert ("<figure><img" in text) == (name == "design"), "the press alone is drawn by the report"


def test_report_refuses_folder_without_results(tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("[1]")
    with pytest.raises(InputError, match=r"no design\.json"):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


DAMAGED = {
    "design.json": ['{"format": "padforge-design/1", "terms": {}}', '{"format": "padforge-design/0"}'],
    "fabrication.json": ['{"format": "padforge-fabrication/1", "findings": []}'],
    "calibration.json": ['{"format": "padforge-calibration/1", "errors": []}'],
    "fibre_loss.json": ['{"format": "padforge-fibre-loss/1", "methods": {"x": {"by_subset": [{"failed": [1]}]}}}'],
    "mould.stl": ["solid nothing"],
    "studies/drift.json": [
        '{"format": "padforge-study-drift/1", "title": "a", "text": [], "rows": [{"a": 1}, {"b": 1}]}'
    ],
}


@pytest.mark.parametrize(("name", "content"), [(name, text) for name, texts in DAMAGED.items() for text in texts])
def test_report_refuses_damaged_file_in_one_line(pad: Path, name: str, content: str) -> None:
    (pad / name).write_text(content)
    with pytest.raises(InputError) as told:
        write_report(pad)
    assert str(told.value).startswith(f"{pad / name}: ")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", ["mould.stl", "orientation.svg"])
def test_report_omits_mould_of_other_checks(
    pad: Path, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    blank_pictures(monkeypatch)
    build(Morphology.straight(2), tmp_path / "other", [name.partition(".")[2]])
    shutil.copy(tmp_path / "other" / name, pad / name)
    with pytest.raises(
        InputError, match=rf"{name}: is not the one fabrication\.json was written with; fabricate again"
    ):
        write_report(pad)


def test_report_shows_depth_and_force(pad: Path) -> None:
    start = json.loads((pad / "recording" / "start.json").read_text())
    start["source"]["rig"]["depths_mm"] = [0.5, 5.0]
    (pad / "recording" / "start.json").write_text(json.dumps(start))
    lines = [
        {"event": "started", "press": 0, "reading": 1, "x_mm": 0, "y_mm": 0, "depth_mm": 0.5},
        {"event": "done", "press": 0, "reading": 2, "at_mm": [0, 0, 0.45], "force_n": 1.25},
        {"event": "started", "press": 1, "reading": 3, "x_mm": 0, "y_mm": 0, "depth_mm": 5.0},
        {"event": "done", "press": 1, "reading": 4, "at_mm": [0, 0, 4.95]},
    ]
    journal = "".join(json.dumps(line) + "\n" for line in lines)
    (pad / "recording" / "journal.ndjson").write_text(journal)
    page = write_report(pad).read_text()
    words = " ".join(re.sub("<[^>]*>", " ", page).split())
    assert "presses 0.5 to 5 mm deep" in words
    for row in (("depth commanded (mm)", 2, "0.50", "2.75", "5.00"), ("force (N)", 1, "1.25", "1.25", "1.25")):
        assert " ".join(map(str, row)) in words
    (pad / "recording" / "journal.ndjson").write_text("{}\n")
    with pytest.raises(InputError, match=r"journal\.ndjson: line 1"):
        write_report(pad)


def test_report_compares_strain_of_fibres_with_what_they_bear(pad: Path) -> None:
    design, mould = design_document(), json.loads((pad / "fabrication.json").read_text())
    design["provenance"]["settings"]["contact"] = Contact(depth_mm=2.0, thickness_mm=8.0).model_dump(mode="json")
    mould["fibre"]["max_strain"] = 0.01
    written(pad / "design.json", design)
    written(pad / "fabrication.json", mould)
    text = write_report(pad).read_text()
    assert "pressed 2 mm deep into silicone of 8 mm" in text
    assert text.count('<td class="number">1%</td>') == 2
    assert re.search(r'1%</td><td class="warn">warn</td>', text)
    section = text.partition(">Press</h2>")[2].partition("<h2")[0]
    assert len(section) > 10_000  # with the picture
    assert not (pad / "press.png").exists()


def test_drawn_tool_touches_the_face_within_its_contact() -> None:
    """The silicone follows the tool up to the edge of the contact, where it leaves it downwards."""
    contact = Contact(tool="ball", tool_radius_mm=12.0, depth_mm=2.0, thickness_mm=8.0)
    edge_mm = contact_press(contact).contact_radius_mm
    section = draw_press(contact, 11.25).axes[0]
    x, face = (np.asarray(part, float) for part in section.lines[0].get_data())
    rise = 12 - np.sqrt(np.maximum(12**2 - x**2, 0))
    inside = np.abs(x) < 0.95 * edge_mm
    np.testing.assert_allclose(face[inside], 6.0 + rise[inside], atol=0.02)
    # of the tool: its surface, and the top of the picture
    drawn = np.asarray(section.collections[1].get_paths()[0].vertices, float)
    for at, height in zip(x, 6.0 + rise, strict=True):
        if edge_mm < abs(at) and height < drawn[:, 1].max():
            assert np.isclose(drawn[np.isclose(drawn[:, 0], at), 1], height).any()


def test_loss_chart_has_two_failed_fibres_in_the_column_of_the_first_and_the_row_of_the_second() -> None:
    """The labels of columns stand below them, those of rows to their left."""
    single, pairs = {(fibre,): 1.0 + fibre for fibre in range(3)}, {(0, 1): 4.0, (0, 2): 5.0, (1, 2): 6.0}
    text = loss_chart(single | pairs, 3)
    cells = re.findall(r'<rect x="(\d+)" y="(\d+)" width="38".*?<title>without (.*?): ', text)
    corners = {name: (int(x), int(y)) for x, y, name in cells}
    assert corners["1 and 3"] == (corners["1"][0], corners["3"][1])
    assert corners["2 and 3"] == (corners["2"][0], corners["3"][1])
    assert corners["1"][1] < corners["3"][1]
    labels = re.findall(r'<text x="([\d.]+)" y="([\d.]+)" font-size="14">(\d)</text>', text)
    rows, columns = labels[::2], labels[1::2]
    for number, (row, column) in enumerate(zip(rows, columns, strict=True), 1):
        x, y = corners[str(number)]
        assert (row[2], column[2]) == (str(number), str(number))
        assert y < float(row[1]) < y + 40
        assert float(row[0]) < corners["1"][0]
        assert float(column[0]) == pytest.approx(x + 19)
        assert float(column[1]) > corners["3"][1] + 40


def words(body: Sequence[str]) -> str:
    """Return the text of HTML elements, with a bar where one ends."""
    return re.sub(r"\s*(<[^>]*>\s*)+", "|", "".join(body))


def test_design_section_has_errors_rules_and_terms() -> None:
    document = design_document()
    settings = document["provenance"]["settings"]
    settings["rules"] = RulesSettings().model_dump(mode="json")
    settings["pad"] = {"horizontals": 2, "verticals": 3, "pitch_mm": [8.0, 15.0]}
    settings["search"] |= {"scatter": 0.184, "noise": 0.0123}
    violation = {"rule": "min_gap_mm", "fibres": [1, 3], "place_mm": [1.04, -2.0], "measured": 0.5, "limit": 2.0}
    pad_rule = {"rule": "max_crossings", "fibres": [], "place_mm": None, "measured": 9, "limit": 4}
    document |= {
        "terms": {"expected_error_mm_1": 2.346, "expected_error_mm_0": 1.0, "sharpness": 0.25},
        "straight": {"expected_error_mm_1": 4.0, "expected_error_mm_0": 12.34},
        "descriptions": {"sharpness": "how sharp"},
        "violations": [violation, pad_rule],
    }
    [section] = design_sections(Path("none"), document)
    text = words(section.body)
    # of 3 verticals, 8 mm apart, and 2 horizontals, 15 mm apart, a pitch beyond the outermost, and sensed half as far
    assert list(section.figures) == [
        ("2 + 3", "fibres on 32 x 45 mm"),
        ("2 broken", "design rules"),
        ("1.00 mm", "expected error of the design"),
    ]
    assert "|failed fibres|expected error (mm)|straight fibres (mm)|0|1.00|12.3|1|2.35|4.00|" in text
    assert "vary by 18% of their value from press to press, plus 1.2% of full scale." in text
    assert "Checked on the exact curves: 2 broken." in text
    assert "|broken rule|fibres|position (mm)|measured|limit|min_gap_mm|1, 3|(1.0, -2.0)|0.5|2" in text
    assert "|max_crossings|pad|-|9|4|" in text
    assert "|sharpness|0.25|how sharp|" in text
    results = {name: result for result, name in re.findall(r"\|(pass|fail|not enforced)\|(\w+)(?=\|)", text)}
    assert {name for name, result in results.items() if result == "fail"} == {"min_gap_mm", "max_crossings"}
    assert set(results) == set(settings["rules"]) - {"enforce"}
    settings["rules"]["enforce"] = False
    [section] = design_sections(Path("none"), document | {"violations": []})
    assert ("not enforced", "design rules") in section.figures


def test_contact_section_and_line_compare_pads_by_contact() -> None:
    document = contacts_document()
    [section] = contact_sections(Path(), document)
    text = words(section.body)
    assert "with a scatter of 18% of the response and 2.0% of full scale" in text
    head = "|contact|fibres|0 failed|1 failed|"
    assert f"{head}as assumed|designed|0.50|0.75|as assumed|straight|1.00|1.50|designed / straight|50%|50%|" in text
    assert "|published disc, K = 0.6|designed|4.00|6.00|published disc, K = 0.6|straight|3.00|5.00|" in text
    third = [{"contact": "half", "pad": pad, "errors_mm": [error]} for pad, error in (("designed", 2), ("straight", 7))]
    line, lost = contact_lines(document | {"rows": document["rows"] + third})
    assert line == (
        "contact: expected error 0.50 mm under the assumed contact, 2.00 to 4.00 mm otherwise; of"
        " straight fibres 1.00 mm under the assumed contact, 3.00 to 7.00 mm otherwise"
    )
    assert "half" not in lost


def test_press_section_states_what_the_press_does_to_each_family(monkeypatch: pytest.MonkeyPatch) -> None:
    blank_pictures(monkeypatch)
    document = design_document()
    contact = Contact(depth_mm=2.0, thickness_mm=8.0, tool_radius_mm=10.0, fibre_depths_mm=(1.5, 0.5))
    document["provenance"]["settings"]["contact"] = contact.model_dump(mode="json")
    press = contact_press(contact)
    [section] = press_sections(document, 0.5)
    text = words(section.body)
    assert (
        f"A dome of 10 mm, pressed 2 mm deep into silicone of 8 mm, touches it within {press.contact_radius_mm:.1f} mm"
        f" and takes {press.force_n():.1f} N on Ecoflex 00-20."
    ) in text
    r_mm = np.linspace(0, 2 * press.contact_radius_mm, 100)
    for name, depth, width in zip(("horizontal", "vertical"), (1.5, 0.5), half_widths_mm(contact), strict=True):
        strains = press.strains(r_mm, 8 - depth, FIBRE_BLUR_MM)
        squeeze, stretch = strains.compressive.max(), max(strains.radial.max(), strains.hoop.max())
        assert f"|{name}|{depth:g}|{width:.1f}|{squeeze:.0%}|{stretch:.0%}|50%|pass|" in text
    assert "|-|-|" in words(press_sections(document, None)[0].body)
    stiffer = words(press_sections(document, 0.5, ("Dragon Skin 30", 550))[0].body)
    assert f"takes {10 * press.force_n():.1f} N on Dragon Skin 30." in stiffer


def test_press_is_drawn_with_weights_lengthwise_and_crosswise() -> None:
    contact = Contact(depth_mm=2.0, thickness_mm=8.0)
    section, weights = draw_press(contact, 11.25).axes
    assert (section.get_xlabel(), section.get_ylabel()) == ("x (mm)", "height (mm)")
    assert section.texts[-1].get_text() == f"{contact.tool} of {contact.tool_radius_mm:g} mm, 2 mm deep"
    ends = np.asarray(section.lines[-1].get_xdata(), float)
    assert np.diff(ends) == pytest.approx(11.25)
    assert 0 in ends
    lines = {str(line.get_label()): line for line in weights.lines if str(line.get_label())[0] != "_"}
    for (name, colour), (distance, plain, directed) in zip(
        (("horizontal", HORIZONTAL), ("vertical", VERTICAL)), profile_weights(contact), strict=True
    ):
        along, across = lines[f"{name}, lengthwise"], lines[f"{name}, crosswise"]
        np.testing.assert_allclose(np.array(along.get_data(), float), (distance, plain + directed))
        np.testing.assert_allclose(np.array(across.get_data(), float), (distance, plain))
        assert along.get_color() == across.get_color() == colour
    assert (weights.get_xlabel(), weights.get_ylabel()) == ("distance from the press (mm)", "weight of an element")


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (
            {"kind": "simulated", "rig": {"rate_hz": 13.3, "depth_mm": 5.0}},
            "the simulated rig, 13.3 a second; presses 5",
        ),
        (
            {"kind": "rig", "rig": {"rate_hz": 50, "depths_mm": [4.0, 1.5]}},
            "a rig, 50 a second; presses 1.5 to 4 mm",
        ),
        ({"kind": "published", "file": "5.mat"}, "from 5.mat."),
        ({"kind": "simulated", "twin": {}}, "the simulated rig, by the twin of a printed pad."),
    ],
)
def test_recording_section_says_where_readings_are_from(tmp_path: Path, source: dict, said: str) -> None:
    [section] = recording_sections(tmp_path, {"source": source, "fibres": 7})
    text = words(section.body)
    assert "Readings of 7 fibres, from " in text
    assert said in text


def test_calibration_section_has_a_row_a_number_of_failed_fibres(tmp_path: Path) -> None:
    """Of distinct numbers, none of which may stand in the place of another."""
    names = ("mean_mm", "std_mm", "max_mm", "median_mm", "p95_mm")
    rows = [
        {"n_failed": n, "subsets": 1 + 3 * n}
        | {name: 1.0 + n + 0.1 * k for k, name in enumerate(names)}
        | {"within_r50": 0.51 + 0.01 * n, "within_r90": 0.91 + 0.01 * n}
        | {"depth_mean_mm": 0.21 + n, "depth_p95_mm": 0.43 + n, "depth_within_r90": 0.87 + 0.01 * n}
        | {"force_mean_n": 3.1 + n, "force_p95_n": 6.2 + n, "force_within_r90": 0.77 + 0.01 * n}
        for n in (0, 1)
    ]
    moments = [
        {"since": since, "time_s": time_s, "n_failed": n, "mean_mm": time_s + n, "within_r90": 0.9 + 0.01 * n}
        for since, time_s in (("touch", 0.25), ("lift", 0.5))
        for n in (0, 1)
    ]
    document = {"errors": rows, "by_moment": moments, "idle_share": [0.1, 0.256], "split": "chronological"}
    document |= {"test_presses": 12, "provenance": {"recording_kind": "rig"}, "by_subset": []}
    section, *_ = calibration_sections(tmp_path, document)
    text = words(section.body)
    assert "Errors on 12 presses never trained on (the last ones). One network serves all failures." in text
    assert "|failed|sets|mean (mm)|std|worst|median|95 %|in r50|in r90|" in text
    assert "|0|1|1.00|1.10|1.20|1.30|1.40|51.0%|91.0%|1|4|2.00|2.10|2.20|2.30|2.40|52.0%|92.0%|" in text
    assert "|failed|depth, mean (mm)|95 %|in r90|0|0.21|0.43|87.0%|1|1.21|1.43|88.0%|" in text
    assert "|failed|force, mean (N)|95 %|in r90|0|3.10|6.20|77.0%|1|4.10|7.20|78.0%|" in text
    assert "|since|time (s)|0 failed (mm)|in r90|1 failed (mm)|in r90|" in text
    assert "|touch|0.25|0.25|90.0%|1.25|91.0%|lift|0.50|0.50|90.0%|1.50|91.0%|" in text
    assert "|fibre|1|2|idle|10%|26%|" in text
    assert list(section.figures) == [
        ("1.00 mm", "mean error on presses, all fibres"),
        ("2.00 mm", "mean error on presses, 1 fibre failed"),
    ]
    document |= {"provenance": {"recording_kind": "simulated"}, "split": "random", "errors": rows[:1], "by_moment": []}
    section, *_ = calibration_sections(tmp_path, document)
    text = words(section.body)
    assert "12 simulated presses never trained on (drawn at random). Every position" in text
    assert "with 0 / 1 / 2 / 3 of 6 fibres failed, after 4500 presses." in text
    assert list(section.figures) == [("1.00 mm", "mean error on simulated presses, all fibres")]


def test_worst_losses_are_named_in_words_and_ranked() -> None:
    errors_mm = {(): 1.0, (0,): 2.0, (1,): 4.0, (2,): 3.0, (0, 1): 10.0, (0, 2): 20.0, (1, 2): 5.0}
    by_subset = [{"failed": list(failed), "mean_mm": error} for failed, error in errors_mm.items()]
    (section,) = fibre_loss_sections(Path(), {"by_subset": by_subset})
    text = words(section.body)
    assert "The worst loss: of one fibre, 2 (4.00 mm); of two fibres, 1 and 3 (20.00 mm)." in text
    assert "With all fibres the error is 1.00 mm." in text
    assert "|failed|mean (mm)|1 and 3|20.00|1 and 2|10.00|2 and 3|5.00|2|4.00|3|3.00|1|2.00|" in text
