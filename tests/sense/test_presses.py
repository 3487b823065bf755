"""Inputs of the localizer: where windows lie, and that they stay within their press and fibre."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sense.presses import DOWN, INPUTS, UP, published_inputs, window_inputs

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


@pytest.mark.parametrize("name", INPUTS)
@given(gaps=st.lists(st.integers(1, 30), min_size=2, max_size=20), after=st.integers(0, 30))
def test_presses_of_any_length_have_inputs_within_the_readings(name: str, gaps: list[int], after: int) -> None:
    edges = np.cumsum(gaps[: len(gaps) // 2 * 2])
    readings = np.random.default_rng(0).uniform(1, 2, (edges[-1] + after, 2))
    found = INPUTS[name](readings, edges[::2], edges[1::2])
    assert found.shape[:2] == (len(edges) // 2, 2)
    assert np.isfinite(found).all()
