"""Settings of simulated pads that do no more than a test looks at."""

from typing import Any

from padforge.sense.settings import IDEAL_RIG, RigSettings


def ideal_rig(**values: Any) -> RigSettings:
    """Return settings of a pad laid as planned, with some of them changed."""
    return RigSettings(**IDEAL_RIG.model_dump() | values)


def quiet_rig(**values: Any) -> RigSettings:
    """Return such settings without noise, drift and scatter, and of which nothing remains of a press."""
    return ideal_rig(**{"noise_mv": 0.0, "drift_mv": 0.0, "scatter": 0.0, "hysteresis": 0.0} | values)
