from dataclasses import replace

import numpy as np
import pytest

from design.pad.morphology import Morphology
from design.settings import PadSettings
from fabricate.checks.plan_checks import check_plan
from fabricate.checks.plan_checks.fibre_strain import strains
from fabricate.mould.plan import Plan
from fabricate.settings import DEFAULTS, FibreSettings


def bent(pad: Morphology, radius: float, **fibre) -> Plan:
    own = PadSettings(**{**pad.layout.settings, "bent_radius_mm": radius})
    return Plan(pad, replace(DEFAULTS, pad=own, fibre=FibreSettings(**fibre)))


@pytest.mark.parametrize("radius", [5.0, 30.0, 1e6])
def test_straight_fibres_strain_as_a_bent_plate_does(radius):
    """Horizontals, 1.2 mm deep, lie 3 - 1.2 + 0.15 mm above the middle of 6 mm; verticals stay as they are."""
    shallow, deep = strains(bent(Morphology.straight((3, 2), (8.0, 15.0)), radius))
    assert (shallow.depth_mm, shallow.most) == (0.4, 0.0)
    assert deep.most == pytest.approx(1.95 / (radius + 3))


def test_a_fibre_at_an_angle_is_strained_by_the_square_of_its_cosine():
    knots = Morphology.straight((0, 1), 10.0).knots
    middle = np.array([[[0.7, 0.3], [1.3, 0.7]]])
    pad = Morphology(np.concatenate([knots[:, :1], middle, knots[:, 1:]], axis=1), 10.0, fibres=(0, 1))
    (found,) = strains(bent(pad, 20.0))
    steps = np.concatenate([np.diff(line.coords, axis=0) for line in bent(pad, 20.0).lines])
    steepest = np.abs(steps[:, 0] / steps[:, 1]).max()
    assert found.most == pytest.approx((3 - 0.4 + 0.15) / 23 * steepest**2 / (1 + steepest**2))


def test_fibres_below_the_middle_are_pressed():
    plan = bent(Morphology.straight((2, 0), 10.0), 20.0, diameter_mm=0.3)
    thin = Plan(
        plan.pad,
        replace(
            plan.settings,
            mould=plan.settings.mould.model_copy(
                update={"silicone_mm": 0.8, "shallow_ridge_height_mm": 0.6, "deep_ridge_height_mm": 0.7}
            ),
        ),
    )
    assert strains(thin)[0].most < 0


@pytest.mark.parametrize(("stretch", "status"), [(1.0, "pass"), (0.1, "warn"), (0.05, "fail")])
def test_it_is_judged_by_what_the_fibre_bears(stretch, status):
    found = [
        f
        for f in check_plan(bent(Morphology.straight(2, 10.0), 20.0, largest_stretch=stretch))
        if f.name == "fibre_strain"
    ]
    assert [finding.status for finding in found] == [status]
    assert found[0].measured == pytest.approx(1.95 / 23)


def test_a_flat_pad_is_not_judged():
    assert not strains(Plan(Morphology.straight(2)))
