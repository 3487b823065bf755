"""The study of robustness, and its files."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.design.published.networks import SimulatedPresses
from padforge.sense.studies import robustness
from padforge.sense.studies.robustness import MIN_NETWORKS, robustness_study
from padforge.sense.studies.study import load_pads, run
from tests.helpers.constants import with_constants
from tests.sense.conftest import blank_pictures

PADS = {"square": Morphology.straight(2), "random": Morphology.random(2, 3, 0)}

small = with_constants((robustness, {"HIDDEN": 8, "TEST": 150, "MIN_NETWORKS": 4}))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("robustness")
    with blank_pictures():
        return folder, run(robustness_study(PADS, max_failures=2, presses=144), folder)


def select_rows(document: dict, **values) -> list[dict]:
    return [row for row in document["rows"] if values.items() <= row.items()]


def test_study_evaluates_every_set_of_failed_fibres(results: tuple[Path, dict]) -> None:
    document = results[1]
    assert [(row["pad"], row["n_failed"], row["subsets"]) for row in document["rows"]] == [
        (pad, n_failed, sets) for pad in PADS for n_failed, sets in ((0, 1), (1, 4), (2, 6))
    ]
    for pad in PADS:
        intact, one, two = select_rows(document, pad=pad)
        assert intact["mean"] < one["mean"] < two["mean"] <= two["max"]
        assert intact["mean_mm"] == pytest.approx(11.25 * intact["mean"])
        by_subset = [row for row in document["by_subset"] if row["pad"] == pad and len(row["failed"]) == 2]
        assert two["mean"] == pytest.approx(np.mean([row["mean"] for row in by_subset]))
        worst = max(by_subset, key=lambda row: row["mean"])
        assert [panel["failed"] for panel in document["maps"] if panel["pad"] == pad][2] == worst["failed"]
    # without both horizontal fibres the height is unknown
    assert select_rows(document, pad="square", n_failed=2)[0]["max"] > 0.2


@pytest.mark.slow
def test_study_reproduces_published_errors(published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean errors with all fibres and with one failed, measured by others with the same protocol."""
    for name, value in (("MIN_NETWORKS", 4), ("HIDDEN", 50), ("TEST", 2000)):
        monkeypatch.setattr(robustness, name, value)
    expected = {"square_grid_cir": (0.217, 0.216), "5para_dis": (0.065, 0.099), "20para": (0.056, 0.080)}
    pads = load_pads(tuple(str(published / f"{name}.mat") for name in expected), 0)
    document = run(robustness_study(pads, max_failures=1), tmp_path)
    for name, errors in expected.items():
        assert [row["mean"] for row in select_rows(document, pad=name)] == pytest.approx(errors, rel=0.15)


@pytest.mark.usefixtures("blank")
def test_study_of_a_pad_without_signals_guesses_the_middle(tmp_path: Path) -> None:
    document = run(robustness_study(PADS, max_failures=1, presses=16, contact=Contact(radius=1e-6)), tmp_path)
    assert all(0.3 < row["mean"] < 0.5 for row in document["rows"])


@pytest.mark.usefixtures("blank")
def test_every_mean_is_over_sixteen_networks_or_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One set of failed fibres takes 16, four take 4 each, and six 3."""
    fit, trained = SimulatedPresses.fit, Counter[tuple[int, ...]]()

    def counted(presses: SimulatedPresses, failures: list, hidden: int, repeat: int = 0) -> list:
        trained.update(failures)
        return fit(presses, failures, hidden, repeat)

    monkeypatch.setattr(SimulatedPresses, "fit", counted)
    monkeypatch.setattr(robustness, "HIDDEN", 1)
    monkeypatch.setattr(robustness, "MIN_NETWORKS", MIN_NETWORKS)
    document = run(robustness_study({"a": PADS["square"]}, max_failures=2, presses=16), tmp_path)
    by_size = {size: {count for failed, count in trained.items() if len(failed) == size} for size in range(3)}
    assert by_size == {0: {16}, 1: {4}, 2: {3}}
    assert [row["of"] for row in document["rows"]] == [1, 4, 6]
