import json
import re
from pathlib import Path

from padforge.common.files import provenance
from padforge.report import write_report
from padforge.sense.report.sections import recording_sections
from tests.helpers.golden import page_text
from tests.padforge.report.conftest import errors, written

VERSIONS = r"python \d[^|]*(?= \|)"
MAX_PAGE_BYTES = 8_000_000


def test_page_of_all_stages(page: Path, golden) -> None:
    text = page.read_text(encoding="utf-8")
    golden("padforge/report.txt", page_text(text), forget=[VERSIONS])
    for anchor in re.findall(r'<a href="#(.*?)"', text):
        assert text.count(f'id="{anchor}"') == 1
    assert text.count("data:image/") == 7  # plan, press, mould, tracks, orientation, crossing, and the study's figure
    assert len(text) < MAX_PAGE_BYTES
    assert not re.search("https?://", text)


def test_page_with_a_study_of_lost_fibres_and_presses_of_known_force(pad: Path, golden) -> None:
    """The errors of the study take the place of those of the calibration."""
    start = json.loads((pad / "recording" / "start.json").read_text())
    start["source"]["rig"]["depths_mm"] = [0.5, 5.0]
    written(pad / "recording" / "start.json", start)
    lines = []
    for press, (depth_mm, force) in enumerate([(0.5, {"force_n": 1.25}), (1.25, {}), (5.0, {})]):
        begin = {"press": press, "reading": 2 * press + 1, "x_mm": 0, "y_mm": 0, "depth_mm": depth_mm}
        end = {"press": press, "reading": 2 * press + 2, "at_mm": [0, 0, depth_mm - 0.05]}
        lines += [{"event": "started"} | begin, {"event": "done"} | end | force]
    (pad / "recording" / "journal.ndjson").write_text("".join(json.dumps(line) + "\n" for line in lines))
    network, retrained = {(): 1.0, (0,): 7.5, (1,): 3.0}, {(): 1.0, (0,): 2.0, (1,): 8.5}
    methods = {"one network": errors(network), "retrained": errors(retrained)}
    document = {"format": "padforge-fibre-loss/1", "methods": methods, "test_presses": 9, "provenance": provenance("x")}
    written(pad / "fibre_loss.json", document)
    text = page_text(write_report(pad).read_text(encoding="utf-8"))
    golden("padforge/report_of_losses.txt", text[text.index("## Recording") : text.index("## Contact model")])


def test_sections_on_recordings(golden) -> None:
    sections = []
    for source in (
        {"kind": "simulated", "rig": {"rate_hz": 13.3, "depth_mm": 5.0}},
        {"kind": "rig", "rig": {"rate_hz": 50, "depths_mm": [4.0, 1.5]}},
        {"kind": "published", "file": "5.mat"},
        {"kind": "hand", "rig": {"rate_hz": 20.0}},
        {"kind": "simulated", "twin": {}},
    ):
        sections += recording_sections(Path("none"), {"source": source, "fibres": 7})
    body = "".join(part for section in sections for part in section.body)
    golden("padforge/recordings.txt", page_text(f"<div>{body}</div>"))
