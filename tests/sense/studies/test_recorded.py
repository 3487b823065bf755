"""Studies of a recording: fibre loss, with one test for both methods, and learning curves."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense import Recording, evaluate
from padforge.sense.localizer import response_model, training
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.settings import LocalizerSettings
from padforge.sense.settings import LocalizerSettings as Options
from padforge.sense.studies import learning_curve as study
from padforge.sense.studies.fibre_loss import ONE, RETRAINED, MethodErrors, fibre_loss_study, train_without
from padforge.sense.studies.learning_curve import fit_power_law, learning_curve, power_law
from tests.helpers.constants import with_constants
from tests.helpers.door import called
from tests.helpers.golden import json_text
from tests.helpers.presses import changed

# a published network of three neurons, a coarse response model and few resamplings, which are not what is tested
coarse = training, {"PUBLISHED_HIDDEN": 3}
quick = with_constants(coarse, (response_model, {"RBF_SIDE": 7}), (study, {"RESAMPLINGS": 20}))


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
    def retrain(recording: Recording) -> MethodErrors:
        return fibre_loss_study(recording, retrain=True, max_failures=1).methods[RETRAINED]

    plain = retrain(recording)
    noise = np.random.default_rng(1).uniform(0, 3, len(recording.readings))
    noisy = retrain(changed(recording, "readings", np.s_[:, 2], noise))
    for each, other in zip(plain.by_subset, noisy.by_subset, strict=True):
        assert (each["mean_mm"] == other["mean_mm"]) == (each["failed"] == [2])
    test = np.sort(np.random.default_rng(0).permutation(300)[-45:])
    # a network trained on one of them would predict far positions
    moved = retrain(changed(recording, "presses_mm", test, 2e4))
    centre = np.hypot(*(2e4 - recording.presses_mm[test]).T).mean()
    assert moved.errors[0]["mean_mm"] == pytest.approx(centre, abs=30)


def test_retrained_networks_follow_the_seed(brief: Recording) -> None:
    training, test, seeds = np.arange(30), np.arange(30, 40), (0, 0, 1)
    options = [LocalizerSettings(method="published", split="chronological", seed=seed) for seed in seeds]
    first, same, other = (train_without((1,), brief, training, test, each)["positions_mm"] for each in options)
    assert (np.array_equal(first, same), np.array_equal(first, other)) == (True, False)


def test_fibre_loss_writes_document_and_figure(localizer: LocalizerModel, recording: Recording, tmp_path: Path) -> None:
    localizer.save(tmp_path / "model")
    recording.save(tmp_path / "rec", {})
    options = "--model model --max-failures 1 --failed 2,4 --out out --json"
    ended = called("sense", "fibre-loss", "rec", *options.split(), cwd=tmp_path)
    assert (ended.code, json.loads(ended.out)["methods"][ONE]["maps"][-1]["failed"]) == (0, [1, 3])
    assert json.loads(ended.out) == json.loads((tmp_path / "out/fibre_loss.json").read_text())
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["fibre_loss.json", "fibre_loss.png"]


QUICK = Options(hidden=8, layers=1, epochs=1, batch=64, max_failures=0)


@settings(max_examples=20)
@given(floor=st.floats(0, 2), factor=st.floats(0.5, 100), exponent=st.sampled_from([0.2, 0.4, 0.5, 0.75, 1.0]))
def test_fit_power_law_recovers_power_laws(floor: float, factor: float, exponent: float) -> None:
    presses = np.array([50.0, 100, 200, 400, 800])
    target, true = np.array([1600.0]), (floor, factor, exponent)
    forecast = power_law(target, fit_power_law(presses, power_law(presses, true)))
    np.testing.assert_allclose(forecast, power_law(target, true), rtol=1e-3)


class Trained:
    """Stands in for a localizer of n presses, which errs by 1 + 8 / sqrt(n) mm, by press more or less."""

    def __init__(self, recording: Recording, training: np.ndarray, *_: object) -> None:
        self.presses_mm, self.n = recording.presses_mm, len(training)

    def scaled_features(self, recording: Recording) -> np.ndarray:
        return np.arange(len(recording.presses_mm))

    def predict_features(self, rows: np.ndarray) -> Any:
        error_mm = (1 + 8 / np.sqrt(self.n)) * (1 + np.sin(rows * self.n) / 2)
        return SimpleNamespace(positions_mm=self.presses_mm[rows] + np.column_stack([error_mm, 0 * error_mm]))


def test_learning_curve_command_writes_document_and_figure(recording: Recording, golden, tmp_path, monkeypatch) -> None:
    """Errors are those of the test presses alone, and the interval is that of 80 % of the resamplings."""
    monkeypatch.setattr(study, "fit_recording", Trained)
    recording.save(tmp_path / "rec", {})
    ended = called("sense", "learning-curve", "rec", "--out", "out", "--json", cwd=tmp_path)
    document = json.loads(ended.out)
    assert (ended.code, document) == (0, json.loads((tmp_path / "out/learning_curve.json").read_text()))
    assert (tmp_path / "out/learning_curve.png").read_bytes()[:4] == b"\x89PNG"
    assert document.pop("provenance")["inputs"] == {"recording": recording.digest}
    golden("studies/learning_curve.json", json_text(document))
    for point in document["points"]:
        assert point["mean_mm"] == pytest.approx(1 + 8 / np.sqrt(point["presses"]), rel=0.15)


def test_interrupt_ends_a_learning_curve_at_once(recording: Recording) -> None:
    long, shares = QUICK.model_copy(update={"epochs": 1000}), []

    def interrupt(done: int, total: int, what: str) -> None:
        shares.append(done / total)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learning_curve(recording, long, on_progress=interrupt)
    assert max(shares) < 0.5
