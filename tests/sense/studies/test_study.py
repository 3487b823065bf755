"""The frame of all studies: pads by name, tasks in any order, all results or none."""

import threading
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from matplotlib.figure import Figure

from padforge.design import Contact, Morphology, PadSettings, SearchSettings, contact
from padforge.design.optimize.search import SearchResult
from padforge.design.published.networks import fit_batch
from padforge.design.settings import PUBLISHED_CONTACT, Layout
from padforge.sense.settings import LocalizerSettings, RigSettings
from padforge.sense.simulation.pad_model import ADC_STEPS
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.studies import drift, indentation
from padforge.sense.studies.multicontact import multicontact_study
from padforge.sense.studies.robustness import robustness_study
from padforge.sense.studies.scaling import scaling_study
from padforge.sense.studies.sensitivity import sensitivity_study
from padforge.sense.studies.strokes import strokes_study
from padforge.sense.studies.study import (
    Sizes,
    Study,
    StudyResult,
    Task,
    compute_states,
    describe_pads,
    fit_and_predict,
    load_pads,
    read_counts,
    run,
)
from tests.helpers.door import called, refused
from tests.helpers.golden import Golden, json_text

PADS = {"square": Morphology.straight(2)}
SMALLER = {
    "drift.MEMBERS": 2,
    "drift.EPOCHS": 2,
    "drift.COMPENSATIONS": drift.COMPENSATIONS[:-1],  # the sign of principal components is that of a processor
    "drift.FILTERS": {each: drift.FILTERS[each] for each in (drift.RAW, drift.AS_PUBLISHED)},
    "indentation.FORCE_NOISES": (1.0,),
    "indentation.TOOLS": ("dome", "flat"),
    "indentation.SETS": {"tools": ("dome", "flat")},
    "scaling.TEST": 50,
    "scaling.EPOCHS": 8,
    **{f"robustness.{name}": value for name, value in {"HIDDEN": 6, "TEST": 60, "MIN_NETWORKS": 4}.items()},
    **{f"sensitivity.{name}": value for name, value in {"SIDE": 8, "TEST": 60, "MEMBERS": 2, "HIDDEN": 4}.items()},
}
TINY = LocalizerSettings(members=1, hidden=8, layers=1, epochs=1, batch=16, max_failures=0)
SMALLEST: dict[str, Callable[[], Study]] = {
    "drift": lambda: drift.drift_study({}, {"real": simulate(PADS["square"], RigSettings(presses=40, seed=3))}),
    "force": lambda: indentation.force_study(PADS, sizes=Sizes(60, 40, hidden=4, epochs=3)),
    "shape": lambda: indentation.shape_study(PADS, sizes=Sizes(100, 60, hidden=4, epochs=3)),
    "multicontact": lambda: multicontact_study(PADS, sizes=Sizes(100, 60, hidden=5, members=2, epochs=3)),
    "strokes": lambda: strokes_study(PADS, presses=40, strokes=3, options=TINY),
    "scaling": lambda: scaling_study(PADS, grids=(2, 4), side=16),
    "robustness": lambda: robustness_study(PADS, max_failures=2, presses=64),
    "sensitivity": lambda: sensitivity_study(PADS, contact=PUBLISHED_CONTACT),
}


