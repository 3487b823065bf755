"""Studies of pads by simulation: what they find, that broken-off ones go on, and what the command line says of them."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from design import Contact, InputError, Morphology, signals
from design.evaluation.localisation_error import localisation_error
from sense.studies import scaling, sensitivity
from sense.studies.pads import load_pads
from sense.studies.robustness import robustness_study
from sense.studies.scaling import around, scaling_study, shares, spread_presses
from sense.studies.sensitivity import sensitivity_study
from sense.studies.study import Findings, Study, Task, run, study_lines

PADS = {"square": Morphology.straight(2), "random": Morphology.random(2, 3, 0)}


def small(**options) -> Study:
    return robustness_study(PADS, lost=2, hidden=10, presses=144, test=300, **options)


def rows_of(document: dict, **wanted) -> list[dict]:
    return [row for row in document["rows"] if wanted.items() <= row.items()]


def test_robustness_tells_the_errors_of_every_set_of_lost_fibres(tmp_path: Path) -> None:
    document = run(small(), tmp_path)
    assert [(row["pad"], row["lost"], row["subsets"]) for row in document["rows"]] == [
        (pad, lost, sets) for pad in PADS for lost, sets in ((0, 1), (1, 4), (2, 6))
    ]
    for pad in PADS:
        none, one, two = rows_of(document, pad=pad)
        assert none["mean"] < one["mean"] < two["mean"] <= two["max"]
        assert none["mean_mm"] == pytest.approx(11.25 * none["mean"])
        by_subset = [each for each in document["by_subset"] if each["pad"] == pad and len(each["lost"]) == 2]
        assert two["mean"] == pytest.approx(np.mean([each["mean"] for each in by_subset]))
        worst = max(by_subset, key=lambda each: each["mean"])
        assert [each["lost"] for each in document["maps"] if each["pad"] == pad][2] == worst["lost"]
    # A map of the square grid without both horizontal fibres: off by the height, which nothing tells any more.
    assert rows_of(document, pad="square", lost=2)[0]["max"] > 0.2


def test_robustness_agrees_with_evaluate(tmp_path: Path) -> None:
    document = run(small(rule="exact"), tmp_path)
    found = localisation_error(PADS["random"], lost=(2,), hidden=10, presses=144, test=300)
    (row,) = rows_of(document, pad="random", lost=2)
    # Each of the six sets is trained three times here, and once there.
    for key in ("mean", "std", "max"):
        assert getattr(found[0], key) == pytest.approx(row[key], rel=0.25)


def test_published_errors_are_reproduced(published: Path, tmp_path: Path) -> None:
    """Mean errors with all fibres and with one lost, as measured by others with the same protocol."""
    expected = {"square_grid_cir": (0.217, 0.216), "5para_dis": (0.065, 0.099), "20para": (0.056, 0.080)}
    pads = load_pads(tuple(str(published / f"{name}.mat") for name in expected), 0)
    document = run(robustness_study(pads, lost=1), tmp_path)
    for name, errors in expected.items():
        assert [row["mean"] for row in rows_of(document, pad=name)] == pytest.approx(errors, rel=0.15)


def test_files_of_a_study_say_the_same(tmp_path: Path) -> None:
    document = run(small(), tmp_path)
    assert json.loads((tmp_path / "robustness.json").read_text()) == json.loads(json.dumps(document))
    with (tmp_path / "robustness.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [float(row["mean"]) for row in table] == [row["mean"] for row in document["rows"]]
    text = (tmp_path / "robustness.md").read_text()
    assert all(paragraph in text for paragraph in document["text"])
    assert f"{document['rows'][0]['mean']:.4g}" in text
    assert (tmp_path / "robustness.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"robustness.{end}" for end in ("csv", "json", "md", "png")
    ]
    assert len(study_lines(document)) == 1 + len(document["rows"]) + 1 + len(document["text"])


def test_a_study_broken_off_goes_on_and_ends_the_same(tmp_path: Path) -> None:
    def stop(done: int, total: int, name: str) -> None:
        if done == 3:
            raise KeyboardInterrupt

    whole = run(small(), tmp_path / "whole", jobs=1)
    with pytest.raises(KeyboardInterrupt):
        run(small(), tmp_path / "broken", jobs=1, progress=stop)
    done = []
    again = run(small(), tmp_path / "broken", resume=True, progress=lambda done_, total, name: done.append(done_))
    assert done[0] >= 3
    assert again == whole
    assert (tmp_path / "whole" / "robustness.png").read_bytes() == (tmp_path / "broken" / "robustness.png").read_bytes()


def test_other_settings_are_no_help_to_a_study_broken_off(tmp_path: Path) -> None:
    kept = {"begun": 0}

    def task() -> dict:
        kept["begun"] += 1
        if kept["begun"] > 1:
            raise KeyboardInterrupt
        return {"a": np.ones(1)}

    def made(seed: int) -> Study:
        return Study(
            "x", "X", {"seed": seed}, [Task("a", task)] * 2, lambda states: Findings([], []), lambda document: Figure()
        )

    with pytest.raises(KeyboardInterrupt):
        run(made(0), tmp_path, jobs=1)
    with pytest.raises(InputError, match="begun with x seed 0, now 1"):
        run(made(1), tmp_path, resume=True)


def test_pads_in_another_order_are_another_study(tmp_path: Path) -> None:
    def stop(done: int, total: int, name: str) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(small(), tmp_path, jobs=1, progress=stop)
    turned = robustness_study(dict(reversed(PADS.items())), lost=2, hidden=10, presses=144, test=300)
    with pytest.raises(InputError, match="begun with robustness tasks"):
        run(turned, tmp_path, resume=True)


def test_a_folder_in_which_the_same_study_is_at_work_is_refused(tmp_path: Path) -> None:
    def made(make: Callable[[], dict]) -> Study:
        return Study("x", "X", {}, [Task("a", make)], lambda states: Findings([{"a": 1}], []), lambda _: Figure())

    def meet() -> dict:
        with pytest.raises(InputError, match="a x study is at work there"):
            run(made(lambda: {}), tmp_path)
        return {}

    run(made(meet), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.csv", "x.json", "x.md", "x.png"]


def test_a_figure_that_fails_leaves_no_half_of_the_results(tmp_path: Path) -> None:
    def draw(document: object) -> Figure:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(Study("x", "X", {}, [], lambda states: Findings([{"a": 1}], []), draw), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a$\\frac$", "_under", "pi|pe <b>", b"\xff".decode(errors="surrogateescape")])
def test_any_name_of_a_file_will_do(name: str, tmp_path: Path) -> None:
    path = tmp_path / name / "morphology.json"
    PADS["random"].save(path)
    pads = load_pads((str(path),), 0)
    document = run(robustness_study(pads, lost=0, hidden=5, presses=16, test=20), tmp_path / "out")
    (label,) = pads
    assert document["rows"][0]["pad"] == label
    table = (tmp_path / "out" / "robustness.md").read_text().splitlines()[-1]
    assert table.replace("\\|", "").count("|") == len(document["rows"][0]) + 1
    assert "<b>" not in table


def test_a_pad_that_no_press_touches_is_studied_all_the_same(tmp_path: Path) -> None:
    document = run(small(contact=Contact(radius=1e-6)), tmp_path)
    # Nothing is told, so the middle of the pad is the best guess: half a grid unit off each way at most.
    assert all(0.3 < row["mean"] < 0.5 for row in document["rows"])


def test_a_larger_object_is_located_better_and_a_strange_one_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("SIDE", 16), ("TEST", 300), ("MEMBERS", 2), ("HIDDEN", 15)):
        monkeypatch.setattr(sensitivity, name, value)
    document = run(sensitivity_study({"square": Morphology.straight(3)}, radii=(0.6, 1.0), sides=(4, 30)), tmp_path)
    assert len(document["rows"]) == 16

    def mean(trained: tuple, met: tuple) -> float:
        wanted = dict(zip(("trained_radius", "trained_sides", "radius", "sides"), (*trained, *met), strict=True))
        return rows_of(document, **wanted)[0]["mean"]

    assert mean((1.0, 30), (1.0, 30)) < 0.5 * mean((0.6, 30), (0.6, 30))
    assert mean((1.0, 30), (0.6, 30)) > 1.5 * mean((0.6, 30), (0.6, 30))


def test_one_network_for_all_tiles_keeps_its_error_as_the_surface_grows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("TEST", 600), ("HIDDEN", 30), ("EPOCHS", 30)):
        monkeypatch.setattr(scaling, name, value)
    document = run(scaling_study({"square": Morphology.straight(2)}, grids=(4, 16), side=32), tmp_path)
    small_shared, large_shared = (rows_of(document, way="shared", grid=grid)[0] for grid in (4, 16))
    assert large_shared["mean"] < 1.3 * small_shared["mean"] < 0.4
    assert large_shared["percent_of_side"] == pytest.approx(100 * large_shared["mean"] / 16)
    assert len(rows_of(document, way="published")) == len(rows_of(document, way="spread")) == 2


def test_shares_of_a_family_add_up_and_silence_has_none() -> None:
    given = np.array([[1.0, 3.0, 0.0, 0.0], [0.0, 2.0, 5.0, 5.0]])
    np.testing.assert_allclose(shares(given), [[0.25, 0.75, 0, 0, 4, 0], [0, 1, 0.5, 0.5, 2, 10]])


def test_what_is_around_a_press_is_the_same_in_every_tile() -> None:
    pad = Morphology.random(2, 3, 1).tiled(6)
    place = np.array([[5.2, 7.1]])
    here, origin = around(signals(pad, place), 2)
    there, moved = around(signals(pad, place + np.array([2.0, -4.0])), 2)
    np.testing.assert_allclose(here, there, atol=1e-9)
    np.testing.assert_array_equal(moved - origin, [[2.0, -4.0]])
    assert here.shape == (1, 12)


def test_presses_are_spread_over_all_cells() -> None:
    places = spread_presses(9, 8, 0)
    assert set(map(tuple, np.floor(places - 1).astype(int))) == {(x, y) for x in range(8) for y in range(8)}


def test_a_grid_that_tiles_do_not_fill_is_refused() -> None:
    with pytest.raises(InputError, match="grids has 6, expected multiples of 4"):
        scaling_study({"square": Morphology.straight(4)}, grids=(4, 6))


def test_pads_are_told_by_file_or_by_name(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    path = tmp_path / "mine" / "morphology.json"
    PADS["random"].save(path)
    pads = load_pads(("square@3", "random-2@2", str(path)), seed=4)
    assert pads == {
        "square@3": Morphology.straight(3),
        "random-2@2": Morphology.random(2, 2, 4),
        "mine": PADS["random"],
    }


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["robustness", "nowhere.json"], "nowhere.json: no such file, and none of square, optimised, random-N"),
        (["robustness", "square", "square"], "one called square is there already"),
        (["robustness", "square", "--presses", "1000"], "presses is 1000, allowed is a square number from 4"),
        (["robustness", "square@0"], "square@0: no such file"),
        (["scaling", "square", "--grids", "4,x"], "grids is '4,x', expected numbers from 2 to 256"),
        (["scaling", "square@3", "--grids", "4"], "grids has 4, expected multiples of 3"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(arguments: list[str], said: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "padforge", "study", *arguments, "--out", "out"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_an_interrupt_ends_at_once_and_keeps_what_was_finished(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "padforge", "study", "robustness", "square", "--presses", "4096"]
    study = subprocess.Popen(
        [*command, "--out", str(out)],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    try:
        deadline = time.monotonic() + 120
        while not list(out.glob("robustness-unfinished/start_*.npz")) and time.monotonic() < deadline:
            time.sleep(0.1)
        study.send_signal(signal.SIGINT)
        begin = time.monotonic()
        _, said = study.communicate(timeout=60)
    finally:
        study.kill()
    assert study.returncode == 130
    assert said == "padforge: interrupted; --resume goes on from what was finished\n"
    assert time.monotonic() - begin < 30
    assert list(out.glob("robustness-unfinished/start_*.npz"))
