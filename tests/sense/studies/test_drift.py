"""The study of drift, in small: levels of readings, drift compensation, and idle shares."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge import InputError
from padforge.design import Morphology
from padforge.sense import Recording, open_recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.studies import drift
from padforge.sense.studies.drift import COMPENSATIONS, FILTERS, drift_study, level_indices, network_inputs
from padforge.sense.studies.study import run
from tests.sense.conftest import first_presses

PAD = Morphology.random(2, knots=3, seed=5)
STRONG = RigSettings(presses=180, drift_mv=300, creep=0, hysteresis=0)
CYCLES = 5
DOWN, UP = 40 * np.arange(CYCLES) + 20, 40 * np.arange(1, CYCLES + 1)


@pytest.fixture(scope="module")
def recorded() -> Recording:
    """200 presses, not marked as simulated; some readings of a fibre are missing, and one position."""
    recording = simulate(PAD, RigSettings(presses=200, seed=3))
    readings, positions_mm = recording.readings.copy(), recording.presses_mm.copy()
    readings[100:110, 0] = np.nan
    positions_mm[7] = np.nan
    return replace(recording, readings=readings, presses_mm=positions_mm, source={"kind": "test"})


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        for name, value in (("MEMBERS", 2), ("HIDDEN", 8), ("EPOCHS", 15), ("RIG", STRONG)):
            patched.setattr(drift, name, value)
        yield


@pytest.fixture(scope="module")
def document(recorded: Recording, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    pads = {"winding": PAD, "square": Morphology.straight(4)}
    return run(drift_study(pads, {"real": recorded}), tmp_path_factory.mktemp("drift"))


def errors(document: dict[str, Any], label: str, compensation: str, key: str = "mean_mm") -> list[float]:
    return [row[key] for row in document["rows"] if (row["recording"], row["compensation"]) == (label, compensation)]


def test_levels_are_the_readings_10_30_and_50_of_a_cycle() -> None:
    levels = level_indices(40 * CYCLES, DOWN, UP)
    assert levels[1].tolist() == [50, 70, 90]
    assert levels[-1].tolist() == [170, 190, 199]  # there are no readings after the last press
    # those of short cycles stay within their phase
    levels = level_indices(20, np.array([3, 9, 15]), np.array([6, 12, 18]))
    assert levels.tolist() == [[0, 5, 8], [6, 11, 14], [12, 17, 19]]


def test_network_inputs_subtract_the_baseline_of_their_compensation() -> None:
    readings = np.random.default_rng(0).normal(2, 0.1, (40 * CYCLES, 3))
    training = np.arange(CYCLES)
    before, pressed, after = readings[level_indices(len(readings), DOWN, UP).T]
    inputs = {name: network_inputs(name, readings, DOWN, UP, training) for name in COMPENSATIONS}
    np.testing.assert_array_equal(inputs["none"], pressed)
    np.testing.assert_array_equal(inputs["baseline"], pressed - before)
    np.testing.assert_array_equal(inputs["published"], np.hstack([before, pressed, after]))
    slow = [np.median(before[: press + 1], axis=0) for press in range(CYCLES)]
    np.testing.assert_allclose(inputs["slow baseline"], pressed - slow)
    assert inputs["windows"].shape == inputs["published"].shape
    shifted = network_inputs("windows", readings + np.array([1, 2, 3]), DOWN, UP, training)
    np.testing.assert_allclose(shifted, inputs["windows"], atol=1e-9)


@pytest.mark.slow
def test_study_finds_that_compensation_reduces_errors(document: dict[str, Any]) -> None:
    """Errors are means over filters: two networks on presses that scatter may be off by a fifth with one."""
    cases = [(row["recording"], row["filter"], row["compensation"]) for row in document["rows"]]
    assert cases == list(product(("winding", "square", "real"), FILTERS, COMPENSATIONS))
    for key in ("mean_mm", "mean_last_mm"):
        plain, baseline, slow = (
            np.mean(errors(document, "winding", compensation, key))
            for compensation in ("none", "baseline", "slow baseline")
        )
        assert baseline < 0.7 * plain
        assert slow < plain


@pytest.mark.slow
def test_study_computes_idle_shares(document: dict[str, Any]) -> None:
    shares = {(row["label"], row["kind"]): row["idle_percent"] for row in document["idle"]}
    # Fibre i, a straight line, is touched by presses within 0.6 of it, of those over 1..4.
    covered = (0.6 + 1.2 + 1.2 + 0.6) / 4 / 3
    assert shares["square", "contact model"] == pytest.approx(100 * (1 - covered), abs=1)
    assert set(shares) == {
        *((label, "contact model") for label in ("winding", "square")),
        *((label, f"simulated readings{end}") for label in ("winding", "square") for end in ("", ", filtered")),
        *(("real", f"recorded readings{end}") for end in ("", ", filtered")),
    }
    assert shares["square", "simulated readings, filtered"] > shares["square", "simulated readings"]


def test_drift_study_rejects_duplicate_and_short_recordings(recorded: Recording) -> None:
    with pytest.raises(InputError, match="a: label of a morphology and of a recording"):
        drift_study({"a": PAD}, {"a": recorded})
    few = np.where(np.arange(len(recorded.presses_mm))[:, None] < 3, recorded.presses_mm, np.nan)
    with pytest.raises(InputError, match="few: recording has 3 presses of known"):
        drift_study({}, {"few": replace(recorded, presses_mm=few)})


@pytest.mark.slow
def test_study_of_the_published_pad_and_recording(published: Path, tmp_path: Path) -> None:
    pad = Morphology.load(published / "5para_dis.mat")
    recording = first_presses(open_recording(published / "para5_long_first4500.mat"), 300)
    document = run(drift_study({"N=5": pad}, {"built": recording}), tmp_path)
    assert document["idle"][0]["idle_percent"] == pytest.approx(58, abs=1)
    assert max(errors(document, "built", "baseline")) < min(errors(document, "built", "none"))
    assert max(errors(document, "built", "published")) < min(errors(document, "built", "none"))


def test_drift_study_summarizes_the_errors_of_networks_and_of_idle_fibres(recorded: Recording) -> None:
    """Two networks; the errors of those that were trained on a filter's readings are the number of the filter more."""
    test, last = np.array([[1.0, 2.0, 9.0], [3.0, 4.0, 11.0]]), np.array([[5.0, 7.0], [6.0, 10.0]])
    study = drift_study({}, {"real": recorded})
    count = len(COMPENSATIONS)
    states = [
        {
            **{f"test_{k}": test + number + k for k in range(count)},
            **{f"last_{k}": last + number + 2 * (count - k) for k in range(count)},
            "seconds": np.array(0.25 + number),
            "idle": np.array(0.125 + number / 8),
            **{"fibre": np.array(1), "readings": np.zeros((3, 1))},
            **{"samples": np.zeros((1, 3, 2)), "levels": np.zeros((1, 3))},
        }
        for number in range(len(FILTERS))
    ]
    result = study.conclude(states)
    rows = {(row["filter"], row["compensation"]): row for row in result.rows}
    assert list(rows) == list(product(FILTERS, COMPENSATIONS))
    row = rows["median of 15", "published"]
    errors_mm = {name: row[f"{name}_mm"] for name in ("mean", "median", "p95", "std", "mean_last", "std_last")}
    assert errors_mm == pytest.approx(
        {"mean": 9, "median": 7.5, "p95": 4 + 10.5, "std": 1, "mean_last": 7 + 1 + 4, "std_last": 1}
    )
    assert (row["seconds_per_10000"], rows["none", "published"]["seconds_per_10000"]) == (1.25, None)
    # of raw readings and of those filtered as published, which is the third filter
    assert [share["idle_percent"] for share in result.extra["idle"]] == [12.5, 37.5]
    assert "a fibre is idle in 12.5 % (real, recorded readings) and 37.5 %" in result.text[1]
