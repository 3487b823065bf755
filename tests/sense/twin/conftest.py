"""Printed pads of known truth, and what they answer."""

import numpy as np
import pytest

from padforge.benchmarks.twin import printed_pad
from padforge.design import Morphology
from padforge.design.twin import Twin
from padforge.sense.twin.as_built import Responses

PLAN = Morphology.random(2, knots=3, seed=5)


@pytest.fixture(scope="session")
def printed() -> Twin:
    """A pad of four fibres, one of them dead, laid off by 0.4 mm."""
    return printed_pad(PLAN, np.random.default_rng(3), lateral_offset_mm=0.4)


@pytest.fixture(scope="session")
def answers(printed: Twin) -> Responses:
    """What its live channels answer to 400 presses, noise included."""
    return responses_of(printed, 400)


def responses_of(twin: Twin, presses: int, seed: int = 0) -> Responses:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.5, 0.5, (presses, 2)) * twin.sensed_mm
    signals = twin.as_built_stretch(places)
    live = [channel for channel in twin.channels if channel.fibre is not None]
    volts = np.column_stack([channel.gain_v * signals[:, channel.fibre] for channel in live])
    volts += live[0].noise_v * rng.standard_normal(volts.shape)
    return Responses(places, volts, np.ones(volts.shape, bool))
