from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Morphology, Twin, flatten
from padforge.design.contact import relative_stretch
from padforge.design.twin import PARTS, PlanTransform, TwinChannel, TwinPart, TwinReadings, TwinResidual, TwinScatter
from tests.helpers.golden import Golden

PAD = Morphology.random(2, knots=3, seed=5)
DISTANCE = np.linspace(0, 1.6, 9)
WEIGHT = np.append(np.exp(-0.5 * (DISTANCE[:-1] / 0.5) ** 2) - 0.05 * (DISTANCE[:-1] > 1.2), 0.0)
PLACES = np.random.default_rng(0).uniform(-11, 11, (30, 2))


@pytest.fixture
def twin() -> Twin:
    """A pad that lies as planned, its last fibre read by no channel, its second channel by no fibre."""
    read = (2, None, 0, 1)
    channels = tuple(TwinChannel(c, fibre, -0.05 * (fibre is not None), 0.002, 0.9) for c, fibre in enumerate(read))
    laid = (*(PAD.to_mm(line) for line in flatten(PAD, 1e-4)[:3]), None)
    frame = PlanTransform(True, 5.0, (2.0, -1.0), 0.95)
    return Twin(PAD, channels, frame, DISTANCE * PAD.pitch_mm, WEIGHT, laid, 0.015, (20.0, 22.0), 900)


READINGS = TwinReadings(noise_mv=2.0, drift_mv=18.0, hysteresis_s=14.0, memory=0.8, memory_mm=9.0, gain_wander=0.05)


def test_twin_file_round_trip(twin, tmp_path):
    uneven = tuple(None if line is None else np.linspace(0.8, 1.2, len(line) - 1) for line in twin.as_built_mm)
    narrow = TwinPart(0.7 * twin.distance_mm, WEIGHT, np.array([-0.03, 0.0, -0.02, -0.04]), sensitivity=uneven)
    whole = replace(
        twin,
        **{"sensitivity": uneven, "angular_weight": 0.1 * WEIGHT, "readings": READINGS},
        scatter=TwinScatter(0.1, 0.3, 0.9),
        parts=dict.fromkeys(PARTS, narrow),
        residual=TwinResidual((1.0, -2.0), 11.0, np.random.default_rng(0).uniform(-1e-3, 1e-3, (4, 4, 5, 5))),
    )
    for each in (twin, whole):
        each.save(tmp_path / "twin.json")
        back = Twin.load(tmp_path / "twin.json")
        back.save(tmp_path / "again.json")
        assert (tmp_path / "again.json").read_bytes() == (tmp_path / "twin.json").read_bytes()
        for name in ("channels", "frame", "noise", "sensed_mm", "presses", "readings", "scatter", "morphology"):
            assert getattr(back, name) == getattr(each, name)
        for part in (None, *each.parts):
            expected = each.as_built_stretch(PLACES, part)
            assert back.as_built_stretch(PLACES, part) == pytest.approx(expected, abs=1e-3)
    assert back.parts["after"].gains_v == pytest.approx(narrow.gains_v)
    assert back.residual is not None
    assert back.residual.volts == pytest.approx(whole.residual.volts, abs=1e-6)


def test_as_built_stretch_matches_the_contact_model(twin):
    exact = relative_stretch(PAD, PAD.to_grid(twin.frame.to_plan(PLACES)), twin.contact())
    assert twin.as_built_stretch(PLACES)[:, :3] == pytest.approx(exact[:, :3], abs=1e-3)
    assert not twin.as_built_stretch(PLACES)[:, 3].any()
    double = replace(twin, sensitivity=tuple(None if x is None else np.full(len(x) - 1, 2.0) for x in twin.as_built_mm))
    assert double.as_built_stretch(PLACES) == pytest.approx(2 * twin.as_built_stretch(PLACES))
    straight = np.column_stack([np.linspace(-20, 20, 400), np.zeros(400)])
    plain = replace(twin, as_built_mm=(straight, None, None, None), frame=PlanTransform())
    angled = replace(plain, angular_weight=0.5 * WEIGHT)
    over, beside = np.array([[0.0, 0.0], [0.0, 12.0]])
    assert angled.as_built_stretch([over])[0, 0] > plain.as_built_stretch([over])[0, 0]
    assert angled.as_built_stretch([beside])[0, 0] < plain.as_built_stretch([beside])[0, 0]
    planned = PlanTransform(True, 90.0, (1.0, 2.0), 2.0).to_plan(np.array([[3.0, 0.5]]))
    assert planned == pytest.approx(np.array([[0.0, -4.0]]))


def test_effects_that_another_pad_does_not_have(twin: Twin, golden: Golden) -> None:
    """None where the response is the same along each fibre; their standard deviation, averaged over the fibres."""
    sizes = [None if line is None else len(line) - 1 for line in twin.as_built_mm]
    even = tuple(None if size is None else np.full(size, 1.01) for size in sizes)
    all_uneven = tuple(None if size is None else np.linspace(0.5, 1.5, size) for size in sizes)
    changes = {}, {"sensitivity": even}, {"sensitivity": (all_uneven[0], *even[1:])}, {"angular_weight": 0.1 * WEIGHT}
    both = {"sensitivity": all_uneven, "angular_weight": 0.1 * WEIGHT}
    effects = [str(replace(twin, **each).ignored_effects()) for each in (*changes, both)]
    golden("design/twin_effects.txt", "\n".join(effects))
