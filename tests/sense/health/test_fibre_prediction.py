"""Traces become the numbers of the network, press by press, as the formulas say; fibres predict each other."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from padforge.sense.health import trace_model as fibre_prediction
from padforge.sense.health.trace_model import (
    COMPONENTS,
    INPUTS,
    MEMBERS,
    RELEASED,
    REST,
    TARGETS,
    TRACE,
    History,
    Shapes,
)

FIBRES = 2


def test_a_press_is_told_by_its_answer_its_rest_and_what_is_left_of_those_before() -> None:
    rng = np.random.default_rng(0)
    traces = rng.normal(0, 1, (120, FIBRES, TRACE)) + np.linspace(0, 3, 120)[:, None, None]
    traces[5, 1, 3] = np.nan
    basis = rng.normal(0, 1, (FIBRES, TRACE, COMPONENTS))
    shapes, history = Shapes(basis, np.ones((FIBRES, INPUTS)), np.ones((FIBRES, TARGETS))), History.none(FIBRES)
    levels, memory, seen = [math.nan] * FIBRES, np.zeros((FIBRES, COMPONENTS)), [0] * FIBRES
    for number, press in enumerate(traces):
        inputs, targets = shapes.advance(press, history)
        for fibre in range(FIBRES):
            if np.isnan(press[fibre]).any():
                assert np.isnan(inputs[fibre, : COMPONENTS + 1]).all()
                assert np.isnan(targets[fibre]).all()
                continue
            rest = press[fibre, :REST].mean()
            answer = (press[fibre] - rest) @ basis[fibre]
            level = rest if math.isnan(levels[fibre]) else levels[fibre]
            np.testing.assert_allclose(inputs[fibre], [*answer, rest - level, *memory[fibre]], atol=1e-9)
            np.testing.assert_allclose(targets[fibre], [*answer, rest - level], atol=1e-9)
            seen[fibre] += 1
            levels[fibre] = level + max(1 / 50, 1 / seen[fibre]) * (rest - level)
            memory[fibre] = 0.7 * (memory[fibre] + answer)
        np.testing.assert_allclose(history.level, levels, atol=1e-9, err_msg=str(number))
        np.testing.assert_array_equal(history.seen, seen)


def test_inputs_are_held_at_eight_spreads_and_those_of_absent_fibres_are_nothing() -> None:
    shapes = Shapes(np.empty(0), np.full((FIBRES, INPUTS), 2.0), np.full((FIBRES, TARGETS), 4.0))
    inputs = np.array([[3.0] * INPUTS, [np.nan] * INPUTS])
    inputs[0, :2] = 100, -100
    scaled, targets = shapes.scaled(inputs, np.full((FIBRES, TARGETS), 6.0))
    assert scaled[0, :3].tolist() == [8, -8, 1.5]
    assert not scaled[1].any()
    assert (targets == 1.5).all()


def test_shapes_are_principal_directions_and_sizes_keep_a_part_of_their_smallness() -> None:
    rng = np.random.default_rng(1)
    patterns = np.linalg.qr(rng.normal(0, 1, (TRACE - REST, 3)))[0].T
    strength = np.array([5.0, 2.0, 0.5])
    traces = np.zeros((400, FIBRES, TRACE))
    traces[:, :, REST:] = np.einsum("qck,kw->qcw", strength * rng.normal(0, 1, (400, FIBRES, 3)), patterns)
    shapes, inputs, targets = fibre_prediction.shapes_of(traces)
    for fibre in range(FIBRES):
        for component, pattern in enumerate(patterns):
            assert abs(shapes.basis[fibre, REST:, component] @ pattern) > 0.98
        answers = traces[:, fibre] @ shapes.basis[fibre]
        own = np.sqrt((answers**2).mean(axis=0))
        largest = max(own.max(), shapes.inputs[fibre].max())
        np.testing.assert_allclose(shapes.inputs[fibre, :3], np.sqrt(own[:3] * largest), rtol=1e-6)
        np.testing.assert_allclose(shapes.targets[fibre, :3], own[:3])
    assert inputs.shape == (400, FIBRES, INPUTS)
    np.testing.assert_allclose(np.sqrt((targets[:, :, :3] ** 2).mean(axis=0)), 1)


def random_weights(fibres: int, rng: np.random.Generator) -> dict[str, NDArray[np.float32]]:
    hidden, outputs = 7, 2 * TARGETS
    shapes = {
        "first.w": (MEMBERS, fibres, INPUTS, hidden),
        "first.alive": (MEMBERS, fibres, hidden),
        "first.b": (MEMBERS, hidden),
        "hidden.w": (MEMBERS, hidden, hidden),
        "hidden.b": (MEMBERS, hidden),
        "last.w": (MEMBERS, fibres, hidden, outputs),
        "last.b": (MEMBERS, fibres, outputs),
    }
    return {name: (0.5 * rng.standard_normal(shape)).astype(np.float32) for name, shape in shapes.items()}


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), fibres=st.integers(1, 5))
def test_a_fibre_has_no_part_in_its_own_prediction_nor_have_lost_ones(seed: int, fibres: int) -> None:
    rng = np.random.default_rng(seed)
    weights = random_weights(fibres, rng)
    inputs = rng.standard_normal((3, fibres, INPUTS)).astype(np.float32)
    fibre_mask = rng.random((3, fibres)) < 0.7
    mean, spread = fibre_prediction.expected(weights, inputs, fibre_mask)
    for press in range(3):
        for fibre in range(fibres):
            others = [c for c in range(fibres) if c != fibre and fibre_mask[press, c]]
            means, variances = [], []
            for e in range(MEMBERS):
                h = weights["first.b"][e].astype(float)
                for c in others:
                    h = h + inputs[press, c] @ weights["first.w"][e, c] + weights["first.alive"][e, c]
                h = h / (1 + np.exp(-h))
                h = h @ weights["hidden.w"][e] + weights["hidden.b"][e]
                h = h / (1 + np.exp(-h))
                out = h @ weights["last.w"][e, fibre] + weights["last.b"][e, fibre]
                means.append(out[:TARGETS])
                variances.append(np.exp(2 * np.clip(out[TARGETS:], *fibre_prediction.LOG_SPREAD)))
            assert np.allclose(mean[press, fibre], np.mean(means, axis=0), atol=1e-4)
            total = np.mean(variances, axis=0) + np.var(means, axis=0)
            assert np.allclose(spread[press, fibre], np.sqrt(total), rtol=1e-3, atol=1e-4)


def test_the_trace_of_a_press_keeps_to_it_and_what_was_not_recorded_of_its_release_is_missing() -> None:
    readings = np.arange(100.0)[:, None] * [1.0, 2.0]
    whole = fibre_prediction.press_trace(readings, down_command=30, up_command=55, low=0, high=100)
    assert whole.shape == (2, TRACE)
    assert whole[0].tolist() == [*range(20, 50), *range(55, 75)]
    tight = fibre_prediction.press_trace(readings, down_command=30, up_command=34, low=28, high=36)
    assert tight[0].tolist() == [28] * 9 + [29] + [30, 31, 32, 33] + [33] * 16 + [34, 35] + [35] * 18
    readings = np.arange(100.0)[:, None] * [1.0, 2.0]
    # The next press begins before a reading of the release was taken.
    none = fibre_prediction.press_trace(readings, down_command=30, up_command=55, low=0, high=55)
    assert none[0, :-RELEASED].tolist() == [*range(20, 50)]
    assert np.isnan(none[:, -RELEASED:]).all()
    down_command, up_command = np.array([10, 50]), np.array([30, 70])
    for end in (70, 74, 90):
        cut_off, last = fibre_prediction.traces_of(readings[:end], down_command, up_command)[:, 0]
        assert cut_off[-RELEASED:].tolist() == [*range(30, 50)]
        assert np.array_equal(last, [*range(40, 70), *range(70, end), *[np.nan] * (90 - end)], equal_nan=True)
    # One that the next press cuts short is filled.
    cut_off, _ = fibre_prediction.traces_of(readings, down_command, np.array([45, 70]))[:, 0]
    assert cut_off[-RELEASED:].tolist() == [*range(45, 50), *[49] * 15]
