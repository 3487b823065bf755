"""Scale and shares of a contact, from responses whose contact is known."""

import numpy as np
import pytest

from padforge.design.contact import signals
from padforge.design.layer import Base
from padforge.design.settings import Contact
from padforge.design.twin import PlanTransform
from padforge.sense.twin.as_built import AsBuiltPad, PadPlan
from padforge.sense.twin.contact_fit import fit_contact
from padforge.sense.twin.responses import Responses

from .conftest import PLAN


def press(contact: Contact, transform: PlanTransform, presses: int) -> Responses:
    positions_mm = np.random.default_rng(0).uniform(-14, 14, (presses, 2))
    volts = 0.3 - 0.5 * signals(PLAN, PLAN.to_grid(transform.to_plan(positions_mm)), contact)
    return Responses(positions_mm, volts, np.random.default_rng(1).uniform(size=volts.shape) < 0.95)


@pytest.mark.parametrize("base", ["bonded", "slipping"])
def test_fit_contact_recovers_scale_and_shares(base: Base) -> None:
    stated = Contact(base=base)
    pressed = Contact(base=base, scale=1.15, squeeze=0.7, stretch=1.3)
    responses = press(pressed, PlanTransform(True, 3.0, (1.0, -0.5), 1.02), 100)
    training, held_out = responses.select(np.arange(70)), responses.select(np.arange(70, 100))
    pad = AsBuiltPad.from_plan(PadPlan.from_morphology(PLAN), (0, 1, 2, 3), PlanTransform(True), 0.5)
    noise_v = 0.05 * np.sqrt(training.variance)
    fit = fit_contact(pad, stated, training, held_out, noise_v)
    assert fit.scale == pytest.approx(1.15, abs=0.03)
    assert (fit.squeeze, fit.stretch) == pytest.approx((0.7, 1.3), abs=0.1)
    assert fit.explained > 0.995
    assert 0 < fit.scale_std < 0.1 > fit.shares_std > 0
    gaussian = fit_contact(pad, Contact(model="profile"), training, held_out, noise_v)
    assert gaussian.explained < fit.explained
    assert gaussian.shares_std == 0


def test_fit_contact_states_shares_of_the_sum_that_was_stated() -> None:
    """Gains take up any other: twice the squeeze and stretch are twice the results, and as uncertain as a share.

    A layer half as large is the same at twice the scale, which is twice as uncertain.
    """
    responses = press(Contact(squeeze=0.7, stretch=1.3), PlanTransform(), 24)
    pad = AsBuiltPad.from_plan(PadPlan.from_morphology(PLAN), (0, 1, 2, 3), PlanTransform(), 0.5)
    noise_v = 0.05 * np.sqrt(responses.variance)
    single, double = (
        fit_contact(pad, Contact(squeeze=share, stretch=share), responses, responses, noise_v) for share in (0.5, 1.0)
    )
    for name in ("squeeze", "stretch", "shares_std"):
        assert getattr(double, name) == pytest.approx(2 * getattr(single, name), rel=1e-3)
    assert (double.scale, double.scale_std) == pytest.approx((single.scale, single.scale_std), rel=1e-3)
    sizes = {name: getattr(Contact(), name) / 2 for name in ("tool_radius_mm", "depth_mm", "thickness_mm")}
    first_mm, second_mm = Contact().fibre_depths_mm
    halved = Contact(**sizes, fibre_depths_mm=(first_mm / 2, second_mm / 2), scale=2.0)
    small = fit_contact(pad, halved, responses, responses, noise_v)
    assert small.scale == pytest.approx(2 * double.scale, rel=1e-3)
    assert small.scale_std == pytest.approx(2 * double.scale_std, rel=0.05)


def test_elements_of_a_pad_sum_to_its_lengths_and_follow_its_offsets() -> None:
    plan = PadPlan.from_morphology(PLAN)
    pad = AsBuiltPad.from_plan(plan, (2, 0), PlanTransform(), 0.5)
    middles, lengths, tangents = pad.elements(0)
    assert lengths == pytest.approx(plan.lengths[2])
    assert tangents == pytest.approx(plan.tangents[2])
    pad = pad.with_values(pad.values + 0.05 * np.random.default_rng(0).standard_normal(pad.values.size))
    middles, weighted, tangents = pad.elements(0)
    steps = np.gradient(middles, axis=0)[1:-1]
    lengths = np.hypot(*steps.T)
    assert tangents[1:-1] == pytest.approx(steps / lengths[:, None], abs=0.1)
    assert weighted[1:-1] == pytest.approx(lengths * pad.path(0)[1][1:-1], rel=0.1)