@pytest.mark.parametrize("name", SMALLEST)
@pytest.mark.usefixtures("blank")
def test_every_study_concludes_from_its_tasks(name: str, golden: Golden, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(contact, "DEPTH_STEPS", 4)
    for constant, value in SMALLER.items():
        monkeypatch.setattr(f"padforge.sense.studies.{constant}", value)
    document = run(SMALLEST[name](), tmp_path, jobs=1)
    rows = [{key: value for key, value in row.items() if "second" not in key} for row in document["rows"]]
    kept = json_text([list(rows[0]), *(list(row.values()) for row in rows)])
    golden(f"studies/smallest/{name}.json", kept, rtol=2e-2)


def test_published_networks_stop_by_presses_that_they_do_not_learn_and_others_are_left_out() -> None:
    """Other targets, within the range that networks are scaled by, change when a training stops, or nothing."""
    rng, y, networks = np.random.default_rng(0), np.random.default_rng(1).uniform(-1, 1, (60, 2)), []
    x = y @ rng.normal(size=(2, 3)) + rng.normal(size=(60, 3))
    y[:2], order = [[-2, -2], [2, 2]], np.random.default_rng(4).permutation(60)
    for rows in ([], order[:42], order[42:51], order[51:]):
        is_changed = np.isin(np.arange(60), rows)[:, None] & (np.abs(y) < 2)
        networks += fit_batch(x, np.where(is_changed, -1.9 * np.sign(y), y), [np.random.default_rng(4)], 12, 30)
    assert [np.array_equal(networks[0](x), network(x)) for network in networks[1:]] == [False, False, True]


def test_networks_see_no_test_presses() -> None:
    """Other targets of the presses to test on change no prediction; nor do other signals that of the others."""
    sizes, rng = Sizes(40, 10, hidden=4, epochs=5, members=2), np.random.default_rng(0)
    inputs, targets = rng.normal(size=(50, 3)), rng.normal(size=(50, 2))
    test, last = np.arange(50)[:, None] >= 40, np.arange(50)[:, None] == 49
    predictions = []
    for change, scale in ((0.0, 1.0), (1e3, 1.0), (0.0, 5.0)):
        features = np.where(last, scale * inputs, inputs)
        predictions.append(fit_and_predict(features, targets + change * test, np.random.default_rng(1), sizes))
    np.testing.assert_array_equal(predictions[0], predictions[1])
    np.testing.assert_array_equal(predictions[0][:-1], predictions[2][:-1])


@pytest.mark.parametrize("executor", [None, ThreadPoolExecutor(2)], ids=["threads", "executor"])
def test_results_do_not_depend_on_the_order_of_tasks(executor: Executor | None) -> None:
    """The second task ends first: the first one waits until that is reported."""
    gate = threading.Event()
    tasks = [
        Task("first", lambda: {"value": np.array(1.0 if gate.wait(10) else 0.0)}),
        Task("second", lambda: {"value": np.array(2.0)}),
    ]
    reports: list[tuple[int, int, str]] = []

    def report(done: int, total: int, what: str) -> None:
        reports.append((done, total, what))
        if what == "second":
            gate.set()

    states = compute_states(tasks, report, jobs=2, executor=executor)
    assert [float(state["value"]) for state in states] == [1.0, 2.0]
    assert reports == [(0, 2, ""), (1, 2, "second"), (2, 2, "first")]


def test_run_leaves_nothing_if_the_figure_or_the_document_fails(tmp_path: Path) -> None:
    def draw(document: object) -> Figure:
        raise ZeroDivisionError

    tiny = Study("x", "X", {}, [], lambda states: StudyResult([{"a": 1}], []), lambda document: Figure())
    with pytest.raises(ZeroDivisionError):
        run(replace(tiny, draw=draw), tmp_path)
    unwritable = StudyResult([{"a": 1}], [], {"map": object()})
    with pytest.raises(TypeError, match="JSON"):
        run(replace(tiny, conclude=lambda states: unwritable), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["robustness", "nowhere.json"], "nowhere.json: no such file, and none of square, optimised, random-N"),
        (["robustness", "square", "square"], "another one is called square"),
        (["robustness", "square", "--presses", "1000"], "for '--presses': got 1000, allowed is a square number"),
        (["robustness", "square", "--failed", "6,9"], "fibre 9: no such fibre, allowed are 1 to 8"),
        (["scaling", "square", "--grids", "4,x"], "--grids is '4,x', expected numbers from 2 to 256"),
    ],
)
def test_invalid_study_command_fails_in_one_line(arguments: list[str], message: str, tmp_path: Path) -> None:
    assert message in refused("study", *arguments, "--out", "out", cwd=tmp_path)


@pytest.fixture
def studies(monkeypatch: pytest.MonkeyPatch) -> list[Study]:
    studies: list[Study] = []
    monkeypatch.setattr("padforge.sense.studies.study.run", lambda study, *_, **__: studies.append(study) or {})
    monkeypatch.setattr("padforge.sense.studies.study.study_lines", lambda document: [])
    return studies


@pytest.mark.parametrize("name", SMALLEST)
def test_seed_of_a_command_is_that_of_its_pads_and_of_its_study(name: str, studies: list[Study], tmp_path) -> None:
    assert called("study", name, "random-2@2", "--seed", "3", "--out", "out", cwd=tmp_path).code == 0
    assert studies[0].settings["seed"] == 3
    assert studies[0].settings["pads"] == describe_pads({"random-2@2": Morphology.random(2, 2, 3)})


