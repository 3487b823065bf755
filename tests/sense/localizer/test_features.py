"""Inputs of the localizer: where windows lie, and that they stay within their press and fibre."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sense.localizer.features import (
    DOWN,
    FEATURES,
    PAST,
    PASTS,
    REST,
    SIZES,
    SLOW,
    UP,
    bridged,
    history,
    press_inputs,
    published_inputs,
    window_inputs,
)

PRESSES, FIBRES = 5, 3
BEGUN = 40 * np.arange(PRESSES) + 20
LIFTED = BEGUN + 20
FREE = np.concatenate([[0], LIFTED[:-1]])
NEXT = np.append(BEGUN[1:], 40 * PRESSES)


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((40 * PRESSES, FIBRES))


def test_windows_are_means_minus_the_rest_before_the_press() -> None:
    readings = noise()
    found = window_inputs(readings, BEGUN, LIFTED)
    assert found.shape == (PRESSES, FIBRES, len(DOWN) + len(UP))
    press = 2
    rest = readings[90:100].mean(axis=0)
    assert np.allclose(found[press, :, 7], readings[112:116].mean(axis=0) - rest)
    assert np.allclose(found[press, :, len(DOWN) + 6], readings[129:134].mean(axis=0) - rest)


def test_published_inputs_are_medians_before_in_and_after() -> None:
    readings = noise()
    found = published_inputs(readings, BEGUN, LIFTED)
    expected = [np.median(readings[at - 7 : at + 8], axis=0) for at in (90, 110, 130)]
    assert np.allclose(found[2], np.stack(expected, axis=1))


INPUTS = {"full": window_inputs, "published": published_inputs}


@pytest.mark.parametrize("name", INPUTS)
def test_a_press_is_told_by_its_own_readings_only(name: str) -> None:
    readings, press = noise(), 2
    before = INPUTS[name](readings, BEGUN, LIFTED)[press]
    readings[: FREE[press]] = 99
    readings[NEXT[press] :] = 99
    assert np.array_equal(INPUTS[name](readings, BEGUN, LIFTED)[press], before)


@pytest.mark.parametrize("name", INPUTS)
def test_a_fibre_s_inputs_come_from_that_fibre_only(name: str) -> None:
    readings = noise()
    before = INPUTS[name](readings, BEGUN, LIFTED)
    readings[:, 1] = noise(1)[:, 1]
    after = INPUTS[name](readings, BEGUN, LIFTED)
    assert np.array_equal(after[:, [0, 2]], before[:, [0, 2]])
    assert not np.array_equal(after[:, 1], before[:, 1])


@given(offset=st.floats(-2, 2), gain=st.floats(0.1, 10))
def test_windows_forget_the_rest_and_keep_the_scale(offset: float, gain: float) -> None:
    plain = window_inputs(noise(), BEGUN, LIFTED)
    assert np.allclose(window_inputs(gain * noise() + offset, BEGUN, LIFTED), gain * plain)


@pytest.mark.parametrize("name", FEATURES)
@given(gaps=st.lists(st.integers(1, 30), min_size=2, max_size=20), after=st.integers(0, 30))
def test_presses_of_any_length_have_inputs_within_the_readings(name: str, gaps: list[int], after: int) -> None:
    edges = np.cumsum(gaps[: len(gaps) // 2 * 2])
    readings = np.random.default_rng(0).uniform(1, 2, (edges[-1] + after, 2))
    found = press_inputs(readings, edges[::2], edges[1::2], name)
    assert found.windows.shape == (len(edges) // 2, 2, SIZES[name])
    assert found.history.shape == (len(edges) // 2, 2, PASTS[name])
    assert np.isfinite(found.windows).all()
    assert np.isfinite(found.history).all()
    assert found.alive.all()


def test_a_press_up_to_its_end_knows_nothing_of_its_release() -> None:
    readings, press = noise(), 2
    before = {name: press_inputs(readings, BEGUN, LIFTED, name).windows[press] for name in ("causal", "early")}
    readings[LIFTED[press] :] = 99
    after = {name: press_inputs(readings, BEGUN, LIFTED, name).windows[press] for name in ("causal", "early")}
    assert all(np.array_equal(before[name], after[name]) for name in before)
    readings[BEGUN[press] + 8 :] = 77
    assert np.array_equal(press_inputs(readings, BEGUN, LIFTED, "early").windows[press], before["early"])


def test_history_is_what_came_before_relative_to_the_rest() -> None:
    readings = np.random.default_rng(3).standard_normal((6000, 2))
    begun = np.array([300, 5000])
    found = history(readings, begun)
    rest = readings[5000 + REST[0] : 5000].mean(axis=0)
    for number, (first, end) in enumerate(PAST):
        assert np.allclose(found[1, :, number], readings[5000 + first : 5000 + end].mean(axis=0) - rest)
    samples = readings[5000 - SLOW[0] : 5000 : SLOW[0] // 200]
    assert np.allclose(found[1, :, len(PAST)], np.median(samples, axis=0) - rest)
    readings[5000:] = 99
    assert np.array_equal(history(readings, begun), found)


def test_history_before_the_first_reading_is_the_first_reading() -> None:
    readings = np.arange(40.0)[:, None] + np.zeros((1, 2))
    found = history(readings, np.array([20]))
    assert np.allclose(found[0, 0, len(PAST) - 1], readings[0, 0] - readings[10:20, 0].mean())


def test_short_gaps_are_bridged_and_do_not_spread() -> None:
    readings = noise()
    holed = readings.copy()
    holed[105] = np.nan
    holed[:3, 1] = np.nan
    filled = bridged(holed)
    assert np.allclose(filled[105], (readings[104] + readings[106]) / 2)
    assert np.array_equal(filled[:3, 1], np.repeat(readings[3, 1], 3))
    there = ~np.isnan(holed)
    assert np.array_equal(filled[there], readings[there])
    assert press_inputs(holed, BEGUN, LIFTED, "full").alive.all()


def test_a_fibre_without_readings_counts_as_lost_in_those_presses_only() -> None:
    readings = noise()
    readings[95:130, 1] = np.nan
    found = press_inputs(readings, BEGUN, LIFTED, "full")
    assert np.array_equal(~found.alive, np.outer(np.arange(PRESSES) == 2, np.arange(FIBRES) == 1))
    readings[:, 2] = np.nan
    found = press_inputs(readings, BEGUN, LIFTED, "full")
    assert not found.alive[:, 2].any()
    assert np.isfinite(found.windows).all()
    assert np.isfinite(found.history).all()


@pytest.mark.parametrize(
    ("features", "first", "end"), [("full", -10, 40), ("causal", -10, 20), ("early", -10, 20), ("published", -10, 40)]
)
def test_a_fibre_counts_where_three_quarters_of_what_is_looked_at_are_there(
    features: str, first: int, end: int
) -> None:
    """Press 2 is sent down at 100 and up at 120; the last readings that count are what is missing."""
    most = (end - first) // 4
    for missing, there in ((most, True), (most + 1, False)):
        for begin in (100 + first, 100 + end - missing):
            readings = noise()
            readings[begin : begin + missing, 1] = np.nan
            assert press_inputs(readings, BEGUN, LIFTED, features).alive[2, 1] == there
    readings = noise()
    readings[50 : 100 + first, 1] = readings[100 + end : 140, 1] = np.nan
    assert press_inputs(readings, BEGUN, LIFTED, features).alive[2, 1]


def test_of_a_ramp_every_window_gives_its_middle() -> None:
    """Readings that count themselves: a press from 5000 to 5020, its rest 5.5 before it."""
    ramp = np.arange(5100.0)[:, None]
    begun, lifted = np.array([5000]), np.array([5020])
    down = [1, 2, 3, 4, 5, 6.5, 9.5, 13.5, 17.5]
    up = [20, 21, 22, 23, 24.5, 27, 31, 36.5]
    past = [-1.5, -4, -8, -13, -17, -19.5, -25.5, -35.5, -45.5, -55.5, -70.5, -90.5, -110.5, -140.5]
    slow = [-402, -2010]
    for features, windows in (("full", down + up), ("causal", down), ("early", down[:6])):
        found = press_inputs(ramp, begun, lifted, features)
        np.testing.assert_allclose(found.windows[0, 0], np.array(windows) + 5.5)
        np.testing.assert_allclose(found.history[0, 0], np.array(past + slow) + 5.5)
    np.testing.assert_allclose(press_inputs(ramp, begun, lifted, "published").windows[0, 0], [4990 - 0, 5010, 5030])
