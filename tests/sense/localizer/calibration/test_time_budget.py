"""Calibrations of a given length of time."""

import os
import time
from typing import Any

import numpy as np
import pytest

from design.common.errors import InputError
from sense import Recording, calibrate
from sense.settings import LocalizerSettings as Options

SHORT = Options(members=1, hidden=48, layers=2, epochs=3, batch=64)


def test_a_time_budget_is_kept(recording: Recording) -> None:
    seen: list[tuple[int, int]] = []
    begin = time.monotonic()
    localizer, document = calibrate(
        recording, SHORT.model_copy(update={"epochs": 10**5}), time_budget=2, progress=lambda *step: seen.append(step)
    )
    assert time.monotonic() - begin < 60  # with what is done before and after, on a machine that does other things
    assert localizer.observer is not None
    networks = len(localizer.weights["first.w"]) + len(localizer.corrector["first.w"])
    assert networks % (os.cpu_count() or 1) == 0
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert seen[-1][0] == seen[-1][1] <= 2 * networks
    assert document["errors"][0]["mean_mm"] < 9


def test_a_time_budget_that_is_over_at_once_trains_a_step(recording: Recording) -> None:
    localizer, _ = calibrate(recording, SHORT, time_budget=0)
    assert np.isfinite(localizer.locate(localizer.inputs(recording)).places_mm).all()


@pytest.mark.parametrize("budget", [-1.0, float("nan"), True, "5"])
def test_time_budgets_that_are_none_are_refused(recording: Recording, budget: Any) -> None:
    with pytest.raises(InputError, match="time_budget is"):
        calibrate(recording, SHORT, time_budget=budget)


def test_the_published_method_takes_no_time_budget(recording: Recording) -> None:
    with pytest.raises(InputError, match="expected masked"):
        calibrate(recording, Options(method="published"), time_budget=5)
