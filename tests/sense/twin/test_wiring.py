"""Wirings are found without a first guess."""

import numpy as np

from sense.twin.laid_pad import Plan
from sense.twin.responses import Responses
from sense.twin.wiring import assigned, wirings

from .conftest import PLAN


def test_channels_and_frame_are_found_first_of_all(printed, answers):
    found = wirings(Plan.of(PLAN), answers, np.random.default_rng(0))[0]
    assert found.fibres == tuple(channel.fibre for channel in printed.channels if channel.fibre is not None)
    assert found.frame.mirrored
    assert np.hypot(*np.subtract(found.frame.shift_mm, printed.frame.shift_mm)) < 1.0
    assert found.match > 0.9


def test_a_press_whose_channel_is_missing_does_not_count(printed, answers):
    volts, there = answers.volts.copy(), answers.there.copy()
    volts[::3, 0], there[::3, 0] = 5.0, False
    spoilt = Responses(answers.places_mm, volts, there)
    found = wirings(Plan.of(PLAN), spoilt, np.random.default_rng(0))[0]
    assert found.fibres == tuple(channel.fibre for channel in printed.channels if channel.fibre is not None)


def test_every_channel_gets_another_fibre_and_all_have_one_sign():
    alike = -np.array([[0.9, 0.8], [0.8, 0.1], [-1.0, -1.0]])
    match, fibres = assigned(alike)
    assert fibres == (1, 0)
    assert match == np.mean([0.8**2, 0.8**2])
