"""A simulated pad of six fibres, and health learnt from its first presses."""

import pytest

from design import Morphology
from sense import Recording
from sense import settings as sense_settings
from sense.health.health_model import HealthModel
from sense.recordings.simulation import simulate
from tests.sense.health.pads import PRESSES, learn


@pytest.fixture(scope="session")
def pad() -> Recording:
    """PRESSES on a simulated pad of six fibres."""
    return simulate(
        Morphology.random(3, knots=3, seed=5), sense_settings.RigSettings(presses=PRESSES, seed=1, drift_mv=10)
    )


@pytest.fixture(scope="session")
def model(pad: Recording) -> HealthModel:
    return learn(pad.readings, pad)
