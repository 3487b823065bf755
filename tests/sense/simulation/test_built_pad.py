"""Simulated pads as built: switched off they are their plan, and else differ from it by as much as `[rig]` says."""

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from padforge.design import Contact, Morphology
from padforge.design.contact import signals, widened
from padforge.design.paths.curves import lengths
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense import RigSettings
from padforge.sense.settings import IDEAL_RIG
from padforge.sense.simulation.built_pad import BuiltPad, PressParts, build_pad, press_contacts

PLAN = Morphology.random((5, 3), 2, seed=2)
PRESSES_MM = np.random.default_rng(0).uniform(-15, 15, (20, 2))


def test_pad_as_planned_responds_as_its_plan() -> None:
    built = build_pad(PLAN, IDEAL_RIG)
    assert built.paths is PLAN
    expected = signals(PLAN, PLAN.to_grid(PRESSES_MM), Contact()) / lengths(PLAN)
    for part in built.stretch(PRESSES_MM, press_contacts(Contact(), IDEAL_RIG)):
        np.testing.assert_array_equal(part, expected)


def test_parts_of_a_press_are_as_wide_as_stated() -> None:
    rig = IDEAL_RIG.model_copy(update={"onset_width": 0.8, "after_width": 0.6})
    _, *parts = build_pad(PLAN, rig).stretch(PRESSES_MM, press_contacts(Contact(), rig))
    for part, width in zip(parts, (0.8, 0.6, 0.6), strict=True):
        narrow = signals(PLAN, PLAN.to_grid(PRESSES_MM), Contact(scale=width)) / lengths(PLAN)
        np.testing.assert_array_equal(part, narrow)


@pytest.mark.parametrize("contact", [Contact(model="profile"), PUBLISHED_CONTACT])
def test_any_contact_can_be_widened(contact: Contact) -> None:
    """A press that is twice as wide on a pad twice as large has twice the signals, and 1 changes nothing."""
    assert widened(contact, 1.0) is contact
    pad = Morphology.random(2, 3, seed=1, pitch_mm=10.0)
    large, presses = Morphology(pad.knots, 20.0), [[1.2, 0.9], [0.7, 1.6]]
    same = signals(large, presses, widened(contact, 2.0 if contact.model == "profile" else 1.0))
    np.testing.assert_allclose(same, signals(pad, presses, contact), rtol=1e-6, atol=1e-8)


def test_paths_and_sensitivities_deviate_as_stated() -> None:
    rig = RigSettings(path_mm=0.7, sensitivity=0.4, own_sensitivity=0.3)
    pads = [build_pad(PLAN, rig.model_copy(update={"seed": seed})) for seed in range(40)]
    at = np.linspace(0.1, 0.9, 30)
    offsets = [_across(pad.paths, at) - _across(PLAN, at) for pad in pads]  # ends stay, so more between them
    assert PLAN.unit_mm * np.std(offsets) == pytest.approx(0.7, rel=0.15)
    held, onset, creep, after = np.moveaxis(np.array([pad.sensitivities for pad in pads]), 1, 0)
    for part, std in ((held, 0.4), (onset / held, 0.3), (creep / held, 0.3), (after / held, 0.3)):
        rows = np.log(part)
        assert np.std(rows - rows.mean(axis=2, keepdims=True)) == pytest.approx(std, rel=0.1)
    assert np.mean(held) == pytest.approx(1.0)


def _across(pad: Morphology, shares: np.ndarray) -> np.ndarray:
    """Positions across the axes of the horizontal fibres, at shares of their length along it; grid units."""
    rows = pad.knots[: pad.layout.counts[0]]
    return np.array([PchipInterpolator(*row.T)(row[0, 0] + shares * np.ptp(row[:, 0])) for row in rows])


def test_sensitivity_weighs_the_elements_of_a_fibre() -> None:
    """A fibre that answers on its first half alone does not see presses beyond the middle."""
    ramp = np.repeat([[1.0, 1.0, 0.0, 0.0]], 8, axis=0)
    built = BuiltPad(Morphology.straight(4), PressParts(ramp, ramp, ramp, ramp))
    contacts = press_contacts(Contact(model="profile"), IDEAL_RIG)
    held = built.stretch(np.array([[-20.0, 5.6], [20.0, 5.6]]), contacts).held[:, :4]
    assert held[0].max() > 0.01
    assert held[1].max() < 0.05 * held[0].max()
