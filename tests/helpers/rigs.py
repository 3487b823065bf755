"""Settings of simulated pads that do no more than a test looks at, and of rigs as a file."""

from typing import Any

from padforge.common.settings import commented_toml
from padforge.design.settings import PadSettings
from padforge.sense.settings import IDEAL_RIG, RigSettings

KEEP_OUT = ((2.0, -6.0), (9.0, -6.0), (9.0, 6.0), (2.0, 6.0))
RECTANGLE = PadSettings(horizontals=3, verticals=2, pitch_mm=(8.0, 15.0), keep_out_mm=(KEEP_OUT,))
"""Of a pad that is not square, with a hole."""


def ideal_rig(**values: Any) -> RigSettings:
    return RigSettings(**IDEAL_RIG.model_dump() | values)


def quiet_rig(**values: Any) -> RigSettings:
    """Return such settings without noise, drift and scatter, and of which nothing remains of a press."""
    return ideal_rig(**{"noise_mv": 0.0, "drift_mv": 0.0, "scatter": 0.0, "hysteresis": 0.0} | values)


def rig_toml(rig: RigSettings, grid: int) -> str:
    """Return the text of a pad.toml with these settings of the rig, and with straight fibres, `grid` each way."""
    models = {"pad": PadSettings, "rig": RigSettings}
    return commented_toml(models, {"pad": PadSettings(grid=grid), "rig": rig})
