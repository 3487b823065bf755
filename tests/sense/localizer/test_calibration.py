"""Calibration: what is learnt is worth something; of readings at their worst it is finite, or one line refuses them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.validation import InputError
from padforge.design import Morphology
from padforge.sense import Evaluation, Recording, RigSettings, calibrate, evaluate, simulate
from padforge.sense.localizer import calibration, training
from padforge.sense.localizer.evaluation import distances
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import N_TIMED
from padforge.sense.settings import LocalizerSettings
from padforge.sense.settings import LocalizerSettings as Options
from tests.helpers.presses import changed
from tests.helpers.rigs import RECTANGLE
from tests.sense.conftest import few_moments, first_presses
from tests.sense.health.pads import faulty

SHORT = Options(members=1, hidden=48, layers=2, epochs=3, batch=64, max_failures=1)


@few_moments()
def calibrate_shortly(
    recording: Recording, on_progress: OnProgress = ignore_progress, **changes: Any
) -> tuple[LocalizerModel, Evaluation]:
    return calibrate(recording, SHORT.model_copy(update=changes), on_progress=on_progress)


@settings(max_examples=40)
@given(
    presses=st.integers(3, 3000),
    share=st.floats(0.01, 0.6),
    split=st.sampled_from(["random", "chronological"]),
    seed=st.integers(0, 99),
)
def test_split_presses_partitions(presses: int, share: float, split: str, seed: int) -> None:
    if not 1 <= round(share * presses) <= presses - 3:
        with pytest.raises(InputError, match="holds"):
            calibration.split_presses(np.arange(presses), split, share, np.random.default_rng(seed))
        return
    training, test = calibration.split_presses(np.arange(presses), split, share, np.random.default_rng(seed))
    assert len(test) == round(share * presses)
    assert np.array_equal(np.sort(np.concatenate([training, test])), np.arange(presses))
    assert split == "random" or training.max() < test.min()


def test_calibrate_documents_its_errors(calibrated: tuple[LocalizerModel, Evaluation], recording: Recording) -> None:
    localizer, evaluation = calibrated
    assert (evaluation.training_presses, localizer.errors) == (255, evaluation.errors)
    trivial = np.hypot(*(recording.presses_mm - np.median(recording.presses_mm, axis=0)).T).mean()
    assert evaluation.errors[0]["mean_mm"] < 0.5 * trivial
    assert evaluation.errors[1]["mean_mm"] < 0.8 * trivial
    assert evaluation.errors[0]["within_r90"] > 0.9 - 0.25  # of 45 test presses, by radii of 20
    own = evaluate(localizer, recording, [0, 2])  # presses that are held back
    assert own.errors == [evaluation.errors[0], evaluation.errors[2]]
    other = evaluate(localizer, replace(recording, times_s=recording.times_s + 1.0), [0])
    assert (own.split, other.split, other.test_presses) == ("random", "none", 300)


@few_moments()
def test_localization_of_a_rectangular_pad_with_a_hole_is_in_mm() -> None:
    pad, rig = Morphology.random(RECTANGLE.layout, knots=3, seed=2), RigSettings(presses=250, seed=1)
    recording = simulate(pad, rig, pad_settings=RECTANGLE)
    localizer, evaluation = calibrate(recording, SHORT.model_copy(update={"hidden": 32, "epochs": 10}))
    localization = localizer.predict(recording)
    errors = distances(localization.positions_mm, recording.presses_mm)
    assert errors.mean() < 3.0  # of a pad of 24 by 60 mm
    test = np.array(evaluation.test["pressed_mm"]) - evaluation.test["predicted_mm"]
    assert evaluation.errors[0]["mean_mm"] == pytest.approx(np.linalg.norm(test, axis=1).mean(), rel=1e-6)
    within = [np.mean(errors <= radius) for radius in (localization.r50_mm, localization.r90_mm)]
    assert within == pytest.approx([0.5, 0.9], abs=0.2)


def test_calibrate_published_takes_no_failures(recording: Recording, tmp_path: Path) -> None:
    localizer, evaluation = calibrate(recording, Options(method="published"))
    guess = np.hypot(*(recording.presses_mm - np.median(recording.presses_mm, axis=0)).T).mean()
    assert [row["n_failed"] for row in evaluation.errors] == [0]
    assert evaluation.errors[0]["mean_mm"] < 0.75 * guess
    assert localizer.features == "published"
    localizer.save(tmp_path)
    again = LocalizerModel.load(tmp_path).predict(recording)
    assert np.array_equal(again.positions_mm, localizer.predict(recording).positions_mm)


def test_calibrate_reports_divergence(brief: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    train = training.train_members

    def diverged(*arguments: Any) -> Any:
        trained = train(*arguments)
        pressed = {part: weight * np.float32(np.nan) for part, weight in trained.networks["pressed"].items()}
        return trained._replace(networks={**trained.networks, "pressed": pressed})

    monkeypatch.setattr(training, "train_members", diverged)
    with pytest.raises(InputError, match=r"training diverged at \[localizer\] learning_rate 0.005, try a lower one"):
        calibrate_shortly(brief)


def test_calibrate_learns_depth_and_force(deep_recording: Recording, deeply_calibrated: tuple) -> None:
    localizer, evaluation = deeply_calibrated
    row = evaluation.errors[0]
    assert row["depth_mean_mm"] < 0.3
    assert row["force_mean_n"] < 0.9
    assert 0.75 <= row["depth_within_r90"] <= 1
    assert 0.75 <= row["force_within_r90"] <= 1
    assert localizer.interval_factors.shape == (N_TIMED + 1, 4, 5)
    found = evaluation.test["depth_mm"]
    off = np.abs(np.array(found["predicted"]) - deep_recording.depths_mm[evaluation.test["press"]])
    assert off.mean() == pytest.approx(row["depth_mean_mm"])
    # of light presses errors of places grow as the answers shrink, not more: so do the radii
    test = evaluation.test
    errors = np.hypot(*(np.array(test["predicted_mm"]) - test["pressed_mm"]).T)
    depths, radii = np.array(test["depth_mm"]["pressed"]), np.array(test["r90_mm"])
    light, deep = depths < 2, depths > 3.5
    assert errors[deep].mean() < errors[light].mean() < 6 * errors[deep].mean()
    assert radii[deep].mean() < radii[light].mean()


@pytest.mark.parametrize(
    ("change", "learnt", "lines"),
    [
        ({}, ["depth_mm", "force_n"], []),
        ({"forces_n": np.empty(0)}, ["depth_mm"], []),
        ({"depths_mm": np.empty(0)}, [], []),
        ({"depths_mm": np.full(400, 5.0)}, [], []),
        ({"depths_mm": np.nan}, [], ["depth is not learnt: it is known of 398 of 399 presses, expected all"]),
        ({"reached_mm": 0.0}, [], ["depth is not learnt: 1 of 399 presses reached 0 mm or less"]),
    ],
)
def test_known_measures_need_depth_that_varies(
    deep_recording: Recording, localizer: LocalizerModel, change: dict, learnt: list, lines: list
) -> None:
    """A number is that of one press, the others are as they were; another press is of unknown position."""
    for name, value in change.items():
        if isinstance(value, float):
            change = {name: np.where(np.arange(400) == 7, value, deep_recording.depths_mm)}
    places = np.where(np.arange(400)[:, None] == 3, np.nan, deep_recording.presses_mm)
    other = replace(deep_recording, presses_mm=places, **change)
    assert list(calibration.trainable_targets(other, np.arange(400))) == learnt
    if not learnt:
        assert calibration.missing_target_lines(other, localizer) == lines
    if lines:
        assert len(calibration.trainable_targets(other, np.arange(8, 400))) == 2


def test_calibrate_keeps_a_time_budget_and_says_so(recording: Recording, localizer: LocalizerModel) -> None:
    assert localizer.trained_share == 1
    seen: list[tuple[int, int]] = []
    options = SHORT.model_copy(update={"epochs": 10**5})

    def show(done: int, total: int, what: str) -> None:
        if not what:
            seen.append((done, total))

    with few_moments(), mock.patch.object(training, "MIN_STEPS", 1):
        model, evaluation = calibrate(recording, options, time_budget=0.5, by_moment=False, on_progress=show)
    assert model.bayes
    networks = len(model.residual_network["first.w"])
    networks += sum(len(weights["first.w"]) for weights in model.networks.values())
    assert seen == sorted(seen)
    assert seen[-1][0] == seen[-1][1] <= networks
    assert 0 < model.trained_share < 0.5
    assert evaluation.trained_share == model.trained_share
    assert (evaluation.by_moment, evaluation.focus) == ([], {})
    said = r"got 0 s for the training, in which a network took 1 steps; expected at least 36, about \d+ s$"
    with pytest.raises(InputError, match=said):
        calibrate(first_presses(recording, 40), SHORT.model_copy(update={"epochs": 99}), time_budget=0)


def test_calibrate_shows_the_progress_of_all_its_parts_and_leaves_out_unknown_positions(brief: Recording) -> None:
    part = changed(brief, "presses_mm", np.s_[::4], np.nan)
    steps: dict[str, list[int]] = {}
    totals: dict[str, int] = {}

    def show(done: int, total: int, what: str) -> None:
        steps.setdefault(what, []).append(done)
        totals[what] = total

    localizer, evaluation = calibrate_shortly(part, members=2, on_progress=show)
    assert all(press % 4 for press in localizer.test)
    assert evaluation.training_presses == 30 - evaluation.test_presses
    assert np.isfinite(localizer.predict(part).positions_mm).all()
    before, after = ("features", "response model", "Bayesian localizer"), ("expected errors", "radii")
    assert list(steps) == [*before, "", *after, "sets of failed fibres", "moments of a press"]
    for what in ("Bayesian localizer", *after, "sets of failed fibres", "moments of a press"):
        assert steps[what] == list(range(totals[what])), what
    assert steps[""] == sorted(steps[""])
    assert (steps[""][0], steps[""][-1]) == (0, totals[""])


@pytest.mark.slow
def test_calibrate_needs_fewer_presses_with_the_plan_of_the_pad(recording: Recording) -> None:
    few = replace(recording, presses_mm=np.where(np.arange(300)[:, None] < 60, recording.presses_mm, np.nan))
    pad = Morphology.from_dict(recording.source["morphology"])
    options = Options(hidden=32, layers=2, epochs=8, members=2, max_failures=1)
    with few_moments():
        with_plan, without = (calibrate(few, options, pad=plan, by_moment=False)[0] for plan in (pad, None))
    found = (each.predict(recording).positions_mm for each in (without, with_plan))
    plain, told = (distances(positions_mm, recording.presses_mm)[60:].mean() for positions_mm in found)
    assert told < 0.9 * plain


TINY = LocalizerSettings(members=1, hidden=8, layers=1, epochs=1, batch=64, max_failures=1, test_share=0.3)


def worst(seed: int, recording: Recording) -> Recording:
    """Its readings with faults, and its presses oddly placed, timed or short."""
    rng = np.random.default_rng(seed)
    places, down_command = recording.presses_mm.copy(), recording.down_command.copy()
    up_command = recording.up_command.copy()
    times_s = recording.times_s
    match rng.integers(7):
        case 0:
            places[:] = places[0]
        case 1:  # on a line
            places[:, 1] = 0
        case 2:
            places[rng.random(len(places)) < rng.choice([0.1, 0.6])] = np.nan
        case 3:  # twice
            places[1::2] = places[::2]
        case 4:
            places *= rng.choice([1e-12, 1e-300, 2e3])
        case 5:
            places[-1] = 1e5
    if rng.random() < 0.3:  # a pause
        times_s = times_s + np.where(np.arange(len(times_s)) > len(times_s) // 2, rng.choice([10.0, 1e6]), 0.0)
    if rng.random() < 0.3:  # as short as they may be
        up_command = down_command + 1
    if rng.random() < 0.2:  # at the very ends
        down_command[0], up_command[-1] = 1, len(times_s)
    return Recording(faulty(rng, recording.readings), times_s, places, down_command, up_command)


def require_finite(localizer: LocalizerModel, recording: Recording, document: Any = ()) -> None:
    for readings in (0, 3, 20, 22, None):
        found = localizer.predict(recording, until=None if readings is None else recording.down_command + readings)
        assert np.isfinite(np.column_stack([found.positions_mm, found.std_mm, found.r50_mm, found.r90_mm])).all()
        assert (found.std_mm > 0).all()
        assert (found.r50_mm > 0).all()
    json.dumps(document, allow_nan=False)


@pytest.mark.parametrize("seed", range(6))
def test_predict_and_evaluate_stay_finite(localizer: LocalizerModel, brief: Recording, seed: int) -> None:
    one = worst(seed, brief)
    require_finite(localizer, one, evaluate(localizer, one, (0, 3)).to_dict() if one.has_position.any() else ())


@pytest.mark.parametrize(("seed", "method"), list(enumerate([*["ensemble"] * 3, "published"])))
def test_calibrate_learns_or_refuses(brief: Recording, seed: int, method: str) -> None:
    one = worst(seed, brief)
    try:
        localizer, evaluation = calibrate(one, TINY.model_copy(update={"method": method}))
    except InputError:
        return
    require_finite(localizer, one, evaluation.to_dict())
