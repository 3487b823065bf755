"""A simulated pad of six fibres, and health learnt from its first presses."""

import pytest

from padforge.design import Morphology
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense import Recording
from padforge.sense import settings as sense_settings
from padforge.sense.health.health_model import HealthModel
from padforge.sense.simulation.simulated_recording import simulate
from tests.helpers.once import Once
from tests.sense.health.pads import PRESSES, learn


@pytest.fixture(scope="session")
def pad(once: Once) -> Recording:
    """The first PRESSES on a simulated pad of six fibres."""
    rig = sense_settings.RigSettings(presses=900, seed=1, drift_mv=10)
    whole = once("health-pad", lambda folder: simulate(Morphology.random(3, knots=3, seed=5), rig, PUBLISHED_CONTACT))
    end = int(whole.down_command[PRESSES])
    presses = {name: getattr(whole, name)[:PRESSES] for name in ("presses_mm", "down_command", "up_command")}
    return Recording(whole.readings[:end], whole.times_s[:end], **presses)


@pytest.fixture(scope="session")
def model(once: Once, pad: Recording) -> HealthModel:
    return once("health-model", lambda folder: learn(pad.readings, pad))
