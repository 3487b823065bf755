"""Ambiguity by place: its mean is that of the score, which has it by another way."""

import numpy as np
import pytest

from design import Contact, Morphology
from design.criteria.score import ambiguities, free_presses
from design.evaluation.ambiguity_map import ambiguity_map
from design.settings import PUBLISHED_CONTACT, PadSettings


@pytest.mark.parametrize(
    ("pad", "contact"),
    [
        (Morphology.straight(4), Contact()),
        (Morphology.random(4, 5, 1), Contact()),
        (Morphology.random((2, 5), 3, 2, (8.0, 13.0)), PUBLISHED_CONTACT),
        (Morphology.random((2, 5), 3, 2, (8.0, 5.0)), Contact()),
        (Morphology.straight((1, 0)), Contact()),
    ],
)
def test_its_mean_is_the_ambiguity_of_the_score(pad, contact):
    size = PadSettings().of(pad.layout)
    found = ambiguity_map(pad, free_presses(size), contact, 3, 0.05)
    assert found.mean(axis=1) == pytest.approx(
        ambiguities(pad, contact, 3, 0.05, size), rel=1e-3, abs=3e-4
    )  # in single precision
    assert (np.diff(found.mean(axis=1)) >= 0).all()


def test_it_is_where_presses_are_alike():
    """One fibre along x tells how far off it a press is, but not on which side: its own line alone is certain there."""
    pad = Morphology.straight((1, 0))
    presses = np.stack([np.ones(9), np.linspace(0.2, 1.8, 9)], axis=1)
    found = ambiguity_map(pad, presses, Contact(), 0, 1e-3)[0]
    assert found[4] == pytest.approx(0, abs=1e-9)
    assert found[:4] == pytest.approx(np.linspace(0.8, 0.2, 4), rel=1e-6)  # half of the way to the other side
    assert found[5:] == pytest.approx(found[:4][::-1])


def test_a_pad_that_feels_nothing_is_as_ambiguous_as_it_is_large():
    pad, presses = Morphology.straight(1), np.array([[9.0, 9.0], [10.0, 9.0]])
    assert ambiguity_map(pad, presses, Contact(), (1, 0), 0.05) == pytest.approx(np.full((2, 2), 0.5))
