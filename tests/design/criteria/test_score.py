"""Scores of pads, whatever their size."""

import math

import pytest
import torch

from design import InputError, Morphology
from design.criteria.ambiguity import ambiguity, full_scale
from design.criteria.published_objective import published_terms
from design.criteria.score import ambiguities, free_presses, score
from design.pad.contact import signals
from design.settings import PUBLISHED_CONTACT, PadSettings


def test_many_fibres_and_many_losses_are_scored_in_bounded_time():
    """Of 2M = 32 fibres taken 5 at a time there are two hundred thousand losses: a sample stands for them."""
    terms = score(Morphology.straight(16), PUBLISHED_CONTACT, lost=5)
    assert 0 < terms["ambiguity_lost_0"] <= terms["ambiguity_lost_5"]


def test_a_pad_is_scored_where_it_is_pressed():
    """The published terms and the information are of presses between the fibres, wherever else it is pressed."""
    pad = Morphology.random(3, 4, seed=1)
    beyond, between, wide = (
        score(pad, lost=1, size=PadSettings(sensed_mm=where)) for where in ("beyond", "fibres", (40, 20))
    )
    for name in beyond:
        same = name.startswith(("published", "information", "penalty"))
        assert (beyond[name] == between[name] == wide[name]) == same
    assert score(pad, lost=1) == beyond
    with pytest.raises(InputError, match="the pad itself is 45 mm wide"):
        score(pad, size=PadSettings(sensed_mm=(46, 20)))


def test_the_joint_entropy_of_all_fibres_saturates_where_those_of_the_families_do_not():
    """49 presses give no more than log2 49 bits, and straight fibres have them."""
    pad = Morphology.straight(4)
    assert score(pad, lost=0)["published_joint_entropy"] == pytest.approx(math.log2(49))
    assert published_terms(pad)[0].entropy < 9
    one = score(Morphology.straight((1, 0)), lost=0)  # one family is all there is
    assert one["published_joint_entropy"] == one["published_entropy"]


@pytest.mark.parametrize("name", ["1para", "5para_dis", "20para"])
def test_the_joint_entropy_of_the_published_pads_is_saturated(published, name):
    terms = score(Morphology.load(published / f"{name}.mat"), lost=0)
    assert terms["published_joint_entropy"] == pytest.approx(math.log2(49))


def test_fibres_that_no_press_touches_change_no_ambiguity():
    """Of 64 x 64 fibres a lattice of presses misses most, which `ambiguities` leaves out."""
    pad, contact, size = Morphology.straight(64), PUBLISHED_CONTACT, PadSettings(grid=64)
    presses = free_presses(size)
    found = torch.tensor(signals(pad, presses, contact).T, dtype=torch.float32)
    assert not found.any(dim=1).all()
    noise = 0.01 * full_scale(found)
    places, one = torch.tensor(presses, dtype=torch.float32), torch.ones(1)
    whole = ambiguity(found, places, torch.ones(1, len(found)), one, noise).item()
    assert ambiguities(pad, contact, 0, 0.01, size) == pytest.approx([whole], rel=1e-6)
