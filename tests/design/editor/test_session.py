"""A pad being drawn: what is asked for is done, within what a pad allows; what cannot be done changes nothing."""

import json
from functools import partial

import pytest

from padforge import InputError, Spec
from padforge.common.files import sha256, write_json
from padforge.common.server import LocalPage, page_text
from padforge.design import Morphology, editor
from padforge.design.contact import grid_positions
from padforge.design.editor import EditSession
from tests.helpers.golden import Golden
from tests.helpers.page_script import shown
from tests.helpers.refusals import refusal_table


def session(tmp_path, pad=None, **size):
    views, source = [], None
    if pad is not None:
        source = tmp_path / "pad.json"
        pad.save(source)
    spec = Spec({"pad": size, "search": {"max_failures": 1}})
    editor = EditSession(spec, source, tmp_path / "out.json", views.append, False)
    editor.begin()
    return editor, views


def ask(editor, **edit):
    return editor.edit(json.dumps(edit).encode())


def move(editor, fibre, knot, x_mm, y_mm):
    return ask(editor, do="move", fibre=fibre, knot=knot, x_mm=x_mm, y_mm=y_mm)


EDITS = (
    *({"do": "move", "fibre": 1, "knot": 2, "x_mm": -5, "y_mm": y_mm, "gesture": "drag 1"} for y_mm in (1, 2, 3)),
    {"do": "move", "fibre": 1, "knot": 2, "x_mm": -5, "y_mm": 4, "gesture": "drag 2"},
    *({"do": "undo"}, {"do": "undo"}, {"do": "undo"}, {"do": "redo"}, {"do": "redo"}, {"do": "redo"}),
    {"do": "move", "fibre": 1, "knot": 3, "x_mm": 900, "y_mm": -900},
    {"do": "move", "fibre": 3, "knot": 2, "x_mm": 900, "y_mm": 0},
    {"do": "add", "fibre": 2, "x_mm": 2, "y_mm": 1},
    *({"do": "add", "fibre": 2}, {"do": "undo"}, {"do": "remove", "fibre": 2, "knot": 4}),
)


def test_edits_change_one_fibre_and_gestures_are_undone_together(tmp_path, golden: Golden) -> None:
    """On a pad 27 mm wide and 24 mm high, with the fibres that each edit changes: their knots, mm."""
    editor, views = session(tmp_path, Morphology.random((1, 2), 4, 1, (9.0, 12.0)))
    lines, before = [], [fibre["knots"] for fibre in views[-1]["fibres"]]
    for edit in EDITS:
        view = ask(editor, **edit)
        state = [f"{name}: {view[name]}" for name in ("number", "selected", "unsaved", "can_undo", "can_redo")]
        lines += [json.dumps(edit), f"  {', '.join(state)}"]
        knots = [fibre["knots"] for fibre in view["fibres"]]
        pairs = zip(knots, before, strict=True)
        lines += [f"  fibre {number}: {new}" for number, (new, old) in enumerate(pairs, 1) if new != old]
        before = knots
    golden("design/edits.txt", "\n".join(lines))


INVALID = (
    *({}, {"do": "shell"}, {"do": ["move"]}, {"do": "move"}, {"do": "remove", "fibre": 1}),
    *({"do": "remove", "fibre": 1, "knot": knot} for knot in (0, 6)),
    *({"do": "add", "fibre": fibre} for fibre in (0, 5, 1.5)),
    *({"do": "move", "fibre": 1, "knot": 1, "x_mm": x_mm, "y_mm": 0} for x_mm in (float("nan"), 1e7, "0")),
)


def test_save_replaces_neither_what_another_program_wrote_since_nor_a_pad_with_a_mould(tmp_path):
    """Into the file that lay there from the beginning, and into the one saved last."""
    Morphology.straight(1).save(tmp_path / "out.json")
    editor, _ = session(tmp_path, grid=1)
    for number, name in ((1, "out-2.json"), (2, "out-2-2.json")):
        foreign = Morphology.random(1, 3, number)
        foreign.save(editor.out)
        other = editor.out
        move(editor, 1, 1, 0.0, float(number))
        editor.save(b"{}")
        assert (editor.out.name, Morphology.load(other)) == (name, foreign)
        editor.save(b"{}")
        assert editor.out.name == name
    tmp_path = tmp_path / "other"
    editor, _ = session(tmp_path, Morphology.straight(2))
    read = sha256(tmp_path / "pad.json")
    Morphology.random(2, 3, 3).save(tmp_path / "pad.json")  # what was read counts
    editor.save(b"{}")
    assert Morphology.load(tmp_path / "out.json").provenance["inputs"] == {"pad.json": read}
    made = {"provenance": {"inputs": {"out.json": sha256(tmp_path / "out.json")}}}
    write_json(tmp_path / "fabrication.json", made)
    editor.save(b"{}")
    assert editor.out.name == "out.json"  # as it is
    before = (tmp_path / "out.json").read_bytes()
    ask(editor, do="add", fibre=1)
    assert editor.save(b"{}")["message"] == f"saved to {tmp_path / 'out-2.json'}"
    assert (tmp_path / "out.json").read_bytes() == before
    with pytest.raises(InputError, match=r"out.json: fabrication.json was made from it"):
        session(tmp_path)


