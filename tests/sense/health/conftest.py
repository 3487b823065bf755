"""A simulated pad of six fibres, and a model of its first presses."""

import pytest

from padforge.design import Morphology
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense import HealthModel, Recording, RigSettings, simulate
from tests.helpers.once import Once
from tests.sense.health.pads import PRESSES, fit, part_of


@pytest.fixture(scope="session")
def pad(once: Once) -> Recording:
    """The first PRESSES on a simulated pad of six fibres."""
    winding, rig = Morphology.random(3, knots=3, seed=5), RigSettings(presses=900, seed=1, drift_mv=10)
    recording = once("health-pad", lambda folder: simulate(winding, rig, PUBLISHED_CONTACT))
    return part_of(recording, 0, PRESSES, int(recording.down_command[PRESSES]))


@pytest.fixture(scope="session")
def model(once: Once, pad: Recording) -> HealthModel:
    return once("health-model", lambda folder: fit(pad.readings, pad))
