import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge import InputError, Spec
from padforge.common.server import page_text as served_page
from padforge.design import Contact, Morphology, SearchOptions, SearchResult, draw_plan, search
from padforge.design import compare as comparison
from padforge.design.contact_comparison import compare_contacts
from padforge.design.design_run import load_result, summary_lines
from padforge.design.editor import EditSession
from padforge.design.objectives.rules import Violation
from padforge.design.settings import PadSettings, RulesSettings, SearchSettings
from tests.design.conftest import max_distance_mm
from tests.helpers.door import call
from tests.helpers.folders import files_in
from tests.helpers.golden import Golden, figure_text, json_text, page_text
from tests.helpers.less import compare_little

SETTINGS = """[pad]
horizontals = 2
verticals = 3
pitch_mm = [10, 12]
deep_family = "vertical"
keep_out_mm = [[14, 11, 3], [[-17, 9], [-13, 9], [-13, 14]]]
[search]
max_failures = 1
[rules]
max_length_mm = 48
max_crossings = 9
"""
SEARCH = """[pad]
horizontals = 1
verticals = 2
pitch_mm = [10, 12]
[search]
seed = 3
starts = 2
steps = 20
max_failures = 1
contacts = "assumed"
[rules]
enforce = false
"""
VERSIONS = r'(?<=": ")\d+(\.\w+)+(?=")'
SECONDS = r"(?<=fibres in )[\d.]+(?= s)", r'(?<="seconds": )[\d.]+'
ROUNDING = r"-?\d\.\d+e-1\d"
PORT = r"(?<=127\.0\.0\.1:)\d+"