def test_invalid_edits_are_refused_and_change_nothing(tmp_path, golden: Golden) -> None:
    editor, views = session(tmp_path, grid=2)
    rows = {json.dumps(edit): partial(ask, editor, **edit) for edit in INVALID}
    (empty, _), (full, _) = (session(tmp_path, pad) for pad in (Morphology.straight(1), Morphology.random(1, 64, 0)))
    rows["no knot to remove"] = partial(ask, empty, do="remove", fibre=1, knot=1)
    rows["no more knots"] = partial(ask, full, do="add", fibre=1)
    golden("design/refusals_of_edits.txt", refusal_table(rows))
    assert len(views) == 2
    move(editor, 1, 1, 0.0, 3.0)
    (tmp_path / "out.json").mkdir()
    with pytest.raises(InputError, match=r"out.json: cannot be written"):
        editor.save(b"{}")
    assert editor.unsaved


def pointer(x_mm, y_mm):
    """Over a position of the pad of 17 px of the drawing a millimetre, which is shown twice as large."""
    return {"clientX": 100 + 2 * (240 + 17 * x_mm), "clientY": 50 + 2 * (240 - 17 * y_mm), "pointerId": 5}


ON_PAGE = (
    ("up", "pad keydown", "ArrowUp"),
    ("three fine steps at once", "pad keydown", "Shift+ArrowRight Shift+ArrowRight Shift+ArrowRight"),
    *((name, name, {"key": "ArrowRight"}) for name in ("keyup", "knots 1 focus")),
    ("left, and finely down", "pad keydown", "ArrowLeft Shift+ArrowDown"),
    ("keys of the browser, or of nobody", "pad keydown", "Alt+ArrowUp x"),
    *((name, name, {}) for name in ("undo click", "redo click")),
    ("undo, redo, undo, redo", "keydown", "Ctrl+z Ctrl+Shift+Z Ctrl+z Ctrl+y"),
    ("the next fibre, and over the first to the last", "pad keydown", "PageDown PageUp PageUp"),
    *((key, "pad keydown", key) for key in ("Delete", "-", "Insert PageUp")),
    ("a click on a line", "lines 2 2 pointerdown", {}),
    ("a double click on another", "lines 1 2 dblclick", pointer(-5, 3.5)),
    *((name, name, {}) for name in ("knots 2 focus", "remove focus", "remove click", "save click", "beforeunload")),
    ("a fibre of the list", "fibre change", 0),
    ("a knot is held beside its middle", "knots 1 pointerdown", pointer(8, -2.75)),
    ("dragged", "pad pointermove", [pointer(8, -3), pointer(0, 0), pointer(7.5, -2.5)]),
    ("released", "pad pointerup", pointer(40, -4.75)),
    ("moved without a button", "pad pointermove", pointer(0, 0)),
    ("no room beside it", "lines 0 2 dblclick", pointer(12, -5)),
    ("a failed fibre", "failed change", 1),
    ("leave what is not saved", "beforeunload", {}),
)


def test_page_shows_this_of_a_pad_and_sends_these_edits(tmp_path, golden: Golden, monkeypatch) -> None:
    """All parts of the page that change, and what is sent to a session, which answers."""
    monkeypatch.setattr(editor, "free_presses", lambda settings: grid_positions(settings.sensed, side=3)[:6])
    size = {"horizontals": 2, "verticals": 1, "size_mm": [24, 18], "sensed_mm": [14, 9]}
    drawn, views = session(tmp_path, **size, keep_out_mm=[[[6, -9], [12, -9], [12, -5]]])
    other, other_views = session(tmp_path, **size, deep_family="vertical")
    for fibre in (1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3):
        ask(drawn, do="remove", fibre=fibre, knot=2)
        ask(other, do="remove", fibre=fibre, knot=2)
    move(drawn, 1, 1, -8, 2.3)
    text = page_text("padforge.design.editor", "editor.html", "editor.css", "drawing.js", "editor.js")
    with (
        LocalPage(0, text, {"/edit": drawn.edit, "/save": drawn.save}) as page,
        LocalPage(0, text, {"/edit": other.edit}) as other_page,
    ):
        actions = (
            *(("begins", "view", views[0]), ("a pad", "view", views[-1]), ("its server", "server", page.url[:-1])),
            *ON_PAGE,
            *(("a view that comes late", "view", views[1]), ("no server", "server", "")),
            *(("no response", "keydown", "Ctrl+s"), ("the end", "view", views[0] | {"ended": "ended in the terminal"})),
            ("leave after the end", "beforeunload", {}),
            *(("another", "server", other_page.url[:-1]), ("its pad", "view", other_views[-1])),
            ("right", "pad keydown", "ArrowRight"),
        )
        golden("design/editor_page.txt", shown(text, actions))
