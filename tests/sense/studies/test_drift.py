"""The study of drift, in small: what is taken of readings, what that brings, and how often fibres are idle."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.design import InputError, Morphology
from padforge.sense import Recording, open_recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.studies import drift
from padforge.sense.studies.drift import FILTERS, SCHEMES, SLOW_PRESSES, drift_study, scheme_inputs, values
from padforge.sense.studies.study import Study, run

PAD = Morphology.random(2, knots=3, seed=5)
STRONG = RigSettings(drift_mv=300, creep=0, hysteresis=0)
CYCLES = 5
BEGUN, LIFTED = 40 * np.arange(CYCLES) + 20, 40 * np.arange(1, CYCLES + 1)


@pytest.fixture(scope="module")
def recorded() -> Recording:
    """200 presses, not said to be simulated; a fibre's readings are missing now and then, and one place unknown."""
    recording = simulate(PAD, RigSettings(presses=200, seed=3))
    readings, places = recording.readings.copy(), recording.presses_mm.copy()
    readings[100:110, 0] = np.nan
    places[7] = np.nan
    return replace(recording, readings=readings, presses_mm=places, source={"kind": "test"})


def begin(recording: Recording, presses: int) -> Recording:
    """The first presses of a recording."""
    end = int(recording.up_command[presses - 1])
    first = {
        name: getattr(recording, name)[:presses] for name in ("presses_mm", "down_command", "up_command", "depths_mm")
    }
    return replace(recording, readings=recording.readings[:end], times_s=recording.times_s[:end], **first)


def small(recorded: Recording) -> Study:
    pads = {"winding": PAD, "square": Morphology.straight(4)}
    return drift_study(pads, {"real": recorded}, rig=STRONG, presses=180, hidden=8, epochs=15)


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Two networks behind each error."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(drift, "MEMBERS", 2)
        yield


