"""Traces become the numbers of the network, press by press, as the formulas say."""

import math

import numpy as np

from sense.health.fibre_prediction import COMPONENTS, INPUTS, REST, TARGETS, TRACE, History, Shapes, shapes_of

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
    shapes, inputs, targets = shapes_of(traces)
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