@pytest.fixture
def run(here: Path, bent_pad: Morphology, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Runs commands beside a pad and its settings, and returns what they print, with their exit code."""
    compare_little(monkeypatch)
    monkeypatch.setattr("padforge.design.optimize.gradient.REPAIR_STEPS", 20)
    Path("pad.toml").write_text(SETTINGS)
    bent_pad.save("pad.json")

    def run(*arguments: str) -> str:
        ended = call("design", *arguments)
        printed = ended.out + (f"[stderr]\n{ended.err}" if ended.err else "")
        return f"$ padforge design {' '.join(arguments)}\n{printed}[exit {ended.code}]\n"

    return run


def document_of(path: str) -> Any:
    return json.loads(Path(path).read_text())


def test_design(run, golden: Golden) -> None:
    """From a pad, which has as many knots as are searched for."""
    Path("pad.toml").write_text(SEARCH)
    Morphology.random((1, 2), 2, 1, (10.0, 12.0)).save("first.json")
    printed = run("--start-from", "first.json")
    golden("design/design.txt", printed, forget=SECONDS, rtol=1e-3)
    document = document_of("out/pad/design.json")
    golden("design/design.json", json_text(document), forget=[VERSIONS, *SECONDS], rtol=1e-3)
    golden("design/design_morphology.json", json_text(document_of("out/pad/morphology.json")["knots"]), rtol=1e-3)
    names = {"design.json", "figures/design.png", "figures/design.svg", "morphology.json"}
    assert files_in(Path("out/pad")).keys() == names
    read = load_result(Path("out/pad"))
    assert summary_lines(read, Path("out/pad")) == printed.splitlines()[1:-1]
    assert (read.terms, read.straight, read.history) == tuple(document[x] for x in ("terms", "straight", "history"))
    Path("out/pad/design.json").write_text(json.dumps(document | {"violations": [{"rule": 1}]}))
    with pytest.raises(InputError, match="not as padforge writes it"):
        load_result(Path("out/pad"))


def test_summaries_of_searches(golden: Golden) -> None:
    """One that was stopped and breaks many rules, one that finds nothing, and one without rules."""
    broken = [Violation("max_length_mm", (fibre,), 600.0, 500.0) for fibre in range(1, 13)]
    names = [f"expected_error_mm_{n}" for n in (0, 1, 2)]
    errors, straight = (dict(zip(names, values, strict=True)) for values in ((0.5, 1.0, 2.0), (0.52, 1.06, 3.0)))
    ended = {"seconds": 61.25, "stopped": "out of time"}
    stopped = SearchResult(Morphology.straight(6), errors, broken, "start 1", straight, **ended)
    vain = replace(stopped, violations=[], candidate="straight fibres", stopped="")
    one = {"terms": {"expected_error_mm_0": 0.1}, "straight": {"expected_error_mm_0": 1.0}}
    free = replace(vain, **one, candidate="start 2", enforced=False)
    results = [summary_lines(result, Path("out/pad")) for result in (stopped, vain, free)]
    golden("design/summaries.txt", "\n\n".join(map("\n".join, results)))


def test_check(run, golden: Golden) -> None:
    golden("design/check.txt", run("check", "pad.json") + run("check", "pad.json", "--json"))
    Morphology.straight((2, 3), (10.0, 12.0)).save("straight.json")
    Path("none.toml").write_text("[rules]\n")
    golden("design/check_straight.txt", run("check", "straight.json", "--spec", "none.toml"))


def test_score(run, golden: Golden, twin: Path) -> None:
    golden("design/score.txt", run("score", "pad.json"), rtol=1e-3)
    Path("shape.toml").write_text("[contact]\nradius = 0.7\n[rules]\nenforce = false\n")
    golden("design/score_shape.txt", run("score", "pad.json", "--spec", "shape.toml"), rtol=1e-3)
    Path("twin.toml").write_text("[search]\nmax_failures = 1\n")
    shutil.copy(twin, "twin.json")
    golden("design/score_twin.txt", run("score", "pad.json", "--spec", "twin.toml", "--twin", "twin.json"), rtol=1e-3)


def test_show_draws_what_import_reads(run, golden: Golden, figures: list[Any], bent_pad: Morphology) -> None:
    printed = run("show", "pad.json") + run("show", "pad.json", "--out", "plan.png")
    golden("design/show_plan.txt", figures[0], forget=[ROUNDING])
    golden("design/show.txt", printed + run("import", "plan.svg", "--tolerance-mm", "0.5"), rtol=1e-3)
    assert max_distance_mm(Morphology.load("out/plan/morphology.json"), bent_pad) < 0.6


def test_plans_of_every_contact_with_none_and_with_few_broken_rules(golden: Golden) -> None:
    """Of a pad of which two fibres of a family cross, and with a keep-out."""
    knots = [[[0.0, 1], [1.5, 2.5], [3, 1]], [[0, 2], [1.5, 2], [3, 2]], *([[x, 0], [x, 1.5], [x, 3]] for x in (1, 2))]
    places = (1.0, -2.0), None, (3.0, 4.0)
    pad, broken = Morphology(np.array(knots)), [Violation("max_length_mm", (1,), 60.0, 50.0, at) for at in places]
    texts = []
    for number, contact in enumerate((Contact(), Contact(model="profile"), Contact(radius=0.6), Contact(sides=None))):
        plan = draw_plan(pad, contact, broken[:number], [((9, 9), (12, 9), (9, 12))])
        texts.append(figure_text(plan))
    golden("design/plans.txt", "\n".join(texts), forget=[ROUNDING])


def test_import(run, golden: Golden) -> None:
    ways = ["M -20 -6 C -10 -15 10 3 20 -6.13", "M -20 6 L 20 6", *(f"M {x} -18 L {x} 18" for x in (-10, 0, 10))]
    paths = "".join(f'<path id="w{number}" d="{way}"/>' for number, way in enumerate(ways))
    hidden = '<path display="none" d="M 0 0 L 1 1"/>'
    head = 'xmlns="http://www.w3.org/2000/svg" viewBox="-20 -18 40 36" width="40mm" height="36mm"'
    Path("plan.svg").write_text(f"<svg {head}>{paths}{hidden}</svg>")
    arguments = "import", "plan.svg", "--tolerance-mm", "0.4"
    printed = run(*arguments, "--json", "--force")
    golden("design/import.txt", run(*arguments) + printed, rtol=1e-3)
    written = document_of("out/plan/morphology.json")
    golden("design/import_morphology.json", json_text(written), forget=[VERSIONS], rtol=1e-3)


def test_edit(run, golden: Golden, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a command that is interrupted after an edit, and as the view of a page after some."""

    def interrupt(editor: EditSession) -> None:
        editor.edit(b'{"do": "add", "fibre": 1}')
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(EditSession, "begin", interrupt)
        golden("design/edit.txt", run("edit", "pad.json", "--port", "0"), forget=[PORT])
    assert not Path("pad-edited.json").exists()

    views: list[dict[str, Any]] = []
    spec = Spec.load(Path("pad.toml"))
    editor = EditSession(spec, Path("pad.json"), Path("pad-edited.json"), views.append, force=False)
    editor.begin()
    editor.edit(b'{"do": "move", "fibre": 1, "knot": 2, "x_mm": 5, "y_mm": -7, "gesture": "a"}')
    editor.edit(b'{"do": "add", "fibre": 4}')
    editor.edit(b'{"do": "undo"}')
    golden("design/edit_begun.json", views[0])
    view = views[-1]
    presses = [view.pop(name) for name in ("positions_mm", "ambiguity_map_mm")]
    summary = [[len(rows), rows[0], rows[-1]] for rows in (presses[0], *presses[1])]
    golden("design/edit_view.json", json_text(view | {"maps": summary}), forget=[r'(?<="session": ")\w+'], rtol=1e-4)
    editor.save(b"{}")
    editor.end()
    golden("design/edit_morphology.json", json_text(document_of("pad-edited.json")), forget=[VERSIONS])
    names = ("number", "message", "ended", "unsaved", "can_undo", "can_redo", "selected")
    words = page_text(served_page("padforge.design.editor", "editor.html", "editor.css", "drawing.js", "editor.js"))
    golden("design/edit_page.txt", words)
    golden("design/edit_messages.json", json_text([{name: view[name] for name in names} for view in views[1:]]))


def test_names_of_variants(golden: Golden) -> None:
    vary = ["pad.grid=1,2", "pad.pitch_mm=9.5,[8,12]", 'contact.tool="ball"']
    variants = comparison.read_variants([], vary, lambda path: Spec({}))
    rows = [[variant.name, variant.folder, str(variant.spec.section(PadSettings).layout)] for variant in variants]
    golden("design/variants.txt", "\n".join(" | ".join(row) for row in rows))


def test_contacts(run, golden: Golden, bent_pad: Morphology) -> None:
    Path("out/pad").mkdir(parents=True)
    bent_pad.save("out/pad/morphology.json")
    spec = Spec({"contact": {"model": "profile"}, "search": {"max_failures": 1, "seed": 3}})
    compare_contacts(spec, bent_pad, Path("out/pad"))
    golden("design/contacts.json", json_text(document_of("out/pad/contacts.json")), forget=[VERSIONS], rtol=1e-3)


def test_progress_and_history_of_a_search(golden: Golden, monkeypatch: pytest.MonkeyPatch) -> None:
    """Starts report in any order, each with the best objective so far."""
    compare_little(monkeypatch)
    monkeypatch.setattr("padforge.design.optimize.search.SLICE_S", 1e9)
    reported: list[tuple[int, int, str]] = []
    settings = SearchSettings(knots=2, starts=4, steps=40, max_failures=1, contacts="assumed")
    options = SearchOptions(lambda *progress: reported.append(progress))
    found = search(PadSettings(grid=1), Contact(), settings, RulesSettings(enforce=False), run=options)
    lines = sorted(f"{done} of {total}, {what}" for done, total, what in reported)
    golden("design/progress.txt", "\n".join(lines), forget=["(?<=best ).*"], rtol=1e-3)
    golden("design/history.json", json_text([*found.history, {"candidate": found.candidate}]), rtol=1e-3)
