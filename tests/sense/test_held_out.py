"""Presses that are held out teach nothing: nonsense in their place changes no bit of what is learnt."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from padforge.sense import Localizer, Recording, calibrate, recalibrate
from padforge.sense.health import health_model, trace_model
from padforge.sense.health.fault_detector import HEALTH_FILES
from padforge.sense.localizer import recalibration, single_press, training
from padforge.sense.localizer.features import PressFeatures
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.report import calibration
from padforge.sense.settings import LocalizerSettings
from padforge.sense.twin import identification as twin_identification
from padforge.sense.twin.identification import Identification
from padforge.sense.twin.responses import Responses
from tests.helpers.rigs import ideal_rig
from tests.sense.conftest import few_candidates, few_moments, first_presses, identify_simulated

TINY = LocalizerSettings(
    members=2, hidden=16, layers=1, epochs=1, batch=64, max_failures=1, split="chronological", test_share=0.2
)
RADII = 3  # last presses of a training of 32, which calibrate the uncertainty


def without_sense(recording: Recording, first: int) -> Recording:
    """Positions from a press on, and readings from the next one on, are nonsense: its touch ends the press before."""
    readings, places = np.array(recording.readings), np.array(recording.presses_mm)
    places[first:] = 40.0 - places[first:] / 3
    start = recording.down_command[first + 1]
    readings[start:] = np.random.default_rng(0).uniform(0, 3.3, readings[start:].shape)
    return replace(recording, readings=readings, presses_mm=places)


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
    assert learnt(fit(brief, seed=7))["released.first.w"] != learnt(plain)["released.first.w"]
    # the published training stops by presses that are not those of radii either
    stopped, other = (fit(each, method="published") for each in (brief, without_sense(brief, 32 - RADII)))
    assert learnt(other, of_radii[1:]) == learnt(stopped, of_radii[1:])
    assert not np.array_equal(other.interval_factors, stopped.interval_factors)


def test_cross_validated_localizer_learns_nothing_from_other_presses(brief: Recording) -> None:
    """Of a recording, of which those of a fold are selected as scikit-learn does it; another seed learns otherwise."""
    params, spoilt = TINY.model_dump(exclude={"seed"}), without_sense(brief, 30)
    plain, same, other = (
        Localizer(random_state=seed, **params).fit(each[np.arange(30)])
        for seed, each in ((0, brief), (0, spoilt), (7, brief))
    )
    assert learnt(same.model_) == learnt(plain.model_)
    assert learnt(other.model_)["released.first.w"] != learnt(plain.model_)["released.first.w"]
    assert plain.test_presses_.size == 0
    assert plain.score(brief[np.arange(30, 40)]) < 0


def test_recalibration_predicts_each_fold_by_models_that_have_not_seen_it(
    localizer: LocalizerModel, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = first_presses(recording, 24)
    model = replace(localizer, interval_factors=localizer.interval_factors[:, :1])
    for module, name, value in (
        *((recalibration, "FOLDS", 2), (single_press, "SUBSETS", 1), (training, "RETRAINING_STEPS", 1)),
    ):
        monkeypatch.setattr(module, name, value)
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


def test_health_learns_nothing_from_presses_held_back(
    recording: Recording, localizer: LocalizerModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a localizer, beside which health is learnt."""
    monkeypatch.setattr(trace_model, "MAX_STEPS", 2)
    monkeypatch.setattr(health_model, "MIN_PRESSES", 100)
    calibrated = replace(localizer, test=tuple(range(120, 130))), Mock(to_dict=dict)
    monkeypatch.setattr(calibration, "calibrate", lambda *_, **__: calibrated)
    known = first_presses(recording, 130)
    for name, each in (("plain", known), ("spoilt", without_sense(known, 120))):
        calibration.calibrate_into(each, tmp_path / name, LocalizerSettings(), without=("figures",))
    for file in HEALTH_FILES:
        assert (tmp_path / "plain" / file).read_bytes() == (tmp_path / "spoilt" / file).read_bytes()


def test_twin_learns_nothing_from_presses_held_out(
    identification: Identification, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, plain = identification.pad, identification
    compute: Callable[..., Responses] = twin_identification.compute_responses

    def spoil(recording: Recording, training: np.ndarray) -> Responses:
        responses = compute(recording, training)
        positions_mm, volts = responses.positions_mm.copy(), responses.volts.copy()
        positions_mm[~training] = -positions_mm[~training]
        volts[~training] = 3.0
        return replace(responses, positions_mm=positions_mm, volts=volts)

    monkeypatch.setattr(twin_identification, "compute_responses", spoil)
    with few_candidates():
        spoilt = identify_simulated(plan, plan, ideal_rig(presses=120, seed=1))
    assert np.array_equal(spoilt.fit.pad.values, plain.fit.pad.values)
    assert np.array_equal(spoilt.noise_v, plain.noise_v)
    assert spoilt.scatter == plain.scatter
    assert (spoilt.held_out.volts == 3.0).all()
    assert not np.array_equal(spoilt.explained, plain.explained)