@pytest.fixture(scope="module")
def document(recorded: Recording, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return run(small(recorded), tmp_path_factory.mktemp("drift"))


def errors(document: dict[str, Any], label: str, scheme: str, key: str = "mean_mm") -> list[float]:
    return [row[key] for row in document["rows"] if (row["recording"], row["compensate"]) == (label, scheme)]


def test_values_are_the_readings_10_30_and_50_of_the_cycle_and_of_a_short_one_stay_within_their_phase() -> None:
    readings = np.column_stack([np.arange(40.0 * CYCLES), -np.arange(40.0 * CYCLES)])
    taken = values(readings, BEGUN, LIFTED)
    assert taken.shape == (CYCLES, 2, 3)
    np.testing.assert_array_equal(taken[1], [[50, 70, 90], [-50, -70, -90]])
    np.testing.assert_array_equal(taken[-1, 0], [170, 190, 199])  # nothing was read after the last press
    down_command, up_command = np.array([3, 9, 15]), np.array([6, 12, 18])
    np.testing.assert_array_equal(
        values(np.arange(20.0)[:, None], down_command, up_command)[:, 0], [[0, 5, 8], [6, 11, 14], [12, 17, 19]]
    )


def test_schemes_take_off_what_they_say() -> None:
    rng = np.random.default_rng(0)
    readings = rng.normal(2, 0.1, (40 * CYCLES, 3))
    taught = np.arange(CYCLES)
    before, pressed, after = np.moveaxis(values(readings, BEGUN, LIFTED), 2, 0)
    found = {name: scheme_inputs(name, readings, BEGUN, LIFTED, taught) for name in SCHEMES}
    np.testing.assert_array_equal(found["none"], pressed)
    np.testing.assert_array_equal(found["rest taken off"], pressed - before)
    np.testing.assert_array_equal(found["published"], np.hstack([before, pressed, after]))
    assert SLOW_PRESSES >= CYCLES
    slow = [np.median(before[: press + 1], axis=0) for press in range(CYCLES)]
    np.testing.assert_allclose(found["slow rest taken off"], pressed - slow)
    assert found["windows"].shape == found["published"].shape  # no more inputs than the published way
    shifted = scheme_inputs("windows", readings + np.array([1, 2, 3]), BEGUN, LIFTED, taught)
    np.testing.assert_allclose(shifted, found["windows"], atol=1e-9)


@pytest.mark.slow
def test_a_study_of_drift(document: dict[str, Any]) -> None:
    """Errors are means over filters: two networks on presses that scatter may be off by a fifth with one."""
    ways = [(row["recording"], row["kind"], row["denoise"], row["compensate"]) for row in document["rows"]]
    kinds = {"winding": "simulated", "square": "simulated", "real": "recorded"}
    assert ways == [(label, kind, name, each) for label, kind in kinds.items() for name in FILTERS for each in SCHEMES]
    for row in document["rows"]:
        assert 0 < row["median_mm"] < row["p95_mm"]
        assert row["std_mm"] >= 0
        assert (row["seconds_per_10000"] is None) == (row["denoise"] == "none")
    for key in ("mean_mm", "mean_last_mm"):
        bare, rest, slow = (
            np.mean(errors(document, "winding", scheme, key))
            for scheme in ("none", "rest taken off", "slow rest taken off")
        )
        assert rest < 0.7 * bare
        assert slow < bare
    assert [each["recording"] for each in document["stretches"]] == ["winding", "square", "real"]
    for stretch in document["stretches"]:
        times_s, _, filtered = np.array(stretch["stretch"])
        for time_s, volts in np.array(stretch["marks"]).reshape(-1, 2):
            assert filtered[np.flatnonzero(times_s == time_s)] == pytest.approx([volts])
    shares = {(each["label"], each["kind"]): each["idle_percent"] for each in document["idle"]}
    assert shares["square", "contact model"] == pytest.approx(70, abs=1)
    # Fibre i, a straight line, is touched by presses within 0.6 of it, of those over 1..4.
    covered = (0.6 + 1.2 + 1.2 + 0.6) / 4 / 3
    assert shares["square", "contact model"] == pytest.approx(100 * (1 - covered), abs=1)
    assert set(shares) == {
        *((label, "contact model") for label in ("winding", "square")),
        *((label, f"simulated readings{end}") for label in ("winding", "square") for end in ("", ", denoised")),
        *(("real", f"recorded readings{end}") for end in ("", ", denoised")),
    }
    assert shares["square", "simulated readings, denoised"] > shares["square", "simulated readings"]


@pytest.mark.slow
def test_without_drift_there_is_nothing_to_take_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift, "FILTERS", {name: FILTERS[name] for name in (drift.RAW, drift.AS_PUBLISHED)})
    still = STRONG.model_copy(update={"drift_mv": 0.0})
    document = run(drift_study({"winding": PAD}, {}, rig=still, presses=240, hidden=10, epochs=30), tmp_path)
    assert errors(document, "winding", "none")[1] < 1.3 * errors(document, "winding", "rest taken off")[1]


def test_what_cannot_be_studied_is_refused_and_results_of_another_recording_are_no_help(recorded: Recording) -> None:
    with pytest.raises(InputError, match="neither a morphology nor a recording"):
        drift_study({}, {})
    with pytest.raises(InputError, match="a: both a morphology and a recording are called so"):
        drift_study({"a": PAD}, {"a": recorded})
    with pytest.raises(InputError, match="few: recording has 3 presses of known place"):
        drift_study({}, {"few": begin(recorded, 3)})
    other = replace(recorded, readings=recorded.readings + 0.1)
    assert small(recorded).settings["recordings"] != small(other).settings["recordings"]


@pytest.mark.slow
def test_the_published_pad_and_recording(published: Path, tmp_path: Path) -> None:
    pad = Morphology.load(published / "5para_dis.mat")
    first = begin(open_recording(published / "para5_long_first4500.mat"), 300)
    document = run(drift_study({"N=5": pad}, {"built": first}, presses=60, hidden=8, epochs=15), tmp_path)
    assert document["idle"][0]["idle_percent"] == pytest.approx(58, abs=1)
    assert max(errors(document, "built", "rest taken off")) < min(errors(document, "built", "none"))
    assert max(errors(document, "built", "published")) < min(errors(document, "built", "none"))
