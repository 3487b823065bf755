"""Fibre loss: one test for both methods."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.sense import Recording, evaluate
from padforge.sense.localizer import response_model, training
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.settings import LocalizerSettings
from padforge.sense.studies.fibre_loss import ONE, RETRAINED, MethodErrors, fibre_loss_study, train_without
from tests.helpers.constants import with_constants
from tests.helpers.door import called

# a published network of three neurons, and a coarse response model, which are not what is tested
quick = with_constants((training, {"PUBLISHED_HIDDEN": 3}), (response_model, {"RBF_SIDE": 7}))


def test_study_compares_both_methods_and_maps_a_chosen_set(localizer: LocalizerModel, recording: Recording) -> None:
    expected = evaluate(localizer, recording, (0, 1, 2))
    options = LocalizerSettings(split="chronological")  # of what is retrained; the test is that of the localizer
    result = fibre_loss_study(recording, localizer, retrain=True, options=options, max_failures=1, failed=(3, 1, 3))
    assert (result.split, list(result.methods)) == ("random", [ONE, RETRAINED])
    for method in result.methods.values():
        assert [row["subsets"] for row in method.errors] == [1, 4]
        assert [row["failed"] for row in method.by_subset] == [[], [0], [1], [2], [3]]
        intact, worst, chosen = method.maps
        assert (intact["failed"], chosen["failed"]) == ([], [1, 3])
        assert worst["failed"] == max(method.by_subset[1:], key=lambda row: row["mean_mm"])["failed"]
    assert result.test_presses == expected.test_presses == len(localizer.test)
    assert result.training_presses == 300 - len(localizer.test)
    one = result.methods[ONE]
    assert one.errors == expected.errors[:2]
    assert one.by_subset == expected.by_subset[:5]
    assert one.maps[0]["by_position"] == expected.by_position
    (mean_mm,) = (row["mean_mm"] for row in expected.by_subset if row["failed"] == [1, 3])
    cells = one.maps[-1]["by_position"]
    mean_of_map_mm = np.average([cell["mean_mm"] for cell in cells], weights=[cell["presses"] for cell in cells])
    assert mean_of_map_mm == pytest.approx(mean_mm)


def test_retraining_ignores_failed_fibres_and_test_positions(recording: Recording) -> None:
    def retrain(changed: Recording) -> MethodErrors:
        return fibre_loss_study(changed, retrain=True, max_failures=1).methods[RETRAINED]

    plain = retrain(recording)
    readings = recording.readings.copy()
    readings[:, 2] = np.random.default_rng(1).uniform(0, 3, len(readings))
    noisy = retrain(replace(recording, readings=readings))
    for each, other in zip(plain.by_subset, noisy.by_subset, strict=True):
        assert (each["mean_mm"] == other["mean_mm"]) == (each["failed"] == [2])
    test = np.sort(np.random.default_rng(0).permutation(300)[-45:])
    far = recording.presses_mm.copy()
    far[test] = 2e4  # a network trained on one of them would predict far positions
    moved = retrain(replace(recording, presses_mm=far))
    centre = np.hypot(*(2e4 - recording.presses_mm[test]).T).mean()
    assert moved.errors[0]["mean_mm"] == pytest.approx(centre, abs=30)


def test_retrained_networks_follow_the_seed(brief: Recording) -> None:
    training, test, seeds = np.arange(30), np.arange(30, 40), (0, 0, 1)
    options = [LocalizerSettings(method="published", split="chronological", seed=seed) for seed in seeds]
    first, same, other = (train_without((1,), brief, training, test, each)["positions_mm"] for each in options)
    assert (np.array_equal(first, same), np.array_equal(first, other)) == (True, False)


def test_fibre_loss_command_writes_document_and_figure(
    localizer: LocalizerModel, recording: Recording, tmp_path: Path
) -> None:
    localizer.save(tmp_path / "model")
    recording.save(tmp_path / "rec", {})
    options = "--model model --max-failures 1 --failed 2,4 --out out --json"
    ended = called("sense", "fibre-loss", "rec", *options.split(), cwd=tmp_path)
    assert (ended.code, json.loads(ended.out)["methods"][ONE]["maps"][-1]["failed"]) == (0, [1, 3])
    assert json.loads(ended.out) == json.loads((tmp_path / "out/fibre_loss.json").read_text())
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["fibre_loss.json", "fibre_loss.png"]
