"""Several contacts at once, in small: targets without an order localize pairs better, whichever comes first."""

from pathlib import Path

import numpy as np
import pytest

from padforge.common.parallel import one_thread
from padforge.design import Morphology, signals
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
MAX_RATIO = 0.7  # largest error of targets without an order, as a share of that of fixed labels


@pytest.mark.slow
def test_study_localizes_pairs_better_without_an_order_and_counts_contacts(tmp_path: Path) -> None:
    sizes = Sizes(1000, 300, hidden=20, members=2, epochs=15)
    document = run(multicontact_study({"random": PAD}, sizes=sizes), tmp_path)
    rows = {row["method"]: row for row in document["rows"]}
    assert list(rows) == [*METHODS, COUNTING]
    labelled = rows[LABELLED]
    assert labelled["error_mm"] <= labelled["error_by_labels_mm"]
    for method in ("free", "moments"):
        assert 0 < rows[method]["error_grid"] < MAX_RATIO * labelled["error_grid"]
        assert rows[method]["error_mm"] < rows[method]["midpoint_error_mm"]
    assert rows[COUNTING]["accuracy_percent"] > rows[COUNTING]["majority_percent"] + 30


def test_unordered_distances_and_moments_do_not_depend_on_the_order() -> None:
    pairs = np.random.default_rng(1).uniform(1, 4, (400, 2, 2))
    predicted = np.random.default_rng(2).uniform(1, 4, pairs.shape)
    errors = unordered_distances(predicted, pairs)
    np.testing.assert_allclose(unordered_distances(predicted[:, ::-1], pairs), errors)
    np.testing.assert_allclose(unordered_distances(predicted, pairs[:, ::-1]), errors)
    both = [np.linalg.norm(order - pairs, axis=2).mean(axis=1) for order in (predicted, predicted[:, ::-1])]
    np.testing.assert_allclose(errors, np.minimum(*both))
    np.testing.assert_array_equal(moments(pairs), moments(pairs[:, ::-1]))
    assert unordered_distances(pairs_from_moments(moments(pairs)), pairs).max() < 1e-7


@pytest.mark.parametrize("method", METHODS)
def test_fit_pairs_does_not_depend_on_the_order_except_for_fixed_labels(method: str) -> None:
    pairs = np.random.default_rng(1).uniform(1, 4, (60, 2, 2))
    inputs = signals(PAD, pairs)
    shuffled = np.where(np.random.default_rng(3).random((len(pairs), 1, 1)) < 0.5, pairs, pairs[:, ::-1])
    sizes = Sizes(len(pairs), 0, members=2, hidden=4, epochs=3)
    with one_thread():
        first, second = (
            fit_pairs(METHODS[method], inputs, order, np.random.default_rng(0), sizes)(inputs)
            for order in (pairs, shuffled)
        )
    assert np.allclose(first, second, atol=1e-6) == (method != LABELLED)
