"""Several contacts at once, in small: targets without an order localize pairs better, whichever comes first."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.design import Morphology, signals
from padforge.design.common.parallel import one_torch_thread
from padforge.sense.studies.multicontact import (
    COUNTING,
    LABELLED,
    METHODS,
    fit_pairs,
    moments,
    multicontact_study,
    pairs_from_moments,
    unordered_distances,
)
from padforge.sense.studies.study import Sizes, run

PAD = Morphology.random(4, 3, 0)
PADS = {"square": Morphology.straight(4), "random": PAD}
MAX_RATIO = 0.7  # largest error of targets without an order, as a share of that of fixed labels


@pytest.fixture
def pairs() -> np.ndarray:
    return np.random.default_rng(1).uniform(1, 4, (400, 2, 2))


@pytest.mark.slow
def test_study_localizes_pairs_better_without_an_order_and_counts_contacts(tmp_path: Path) -> None:
    document = run(multicontact_study(PADS, sizes=Sizes(1000, 300, hidden=20, members=2, epochs=15)), tmp_path)
    rows = {(row["pad"], row["method"]): row for row in document["rows"]}
    assert list(rows) == [(label, method) for label in PADS for method in [*METHODS, COUNTING]]
    for label, pad in PADS.items():
        labelled = rows[label, LABELLED]
        assert labelled["of_fixed_labels"] == 1
        assert labelled["error_mm"] <= labelled["error_by_labels_mm"]
        for method in ("free", "moments"):
            row = rows[label, method]
            assert 0 < row["error_grid"] < MAX_RATIO * labelled["error_grid"]
            assert pad.pitch_mm * row["error_grid"] == pytest.approx(row["error_mm"])
            assert row["error_mm"] < row["midpoint_error_mm"]
    located = [row for row in document["rows"] if row["method"] != COUNTING]
    for row, curve in zip(located, document["curves"], strict=True):
        assert (row["pad"], row["method"]) == (curve["pad"], curve["method"])
        assert np.mean(curve["error_mm"]) == pytest.approx(row["error_mm"], rel=0.05)
        if row["resolution_mm"] is not None:
            at = curve["distance_mm"].index(row["resolution_mm"])
            assert np.all(np.array(curve["error_mm"]) < np.array(curve["distance_mm"]) / 4, where=np.arange(16) >= at)
    for label, matrix in zip(PADS, document["confusions"], strict=True):
        row, counts = rows[label, COUNTING], np.array(matrix["counts"])
        assert (counts.shape, counts.sum()) == ((4, 4), 300)
        assert row["accuracy_percent"] == pytest.approx(100 * np.trace(counts) / 300)
        assert row["accuracy_percent"] > row["majority_percent"] + 30


def test_unordered_distances_and_moments_do_not_depend_on_the_order(pairs: np.ndarray) -> None:
    predicted = np.random.default_rng(2).uniform(1, 4, pairs.shape)
    errors = unordered_distances(predicted, pairs)
    np.testing.assert_allclose(unordered_distances(predicted[:, ::-1], pairs), errors)
    np.testing.assert_allclose(unordered_distances(predicted, pairs[:, ::-1]), errors)
    both = [np.linalg.norm(order - pairs, axis=2).mean(axis=1) for order in (predicted, predicted[:, ::-1])]
    np.testing.assert_allclose(errors, np.minimum(*both))
    np.testing.assert_array_equal(moments(pairs), moments(pairs[:, ::-1]))
    assert unordered_distances(pairs_from_moments(moments(pairs)), pairs).max() < 1e-7


@pytest.mark.parametrize("method", METHODS)
def test_fit_pairs_does_not_depend_on_the_order_except_for_fixed_labels(method: str, pairs: np.ndarray) -> None:
    inputs = signals(PAD, pairs)
    shuffled = np.where(np.random.default_rng(3).random((len(pairs), 1, 1)) < 0.5, pairs, pairs[:, ::-1])
    sizes = Sizes(len(pairs), 0, members=2, hidden=8, epochs=10)
    with one_torch_thread():
        first, second = (
            fit_pairs(METHODS[method], inputs, order, np.random.default_rng(0), sizes)(inputs)
            for order in (pairs, shuffled)
        )
    assert np.allclose(first, second, atol=1e-6) == (method != LABELLED)


def test_multicontact_study_errs_by_half_the_distance_where_it_predicts_the_midpoint_for_both() -> None:
    """Of pairs 1, 2, ... grid units apart; the free method predicts them exactly, but in the other order."""
    study = multicontact_study({"random": PAD})
    distance = np.arange(1.0, 33.0)
    pressed = np.zeros((32, 2, 2))
    pressed[:, 1, 0] = distance
    midpoint = np.repeat(pressed.mean(axis=1, keepdims=True), 2, axis=1)
    predicted = dict.fromkeys(METHODS, midpoint) | {"free": pressed[:, ::-1]}
    states = [{"pressed": pressed, "predicted": predicted[method]} for method in METHODS]
    counts = np.array([[5, 1, 0, 0], [0, 5, 0, 0], [0, 0, 9, 0], [0, 0, 5, 0]])
    result = study.conclude([*states, {"confusions": counts}])
    rows = {row["method"]: row for row in result.rows}
    half_mm = PAD.unit_mm * distance.mean() / 2
    for method in set(METHODS) - {"free"}:
        row = rows[method]
        assert (row["error_grid"], row["of_fixed_labels"]) == pytest.approx((distance.mean() / 2, 1.0))
        assert (row["error_mm"], row["midpoint_error_mm"]) == pytest.approx((half_mm, half_mm))
        assert row["resolution_mm"] is None
    assert rows[LABELLED]["error_by_labels_mm"] == pytest.approx(half_mm)
    free = rows["free"]
    assert (free["error_mm"], free["of_fixed_labels"]) == (0, 0)
    assert free["resolution_mm"] == pytest.approx(1.5 * PAD.unit_mm)  # the nearest two pairs of 32, in 16 groups
    assert rows[COUNTING]["accuracy_percent"] == pytest.approx(100 * 19 / 25)
    assert rows[COUNTING]["majority_percent"] == pytest.approx(100 * 9 / 25)
    curve = result.extra["curves"][0]
    assert curve["distance_mm"] == pytest.approx(PAD.unit_mm * (1.5 + 2 * np.arange(16)))
    assert curve["error_mm"] == pytest.approx(np.array(curve["distance_mm"]) / 2)
    assert f"{half_mm:.2f} mm; with the midpoint of the two for both it would be {half_mm:.2f} mm" in result.text[1]


def test_figure_has_errors_by_method_and_distance_and_the_number_of_contacts() -> None:
    methods = list(METHODS)
    pads = ("a", "b")
    rows = [
        {"pad": pad, "method": method, "error_mm": 10.0 * number + column}
        for column, pad in enumerate(pads)
        for number, method in enumerate(methods)
    ]
    curves = [
        {"pad": pad, "method": method, "distance_mm": [4.0, 8.0], "error_mm": [1.0 + number, 2.0 + number]}
        for pad in pads
        for number, method in enumerate(methods)
    ]
    confusions = [{"pad": "a", "counts": [[3, 1], [0, 4]]}, {"pad": "b", "counts": [[1, 1], [1, 1]]}]
    settings = {"pads": {pad: {} for pad in pads}, "test": 8, "max_contacts": 2}
    document = {"settings": settings, "rows": rows, "curves": curves, "confusions": confusions}
    figure: Any = multicontact_study({"a": PAD}).draw(document)
    bars, first, numbers, second, others = figure.axes
    assert [patch.get_height() for patch in bars.patches] == [row["error_mm"] for row in sorted(rows, key=by_method)]
    assert [text.get_text() for text in bars.get_legend().get_texts()] == methods
    assert [text.get_text() for text in bars.get_xticklabels()] == ["a", "b"]
    assert bars.get_ylabel() == "mean error, two contacts (mm)"
    middles = [patch.get_x() + patch.get_width() / 2 for patch in bars.patches]
    assert np.diff(middles[::2]) == pytest.approx(0.8 / len(methods))
    assert np.mean(middles) == pytest.approx(0.5)
    for axes, label in ((first, "a"), (second, "b")):
        *drawn, midpoint, quarter = [line.get_xydata().tolist() for line in axes.lines]
        assert drawn == [[[4, 1 + number], [8, 2 + number]] for number in range(len(methods))]
        assert (midpoint, quarter) == ([[0, 0], [8, 4]], [[0, 0], [8, 2]])
        assert [text.get_text() for text in axes.get_legend().get_texts()] == [
            "midpoint for both",
            "a quarter of the distance",
        ]
        assert axes.get_title("left") == label
        assert axes.get_xlabel() == "distance of the two contacts (mm)"
    assert [axes.get_ylabel() for axes in (first, second)] == ["mean error (mm)", ""]
    assert [axes.get_title("left") for axes in (numbers, others)] == ["number: 88 % correct", "number: 50 % correct"]
    assert (numbers.get_xlabel(), numbers.get_ylabel()) == ("contacts predicted", "contacts pressed")
    assert figure.get_suptitle() == "8 presses never trained on: positions of two contacts, number of up to 2"


def by_method(row: dict) -> int:
    return list(METHODS).index(row["method"])
