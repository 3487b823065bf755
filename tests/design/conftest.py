from functools import partial
from pathlib import Path

import numpy as np
import pytest
import shapely

from padforge.design import Morphology, Twin, flatten
from padforge.design.morphology import assemble_knots
from padforge.design.published.objective import information
from padforge.design.settings import Layout
from padforge.design.twin import PlanTransform, TwinChannel, TwinScatter
from tests.helpers.less import compare_little

LAYOUT = Layout.create((2, 3), (10.0, 12.0))
"""40 by 36 mm: ends of horizontals at y = -6 and 6, of verticals at x = -10, 0 and 10."""
KNOTS_MM = (
    *([(-8, -9), (6, -2)], [(-8, 8), (6, -4)]),  # the second falls below the first
    *([(-19, -6), (-7, 6)], [(0, -5), (1, 7)], [(12, -4), (8, 8)]),  # the first comes near the border
)


def max_distance_mm(one: Morphology, other: Morphology) -> float:
    lines = ([shapely.LineString(pad.to_mm(line)) for line in flatten(pad, 1e-5)] for pad in (one, other))
    return max(a.hausdorff_distance(b) for a, b in zip(*lines, strict=True))


@pytest.fixture(scope="session")
def bent_pad() -> Morphology:
    """2 + 3 fibres of two knots each, some of which break rules."""
    knots = np.array(KNOTS_MM) / LAYOUT.unit_mm + np.array(LAYOUT.extent) / 2
    return Morphology.from_layout(assemble_knots(knots, LAYOUT), LAYOUT)


@pytest.fixture(scope="session")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a pad of grid 2 and pitch 10 mm, pressed somewhat beyond its outer fibres."""
    path = tmp_path_factory.mktemp("twin") / "twin.json"
    read = enumerate(((2, -0.1, 0.02), (0, -0.1, 0.02), (1, 0.4, 0.3)))  # the last is louder, and noisier still
    channels = tuple(TwinChannel(channel, fibre, gain, noise, 0.9) for channel, (fibre, gain, noise) in read)
    reach = np.array([0.0, 2, 5, 8, 11, 15]), np.array([1, 0.95, 0.6, 0.25, 0.05, 0])
    line = np.array([[-15.0, -5], [15, -5]])
    known = PlanTransform(), *reach, (line, line, line[:, ::-1], None), 0.03, (18.0, 31.5), 500
    Twin(Morphology.straight(2, 10.0), channels, *known, scatter=TwinScatter(0.05, 0.5, 0.8)).save(path)
    return path


@pytest.fixture
def little_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pads are compared by few presses, and information is bounded by the cells of a coarse grid."""
    compare_little(monkeypatch)
    monkeypatch.setattr("padforge.design.published.objective.information", partial(information, side=5))
