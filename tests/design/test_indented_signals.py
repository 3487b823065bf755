"""Signals and forces of presses of known depth, against solved contacts and closed forms of the half-space."""

import numpy as np

from padforge.design import Contact, Morphology, indented_signals, press_forces_n, signals
from padforge.design.layer import solve_press

PAD = Morphology.random(2, 3, 1)


def presses_on(pad: Morphology, count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.3, pad.grid + 0.7, (count, 2))


def test_indented_signals_are_those_of_solved_contacts() -> None:
    contact, presses = Contact(), presses_on(PAD, 12)
    full_scale = np.abs(signals(PAD, presses, contact)).max()
    depths_mm = (0.03, 1.3)
    interpolated = indented_signals(PAD, np.tile(presses, (2, 1)), np.repeat(depths_mm, len(presses)), contact)
    np.testing.assert_array_equal(indented_signals(PAD, presses[7:8], depths_mm[1], contact), interpolated[19:20])
    solved = [signals(PAD, presses, contact.model_copy(update={"depth_mm": each})) for each in depths_mm]
    np.testing.assert_allclose(interpolated, np.concatenate(solved), rtol=0, atol=0.01 * full_scale)
    deepest = indented_signals(PAD, presses, contact.depth_mm, contact)
    np.testing.assert_array_equal(deepest, signals(PAD, presses, contact))
    assert not indented_signals(PAD, presses, 0.0, contact).any()
    assert indented_signals(PAD, [], [], contact).shape == (0, 4)


def test_indented_signals_of_a_flat_end_grow_in_proportion_to_the_depth() -> None:
    contact, presses = Contact(tool="flat", tool_radius_mm=5.0), presses_on(PAD, 3)
    depths_mm = np.array([0.0, 0.02, 4.9])
    expected = depths_mm[:, None] / 5.0 * signals(PAD, presses, contact)
    np.testing.assert_allclose(indented_signals(PAD, presses, depths_mm, contact), expected, rtol=1e-6, atol=1e-9)


def test_press_forces_are_those_of_solved_contacts() -> None:
    contact, depths_mm = Contact(tool="ball", tool_radius_mm=6.0, base="slipping"), np.array([[0.0, 0.02], [1.3, 4.8]])
    solved = [
        solve_press("ball", 6.0, depth_mm, contact.thickness_mm, "slipping").force_n() if depth_mm else 0.0
        for depth_mm in depths_mm.ravel().tolist()
    ]
    deepest_n = float(press_forces_n(contact.depth_mm, contact))
    np.testing.assert_allclose(press_forces_n(depths_mm, contact).ravel(), solved, rtol=0, atol=5e-4 * deepest_n)
