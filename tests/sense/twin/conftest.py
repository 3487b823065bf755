"""Printed pads of known truth, and their responses."""

from functools import partial
from unittest.mock import patch

import numpy as np
import pytest

from padforge.benchmarks.twin import printed_pad
from padforge.design import Morphology
from padforge.design.twin import Twin
from padforge.sense.twin import identification
from padforge.sense.twin.responses import Responses

PLAN = Morphology.random(2, knots=3, seed=5)

few_compared = partial(patch.multiple, identification, N_COMPARED=80, N_CONTACT=24)
"""Candidates are compared by fewer presses, and the contact, which is measured elsewhere, fitted to few."""


@pytest.fixture(scope="session")
def printed() -> Twin:
    """A pad of four fibres, one of them dead, with lateral offsets of 0.4 mm."""
    return printed_pad(PLAN, np.random.default_rng(3), lateral_offset_mm=0.4)


@pytest.fixture(scope="session")
def responses(printed: Twin) -> Responses:
    """Noisy responses of its live channels to 400 presses."""
    return simulate_responses(printed, 400)


def simulate_responses(twin: Twin, presses: int, seed: int = 0) -> Responses:
    rng = np.random.default_rng(seed)
    positions_mm = rng.uniform(-0.5, 0.5, (presses, 2)) * twin.sensed_mm
    stretch = twin.as_built_stretch(positions_mm)
    live = [channel for channel in twin.channels if channel.fibre is not None]
    volts = np.column_stack([channel.gain_v * stretch[:, channel.fibre] for channel in live])
    volts += live[0].noise_v * rng.standard_normal(volts.shape)
    return Responses(positions_mm, volts, np.ones(volts.shape, bool))
