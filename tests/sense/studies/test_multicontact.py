"""Several contacts at once, in small: pairs without an order are found better, and as well whichever is named first."""

import numpy as np
import pytest

from padforge.design import Morphology, signals
from padforge.design.common.parallel import one_torch_thread
from padforge.sense.studies.multicontact import (
    COUNTED,
    LABELLED,
    WAYS,
    learnt,
    moments,
    multicontact_study,
    pairs_of_moments,
    unordered_distances,
)
from padforge.sense.studies.study import run

PAD = Morphology.random(4, 3, 0)
PADS = {"square": Morphology.straight(4), "random": PAD}
BAR = 0.7
"""Of the error of fixed labels, what that of a free order may be at most."""


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict:
    study = multicontact_study(PADS, presses=1000, test=300, hidden=20, members=2, epochs=15)
    return run(study, tmp_path_factory.mktemp("multicontact"))


@pytest.fixture
def places() -> np.ndarray:
    return np.random.default_rng(1).uniform(1, 4, (400, 2, 2))


@pytest.mark.slow
def test_pairs_without_an_order_are_found_better_than_those_of_fixed_labels_and_are_counted(document: dict) -> None:
    rows = {(row["pad"], row["way"]): row for row in document["rows"]}
    assert list(rows) == [(label, way) for label in PADS for way in [*WAYS, COUNTED]]
    assert len({tuple(row) for row in document["rows"]}) == 1
    for label, pad in PADS.items():
        labelled = rows[label, LABELLED]
        assert labelled["of_fixed_labels"] == 1
        assert labelled["error_mm"] <= labelled["error_by_labels_mm"]
        for way in ("free", "moments"):
            row = rows[label, way]
            assert 0 < row["error_grid"] < BAR * labelled["error_grid"]
            assert row["of_fixed_labels"] == pytest.approx(row["error_grid"] / labelled["error_grid"])
            assert row["error_mm"] == pytest.approx(pad.pitch_mm * row["error_grid"])
            assert row["error_mm"] < row["midpoint_named_mm"]
            assert row["error_by_labels_mm"] is None
    located = [row for row in document["rows"] if row["way"] != COUNTED]
    for row, curve in zip(located, document["curves"], strict=True):
        assert (row["pad"], row["way"]) == (curve["pad"], curve["way"])
        assert curve["apart_mm"] == sorted(curve["apart_mm"])
        assert np.mean(curve["error_mm"]) == pytest.approx(row["error_mm"], rel=0.05)
        assert np.mean(curve["apart_mm"]) / 2 == pytest.approx(row["midpoint_named_mm"], rel=0.05)
        if row["told_apart_from_mm"] is not None:
            at = curve["apart_mm"].index(row["told_apart_from_mm"])
            assert np.all(np.array(curve["error_mm"]) < np.array(curve["apart_mm"]) / 4, where=np.arange(16) >= at)
    counted = [row for row in document["rows"] if row["way"] == COUNTED]
    for row, each in zip(counted, document["confusions"], strict=True):
        counts = np.array(each["counts"])
        assert counts.shape == (4, 4)
        assert counts.sum() == 300
        assert row["accuracy_percent"] == pytest.approx(100 * np.trace(counts) / 300)
        assert row["accuracy_percent"] > row["guessed_percent"] + 30
        assert row["error_mm"] is None


def test_errors_and_moments_do_not_depend_on_which_contact_is_named_first(places: np.ndarray) -> None:
    found = np.random.default_rng(2).uniform(1, 4, places.shape)
    off = unordered_distances(found, places)
    np.testing.assert_allclose(unordered_distances(found[:, ::-1], places), off)
    np.testing.assert_allclose(unordered_distances(found, places[:, ::-1]), off)
    as_named = [np.linalg.norm(each - places, axis=2).mean(axis=1) for each in (found, found[:, ::-1])]
    np.testing.assert_allclose(off, np.minimum(*as_named))
    np.testing.assert_array_equal(moments(places), moments(places[:, ::-1]))
    assert unordered_distances(pairs_of_moments(moments(places)), places).max() < 1e-7


@pytest.mark.parametrize("way", WAYS)
def test_what_is_learnt_without_an_order_does_not_depend_on_it(way: str, places: np.ndarray) -> None:
    given = signals(PAD, places)
    turned = np.where(np.random.default_rng(3).random((len(places), 1, 1)) < 0.5, places, places[:, ::-1])
    with one_torch_thread():
        found, again = (
            learnt(WAYS[way], given, each, np.random.default_rng(0), members=2, hidden=8, epochs=10)(given)
            for each in (places, turned)
        )
    assert np.allclose(found, again, atol=1e-6) == (way != LABELLED)
