"""A pad being drawn: what is asked for is done, within what a pad allows; what cannot be done changes nothing."""

import json

import numpy as np
import pytest

from padforge import InputError, Spec
from padforge.common.files import sha256, write_json
from padforge.design import Morphology
from padforge.design.editor import EditSession


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


def move(editor, fibre, knot, x_mm, y_mm, gesture=""):
    return ask(editor, do="move", fibre=fibre, knot=knot, x_mm=x_mm, y_mm=y_mm, gesture=gesture)


def test_gestures_are_undone_together(tmp_path):
    editor, views = session(tmp_path, grid=2)
    first = views[-1]["fibres"]
    for y_mm in (1.0, 2.0, 3.0):
        move(editor, 1, 2, -5.0, y_mm, "drag 1")
    after = move(editor, 1, 2, -5.0, 4.0, "drag 2")
    assert (after["unsaved"], after["can_undo"], after["can_redo"]) == (True, True, False)
    assert ask(editor, do="undo")["fibres"][0]["knots"][2][1] == pytest.approx(3.0)
    undone = ask(editor, do="undo")
    assert (undone["fibres"], undone["unsaved"], undone["can_undo"]) == (first, False, False)
    assert ask(editor, do="undo")["fibres"] == first
    ask(editor, do="redo")
    assert ask(editor, do="redo")["fibres"] == after["fibres"]
    assert [view["number"] for view in views[1:]] == list(range(1, len(views)))


MOVE = b'{"do": "move", "fibre": 1, "knot": 1, "x_mm": %s, "y_mm": 0, "gesture": %s}'
INVALID = (
    *(b"{}", b'{"do": "shell"}', b'{"do": ["move"]}', b'{"do": "move"}', b'{"do": "remove", "fibre": 1}'),
    *(b'{"do": "remove", "fibre": 1, "knot": %d}' % knot for knot in (0, 6)),
    *(b'{"do": "add", "fibre": %s}' % fibre for fibre in (b"0", b"5", b"1.5")),
    *(MOVE % (x, b'""') for x in (b"NaN", b"1e7", b'"0"')),
)


def test_save_does_not_replace_what_another_program_wrote_since(tmp_path):
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


def test_save_does_not_replace_pad_with_mould(tmp_path):
    """One that was saved before, and one that lies there from the beginning."""
    editor, _ = session(tmp_path, Morphology.straight(2))
    editor.save(b"{}")
    made = {"provenance": {"inputs": {"out.json": sha256(tmp_path / "out.json")}}}
    write_json(tmp_path / "fabrication.json", made)
    editor.save(b"{}")  # as it is
    before = (tmp_path / "out.json").read_bytes()
    ask(editor, do="add", fibre=1)
    assert editor.save(b"{}")["message"] == f"saved to {tmp_path / 'out-2.json'}"
    assert (tmp_path / "out.json").read_bytes() == before
    with pytest.raises(InputError, match=r"out.json: fabrication.json was made from it"):
        session(tmp_path)


def test_move_clips_knots_to_the_pad_and_between_their_neighbours(tmp_path):
    """27 mm wide and 24 mm high."""
    editor, _ = session(tmp_path, Morphology.random((1, 2), 4, 1, (9.0, 12.0)))
    knots = np.array(move(editor, 1, 3, 900.0, -900.0)["fibres"][0]["knots"])
    assert knots[4, 0] - 0.1 < knots[3, 0] < knots[4, 0]
    assert knots[3, 1] == pytest.approx(-12.0)
    assert move(editor, 3, 2, 900.0, 0.0)["fibres"][2]["knots"][2][0] == pytest.approx(13.5)


def test_add_and_remove_change_one_fibre(tmp_path):
    editor, views = session(tmp_path, Morphology.random(2, 5, 3))
    before = views[-1]["fibres"]
    more = ask(editor, do="add", fibre=2, x_mm=1.0, y_mm=0.0)
    fibre, knot = more["selected"]
    assert (fibre, len(more["fibres"][1]["knots"])) == (1, 8)
    assert more["fibres"][1]["knots"][knot][0] == pytest.approx(1.0)
    assert [more["fibres"][n]["knots"] for n in (0, 2, 3)] == [before[n]["knots"] for n in (0, 2, 3)]
    x = np.array(more["fibres"][1]["knots"])[:, 0]
    longest = int(np.diff(x).argmax())
    middle = ask(editor, do="add", fibre=2)
    assert middle["selected"] == (1, longest + 1)
    assert middle["fibres"][1]["knots"][longest + 1][0] == pytest.approx(x[longest : longest + 2].mean(), abs=1e-3)
    ask(editor, do="undo")
    assert ask(editor, do="remove", fibre=2, knot=knot)["fibres"][1]["knots"] == before[1]["knots"]


def test_save_writes_view_with_provenance(tmp_path):
    editor, _ = session(tmp_path, Morphology.random(2, 3, 3))
    read = sha256(tmp_path / "pad.json")
    Morphology.straight(2).save(tmp_path / "pad.json")  # what was read counts
    ask(editor, do="add", fibre=1)
    move(editor, 1, 1, -10.0, 2.0)
    saved = editor.save(b"{}")
    pad = Morphology.load(tmp_path / "out.json")
    assert pad.to_mm(pad.knots[0])[1] == pytest.approx(saved["fibres"][0]["knots"][1], abs=1e-4)
    assert pad.provenance["inputs"] == {"pad.json": read}
    assert (editor.unsaved, ask(editor, do="undo")["unsaved"]) == (False, True)


def test_invalid_edits_are_refused_and_change_nothing(tmp_path):
    editor, views = session(tmp_path, grid=2)
    for body in INVALID:
        with pytest.raises(InputError) as error:
            editor.edit(body)
        assert len(str(error.value)) < 300, body
    assert len(views) == 2
    for pad, edit, message in (
        (Morphology.straight(1), {"do": "remove", "fibre": 1, "knot": 1}, "no inner knot"),
        (Morphology.random(1, 64, 0), {"do": "add", "fibre": 1}, "64 knots"),
    ):
        with pytest.raises(InputError, match=message):
            ask(session(tmp_path, pad)[0], **edit)
    move(editor, 1, 1, 0.0, 3.0)
    (tmp_path / "out.json").mkdir()
    with pytest.raises(InputError, match=r"out.json: cannot be written"):
        editor.save(b"{}")
    assert editor.unsaved