@pytest.mark.parametrize("name", ["multicontact", "scaling"])
def test_study_takes_contact_scatter_and_pads_from_the_settings(name: str, studies: list[Study], tmp_path) -> None:
    """And is the paper's where they state no contact."""
    layer = "[contact]\ndepth_mm = 3\n[search]\nscatter = 0.1\n[pad]\ngrid = 3\npitch_mm = 8\n"
    for path, text in (("layer.toml", layer), ("paper.toml", "")):
        (tmp_path / path).write_text(text)
        assert called("study", name, "square", "--spec", path, "--out", "out", cwd=tmp_path).code == 0
    layer_settings, paper_settings = (study.settings for study in studies)
    assert (layer_settings["contact"]["model"], layer_settings["contact"]["depth_mm"]) == ("layer", 3)
    assert layer_settings["scatter"] == {"floor": 0.02, "share": 0.1, "common": 0.36}
    assert [layer_settings["pads"]["square"][key] for key in ("grid", "pitch_mm")] == [3, 8]
    assert layer_settings.get("grids", [3, 6, 12, 24, 48, 96]) == [3, 6, 12, 24, 48, 96]
    assert paper_settings["contact"] == PUBLISHED_CONTACT.model_dump(mode="json")
    assert (paper_settings["scatter"], paper_settings["pads"]["square"]["grid"]) == (None, 4)


def test_interrupted_study_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("padforge.sense.studies.study.compute_states", Mock(side_effect=KeyboardInterrupt))
    ended = called("study", "robustness", "square@2", "--presses", "16", "--out", "out", cwd=tmp_path)
    assert (ended.code, ended.err.splitlines()[-1]) == (130, "padforge: interrupted; nothing is written")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_load_pads_by_file_by_name_or_by_a_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    winding = Morphology.random(2, 3, 0)
    path = tmp_path / "mine" / "morphology.json"
    path.parent.mkdir()
    winding.save(path)
    assert load_pads(("square@3", "random-2@2", str(path)), seed=4) == {
        "square@3": Morphology.straight(3),
        "random-2@2": Morphology.random(2, 2, 4),
        "mine": winding,
    }
    layout = Layout.create((1, 2), 8.0)
    assert load_pads(("square", "random-2", "square@3"), 4, layout) == {
        "square": Morphology.straight(layout),
        "random-2": Morphology.random(layout, 2, 4),
        "square@3": Morphology.straight(3, 8.0),
    }
    requests = []

    def record(pad: PadSettings, contact: Contact, settings: SearchSettings) -> SearchResult:
        requests.append((pad.layout.horizontals, settings.method, settings.knots, settings.seed))
        return SearchResult(Morphology.straight(pad.grid), {}, [], "start 1", {})

    monkeypatch.setattr("padforge.design.optimize.search.search", record)
    names = ("optimised", "optimised-5", "genetic-1@2", "optimised-30@3")
    assert tuple(load_pads(names, seed=4)) == names
    assert requests == [(4, "descent", 21, 4), (4, "descent", 5, 4), (2, "genetic", 1, 4), (3, "descent", 30, 4)]


def test_read_counts_gives_whole_counts_up_to_full_scale_of_the_training() -> None:
    signals = np.array([[0.0, 0.5, 0.0], [0.25, 1.0, 0.0], [0.5, 0.5, 0.0], [0.75, 2.0, 0.0]])
    counts = read_counts(signals, 3, 0.0, np.random.default_rng(0))
    full = [ADC_STEPS, ADC_STEPS, 0]
    np.testing.assert_array_equal(counts, [[0, 2048, 0], [2048, ADC_STEPS, 0], [ADC_STEPS, 2048, 0], full])
    signed = read_counts(np.array([[-0.5, -2.0], [1.0, 0.0]]), 2, 0.0, np.random.default_rng(0))
    np.testing.assert_array_equal(signed, [[-2048, -ADC_STEPS], [ADC_STEPS, 0]])
    noisy = read_counts(np.repeat([0.5, 1.0], [4000, 1])[:, None], 4001, 4.0, np.random.default_rng(0))
    assert noisy[:-1].std() == pytest.approx(4, rel=0.1)
