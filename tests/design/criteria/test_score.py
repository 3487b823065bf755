"""Scores of pads, whatever their size."""

from design import Contact, Morphology
from design.criteria.score import score


def test_many_fibres_and_many_losses_are_scored_in_bounded_time():
    """Of 2M = 32 fibres taken 5 at a time there are two hundred thousand losses: a sample stands for them."""
    terms = score(Morphology.straight(16), Contact(), lost=5)
    assert 0 < terms["ambiguity_lost_0"] <= terms["ambiguity_lost_5"]
