"""The estimator, also in scikit-learn; and held-out presses, which teach nothing: nonsense there changes no bit."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock, patch

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import KFold, cross_val_predict, cross_val_score
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline

from padforge.sense import Localizer, PressWindows, Recording, calibrate, recalibrate
from padforge.sense.health import health_model, trace_model
from padforge.sense.health.fault_detector import HEALTH_FILES
from padforge.sense.localizer import recalibration, single_press, training
from padforge.sense.localizer.evaluation import distances
from padforge.sense.localizer.features import PressFeatures, compute_features
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import PRESS_WINDOWS
from padforge.sense.report import calibration
from padforge.sense.settings import LocalizerSettings
from padforge.sense.twin import identification as twin_identification
from padforge.sense.twin.as_built import AsBuiltPad
from padforge.sense.twin.fitting import AsBuiltFit, fit_as_built
from padforge.sense.twin.identification import Identification
from padforge.sense.twin.responses import Responses
from tests.helpers.rigs import ideal_rig
from tests.sense.conftest import few_candidates, few_moments, first_presses, identify_simulated

SMALL: dict[str, Any] = {"hidden": 16, "layers": 1, "epochs": 3, "batch": 64}


def test_localizer_of_arrays_scores_in_cross_validation(recording: Recording, tmp_path: Path) -> None:
    features = compute_features(recording.readings, recording.down_command, recording.up_command)
    x, y = features.windows[:, :, : len(PRESS_WINDOWS)], recording.presses_mm
    localizer = Localizer(max_failures=1, random_state=3, **SMALL)
    [score] = cross_val_score(localizer, x, y, cv=[(np.arange(200), np.arange(200, 300))])
    assert -np.hypot(*(y - np.median(y, axis=0)).T).mean() < score < 0
    fitted = localizer.fit(x[:200], y[:200])
    errors = np.hypot(*(fitted.predict(x[200:]).positions_mm - y[200:]).T)
    assert score == fitted.score(x[200:], y[200:]) == pytest.approx(-errors.mean())
    assert np.median(fitted.predict(x[200:], failed=[1]).r90_mm) > np.median(fitted.predict(x[200:]).r90_mm)
    missing = x[200:].copy()
    missing[:, 1] = np.nan
    assert np.array_equal(fitted.predict(missing).positions_mm, fitted.predict(x[200:], [1]).positions_mm)
    fitted.save(tmp_path)
    assert np.array_equal(Localizer.load(tmp_path).predict(x).positions_mm, fitted.predict(x).positions_mm)
    assert cast("Localizer", clone(fitted)).get_params() == fitted.get_params()


@few_moments()
def test_localizer_fits_evaluates_and_keeps_a_recording(brief: Recording, tmp_path: Path) -> None:
    localizer = Localizer(2, split="chronological", **SMALL).fit(brief)
    assert set(localizer.test_presses_) == set(localizer.model_.test)
    evaluation = localizer.evaluate(brief)
    assert evaluation.errors == localizer.calibration_.errors
    assert localizer.evaluate(brief, max_failures=0).errors == evaluation.errors[:1]
    table = evaluation.to_frame()
    assert table["n_failed"].tolist() == [0, 1, 2]
    assert table["mean_mm"].tolist() == [row["mean_mm"] for row in evaluation.errors]
    assert localizer.score(brief) < 0
    localizer.save(tmp_path)
    again = Localizer.load(tmp_path)
    assert np.array_equal(again.predict(brief, [0]).r90_mm, localizer.predict(brief, [0]).r90_mm)
    assert repr(again) == "Localizer(max_failures=2, split='chronological')"
    some = brief[10:40][[3, 5]]  # which are predicted as among all
    whole = localizer.predict(brief).positions_mm[[13, 15]]
    np.testing.assert_allclose(localizer.predict(some).positions_mm, whole, atol=1e-5)


@few_moments()
def test_localizer_and_any_regressor_are_cross_validated_on_a_recording(recording: Recording) -> None:
    localizer = Localizer(members=2, max_failures=1, **SMALL | {"hidden": 8, "epochs": 1})
    assert (cross_val_score(localizer, first_presses(recording, 120), cv=KFold(2)) > -4).all()
    pipeline = make_pipeline(PressWindows(), KNeighborsRegressor())
    predicted = cross_val_predict(pipeline, recording, recording.presses_mm, cv=KFold(2))
    guess = np.abs(recording.presses_mm - recording.presses_mm.mean(axis=0)).mean()
    assert distances(np.asarray(predicted), recording.presses_mm).mean() < 0.5 * guess


def test_estimators_have_settings_as_params_print_what_differs_and_are_cloned() -> None:
    settings = LocalizerSettings(members=3, seed=7, method="published")
    localizer = Localizer.from_settings(settings)
    assert localizer.get_params() == {**settings.model_dump(exclude={"seed"}), "random_state": 7}
    assert localizer.set_params(hidden=9).get_params()["hidden"] == 9
    assert repr(Localizer()) == "Localizer()"
    assert repr(clone(Localizer(hidden=16, max_failures=1))) == "Localizer(max_failures=1, hidden=16)"
    assert repr(clone(PressWindows())) == "PressWindows()"


TINY = LocalizerSettings(
    members=2, hidden=16, layers=1, epochs=1, batch=64, max_failures=1, split="chronological", test_share=0.2
)
RADII = 3  # last presses of a training of 32, which calibrate the uncertainty


def without_sense(recording: Recording, first: int) -> Recording:
    """Positions and depths from a press on, readings from the next one on, are nonsense: its touch ends one before."""
    readings, places = np.array(recording.readings), np.array(recording.presses_mm)
    places[first:] = 40.0 - places[first:] / 3
    depths_mm, forces_n = (np.array(each) for each in (recording.depths_mm, recording.forces_n))
    depths_mm[first:], forces_n[first:] = 77.0, np.nan
    start = recording.down_command[first + 1]
    readings[start:] = np.random.default_rng(0).uniform(0, 3.3, readings[start:].shape)
    return replace(recording, readings=readings, presses_mm=places, depths_mm=depths_mm, forces_n=forces_n)


def learnt(model: LocalizerModel, changing: tuple[str, ...] = ()) -> dict[str, bytes]:
    """The bytes of all arrays of a localizer, but for those whose names end as said."""
    arrays: dict[str, Any] = {
        "table": model.table,
        "interval_factors": model.interval_factors,
        **{f"scaler.{name}": value for name, value in vars(model.scaler).items()},
        **{f"{name}.{part}": array for name, weights in model.networks.items() for part, array in weights.items()},
        **{f"residual.{part}": array for part, array in model.residual_network.items()},
        **{f"bayes.{n}.{part}": array for n, each in enumerate(model.bayes) for part, array in vars(each).items()},
        **{f"test.{n}.{part}": each for n, test in enumerate(model.single_press) for part, each in vars(test).items()},
    }
    return {
        name: array.tobytes() if isinstance(array, np.ndarray) else repr(array).encode()
        for name, array in arrays.items()
        if not name.endswith(changing)
    }


def test_calibration_learns_nothing_from_its_test_nor_networks_from_presses_of_radii(brief: Recording) -> None:
    def fit(recording: Recording, **changes: Any) -> LocalizerModel:
        with few_moments():
            return calibrate(recording, TINY.model_copy(update=changes), by_moment=False)[0]

    plain = fit(brief)
    assert plain.test == tuple(range(32, 40))
    assert learnt(fit(without_sense(brief, 32))) == learnt(plain)
    # the scale of expected errors, radii and what is usual of a single press are those of the last presses before
    of_radii = ("last.b", "interval_factors", ".limit", ".usual_misfit")
    other = fit(without_sense(brief, 32 - RADII))
    assert learnt(other, of_radii) == learnt(plain, of_radii)
    for name, weights in plain.networks.items():  # of which positions are no part
        places = slice(0, weights["last.b"].shape[2] // 2)
        assert np.array_equal(other.networks[name]["last.b"][:, :, places], weights["last.b"][:, :, places])
    assert not np.array_equal(other.interval_factors, plain.interval_factors)
    assert learnt(fit(brief, seed=7))["pressed.first.w"] != learnt(plain)["pressed.first.w"]
    # the published training stops by presses that are not those of radii either
    stopped, other = (fit(each, method="published") for each in (brief, without_sense(brief, 32 - RADII)))
    assert learnt(other, of_radii[1:]) == learnt(stopped, of_radii[1:])
    assert not np.array_equal(other.interval_factors, stopped.interval_factors)


def test_calibration_learns_no_depth_from_its_test(deep_recording: Recording) -> None:
    """Nor whether depth and force are learnt, which takes all of them; the errors are of the test."""
    names = "presses_mm", "down_command", "up_command", "depths_mm", "forces_n"
    known = replace(deep_recording, **{name: getattr(deep_recording, name)[:50] for name in names})
    with few_moments():
        (plain, errors), (spoilt, other) = (
            calibrate(each, TINY, by_moment=False) for each in (known, without_sense(known, 40))
        )
    assert [measure.name for measure in plain.scaler.measures] == ["depth_mm", "force_n"]
    assert learnt(spoilt) == learnt(plain)
    assert errors.errors[0]["depth_mean_mm"] < 5 < other.errors[0]["depth_mean_mm"]


def test_cross_validated_localizer_learns_nothing_from_other_presses(brief: Recording) -> None:
    """Of a recording, of which those of a fold are selected as scikit-learn does it; another seed learns otherwise."""
    params, spoilt = TINY.model_dump(exclude={"seed"}), without_sense(brief, 30)
    plain, same, other = (
        Localizer(random_state=seed, **params).fit(each[np.arange(30)])
        for seed, each in ((0, brief), (0, spoilt), (7, brief))
    )
    assert learnt(same.model_) == learnt(plain.model_)
    assert learnt(other.model_)["pressed.first.w"] != learnt(plain.model_)["pressed.first.w"]
    assert plain.test_presses_.size == 0
    assert plain.score(brief[np.arange(30, 40)]) < 0


@patch.object(recalibration, "FOLDS", 2)
@patch.object(single_press, "SUBSETS", 1)
@patch.object(training, "RETRAINING_STEPS", 1)
def test_folds_are_predicted_by_models_of_others(localizer: LocalizerModel, recording: Recording, monkeypatch) -> None:
    few = first_presses(recording, 24)
    model = replace(localizer, interval_factors=localizer.interval_factors[:, :1])
    features, predict = LocalizerModel.raw_features, recalibration.CrossValidation.predict

    def models_of(spoilt: Recording, rows: np.ndarray) -> list[list[LocalizerModel]]:
        """The models of each comparison, fold by fold, where readings of some presses are nonsense as well."""
        seen: list[list[LocalizerModel]] = []

        def raw_features(model: LocalizerModel, recording: Recording, until: Any = None) -> PressFeatures:
            found = features(model, recording, until)
            windows = np.array(found.windows)
            windows[rows] = np.random.default_rng(1).uniform(-1, 1, windows[rows].shape)
            return replace(found, windows=windows)

        def spy(validation: Any, models: list[LocalizerModel]) -> Any:
            seen.append(models)
            if len(seen) == 3:  # as it was, corrected, and refitted
                raise InterruptedError
            return predict(validation, models)

        monkeypatch.setattr(LocalizerModel, "raw_features", raw_features)
        monkeypatch.setattr(recalibration.CrossValidation, "predict", spy)
        with pytest.raises(InterruptedError):
            recalibrate(model, spoilt)
        return seen

    order = np.random.default_rng(0).permutation(24)  # as recalibrate draws its folds from seed 0
    first = order[:12]
    places = np.array(few.presses_mm)
    places[first] = -places[first][::-1]
    plain, spoilt = models_of(few, np.empty(0, int)), models_of(replace(few, presses_mm=places), first)
    for number in range(3):
        assert learnt(plain[number][0]) == learnt(spoilt[number][0])
    for number in (1, 2):
        assert learnt(plain[number][1]) != learnt(spoilt[number][1])


@patch.object(trace_model, "MAX_STEPS", 2)
@patch.object(health_model, "MIN_PRESSES", 100)
@patch.object(calibration, "calibration_provenance", lambda *_: {})
def test_health_ignores_held_out(recording: Recording, localizer: LocalizerModel, tmp_path, monkeypatch) -> None:
    """By a localizer, beside which health is learnt."""
    calibrated = replace(localizer, test=tuple(range(120, 130))), Mock(to_dict=dict)
    monkeypatch.setattr(calibration, "calibrate", lambda *_, **__: calibrated)
    known, last = first_presses(recording, 130), LocalizerSettings(split="chronological", test_share=10 / 130)
    for name, each in (("plain", known), ("spoilt", without_sense(known, 120))):
        calibration.calibrate_into(each, tmp_path / name, last, without=("figures",))
    for file in HEALTH_FILES:
        assert (tmp_path / "plain" / file).read_bytes() == (tmp_path / "spoilt" / file).read_bytes()


def test_twin_learns_nothing_from_presses_held_out(identification: Identification, monkeypatch) -> None:
    plan, plain = identification.pad, identification
    compute: Callable[..., Responses] = twin_identification.compute_responses

    def spoil(recording: Recording, training: np.ndarray) -> Responses:
        responses = compute(recording, training)
        positions_mm, volts = responses.positions_mm.copy(), responses.volts.copy()
        positions_mm[~training] = -positions_mm[~training]
        volts[~training] = 3.0
        return replace(responses, positions_mm=positions_mm, volts=volts)

    fitted: list[Responses] = []

    def remember(pad: AsBuiltPad, responses: Responses, *options: Any) -> AsBuiltFit:
        fitted.append(responses)
        return fit_as_built(pad, responses, *options)

    monkeypatch.setattr(twin_identification, "compute_responses", spoil)
    monkeypatch.setattr(twin_identification, "fit_as_built", remember)
    with few_candidates():
        spoilt = identify_simulated(plan, plan, ideal_rig(presses=120, seed=1))
    assert np.array_equal(spoilt.fit.pad.values, plain.fit.pad.values)
    assert np.array_equal(spoilt.noise_v, plain.noise_v)
    assert spoilt.scatter == plain.scatter
    # whether the response depends on the angle is told by a sixth of the presses, of which the fits before know nothing
    sixth = spoilt.training.positions_mm[::6]
    others = [each.positions_mm for each in fitted if len(each) == len(spoilt.training) - len(sixth)]
    assert (len(others), np.isin(others, sixth).any()) == (3, False)
    assert (spoilt.held_out.volts == 3.0).all()
    assert not np.array_equal(spoilt.explained, plain.explained)
