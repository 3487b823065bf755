"""A recording in which every quantity is known for some presses and missing for others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.sense import Recording, RigSettings, simulate
from padforge.sense.formats.ros_recording import export_bag


@pytest.fixture(scope="session")
def eight() -> Recording:
    """Eight presses: one without position, one without depth, one without force; some readings are missing."""
    plain = simulate(Morphology.straight(2), RigSettings(presses=8, depths_mm=(3.0, 4.3, 2.7)))
    readings, positions, depths = (np.array(each) for each in (plain.readings, plain.presses_mm, plain.depths_mm))
    readings[5, 1] = readings[70] = positions[2] = depths[3] = np.nan
    forces = np.linspace(0, 3, 8) ** 2 / 7
    forces[4] = np.nan
    return replace(
        plain, readings=readings, presses_mm=positions, depths_mm=depths, reached_mm=depths + 1 / 30, forces_n=forces
    )


@pytest.fixture(scope="session")
def bag(eight: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "eight.mcap"
    export_bag(eight, path)
    return path
