"""Simulated recordings and strokes: their form, the responses of plans and twins, and settings measured in them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from padforge.design import Contact, Morphology, Twin
from padforge.design.contact import relative_stretch
from padforge.design.settings import PadSettings
from padforge.design.twin import PARTS, PlanTransform, TwinChannel, TwinPart, TwinReadings, TwinResidual, TwinScatter
from padforge.sense import Recording, RigSettings, simulate
from padforge.sense.simulation.simulated_recording import (
    measure_rig_settings,
    measured_rig,
    model_like_twin,
    model_twin,
)
from padforge.sense.simulation.strokes import simulate_strokes
from tests.helpers.golden import Golden, json_text
from tests.helpers.rigs import KEEP_OUT, ideal_rig, quiet_rig

GRID = Morphology.straight(4)
PAD = Morphology.straight(2)
GAINS = (-0.06, -0.04, -0.05)
DISTANCE_MM, WEIGHT = 11.25 * np.linspace(0, 1.2, 9), np.append(np.exp(-0.5 * (np.linspace(0, 1.05, 8) / 0.5) ** 2), 0)


def twin_of(frame: PlanTransform | None = None, noise_v: float = 0.0, readings: TwinReadings | None = None) -> Twin:
    """Channel 1 is dead; 0, 2 and 3 read the fibres 3, 0 and 1 of a straight pad."""
    wired = [(3, GAINS[0]), (None, 0.0), (0, GAINS[1]), (1, GAINS[2])]
    channels = tuple(TwinChannel(c, fibre, gain, noise_v, 0.9) for c, (fibre, gain) in enumerate(wired))
    as_built = *(PAD.to_mm(line) for line in PAD.knots[[0, 1]]), None, PAD.to_mm(PAD.knots[3])
    profile = DISTANCE_MM, WEIGHT
    return Twin(PAD, channels, frame or PlanTransform(), *profile, as_built, 0.02, (22.5, 22.5), 900, readings=readings)


def responses(recording: Recording, readings: int = 40) -> np.ndarray:
    """(Q, C) V, means while held minus the rest before, of cycles of so many readings."""
    cycles, half = recording.readings.reshape(len(recording.presses_mm), readings, -1), readings // 2
    return cycles[:, half + 10 :].mean(axis=1) - cycles[:, half - 12 : half].mean(axis=1)


def test_simulate_presses_all_that_is_sensed_as_deep_as_the_contact() -> None:
    recording = simulate(GRID, RigSettings(presses=400))
    assert np.abs(recording.presses_mm).max() <= 22.5
    assert np.abs(recording.presses_mm).max(axis=0).min() > 21
    strip = simulate(GRID, RigSettings(presses=400), size=PadSettings(sensed_mm=(50, 8)))
    assert strip.source["sensed_mm"] == [50, 8]
    np.testing.assert_allclose(np.abs(strip.presses_mm).max(axis=0), [25, 4], rtol=0.02)
    for rig, depth_mm in ((RigSettings(presses=4), 2.0), (RigSettings(presses=4, depth_mm=4.0), 4.0)):
        assert set(simulate(PAD, rig, Contact(depth_mm=2.0)).depths_mm) == {depth_mm}


def test_source_and_readings_of_a_simulated_recording(golden: Golden) -> None:
    recording = simulate(PAD, RigSettings(presses=3, seed=1))
    shown = {"source": dict(recording.source)} | {
        name: np.round(getattr(recording, name), 4)
        for name in ("presses_mm", "down_command", "up_command", "depths_mm")
    }
    shown |= {"times_s": recording.times_s[:4], "readings_v": np.round(recording.readings[15::20], 4)}
    golden("simulation/recording.json", json_text(shown))


@pytest.mark.parametrize(("contact", "least", "most"), [(Contact(), 8, 16), (Contact(model="profile"), 3.8, 4.2)])
def test_simulate_responds_by_depth(contact: Contact, least: float, most: float) -> None:
    """A layer is pressed wider as well as deeper; a profile grows in proportion to the depth."""
    depths = ((1.0,), (4.0,), (1.0, 4.0))
    light, deep, mixed = (simulate(GRID, quiet_rig(presses=40, depths_mm=each), contact=contact) for each in depths)
    assert mixed.depths_mm.tolist() == [1.0, 4.0] * 20
    assert np.array_equal(mixed.presses_mm, deep.presses_mm)
    cycles = [each.readings.reshape(40, 40, 8) for each in (light, deep, mixed)]
    assert np.array_equal(cycles[2][0::2, 20:], cycles[0][0::2, 20:])
    assert np.array_equal(cycles[2][1::2, 20:], cycles[1][1::2, 20:])
    swing = [np.abs(each[:, 39] - each[:, 15]).sum() for each in cycles[:2]]
    assert least < swing[1] / swing[0] < most


def test_simulate_twin_has_its_wiring_gains_and_noise() -> None:
    twin = twin_of(PlanTransform(turn_deg=5, shift_mm=(2, -1), scale=0.9))
    recording = simulate(twin, quiet_rig(presses=200))
    expected = np.zeros((200, 4))
    expected[:, [0, 2, 3]] = GAINS * twin.as_built_stretch(recording.presses_mm)[:, [3, 0, 1]]
    result = responses(recording)
    assert result == pytest.approx(expected, abs=4e-3)  # creep of the press before, and steps of the converter
    assert np.corrcoef(result[:, 0], expected[:, 0])[0, 1] > 0.999
    assert result[:, [0, 2, 3]].min(axis=0) == pytest.approx(expected[:, [0, 2, 3]].min(axis=0), rel=0.05)
    # it is reproducible, and its dead channel has noise alone
    twin, rig = twin_of(noise_v=0.02), quiet_rig(presses=200, noise_mv=2.0)
    recording = simulate(twin, rig)
    assert recording == simulate(twin, rig) != simulate(twin, rig.model_copy(update={"seed": 4}))
    dead, live = recording.readings[:, 1], recording.readings[:, 0]
    assert dead.std() == pytest.approx(2e-3, rel=0.05)
    assert live.std() > 5 * dead.std()


def test_model_twin_follows_the_plan_transform() -> None:
    positions = np.array([[4.0, 3.0], [-7.0, 1.0], [2.0, -9.0]])
    plain, mirrored = (model_twin(twin_of(PlanTransform(mirrored=mirrored)), ideal_rig()) for mirrored in (False, True))
    depths = np.full(3, 5.0)
    straight = plain.responses(positions, depths).held
    assert mirrored.responses(positions * [-1, 1], depths).held == pytest.approx(straight)
    assert np.abs(mirrored.responses(positions, depths).held - straight).max() > 0.01
    size = PadSettings(keep_out_mm=(KEEP_OUT,))  # of the plan, so on the other side if mirrored
    free = model_twin(twin_of(PlanTransform(mirrored=True)), ideal_rig(), size).free
    assert free(np.array([[5.0, 0.0], [-5.0, 0.0]])).tolist() == [True, False]
    twin = replace(twin_of(), sensed_mm=(20.0, 10.0))
    for turn_deg, sides in ((0, (20, 10)), (90, (10, 20)), (180, (20, 10))):
        recording = simulate(replace(twin, frame=PlanTransform(turn_deg=turn_deg)), RigSettings(presses=400))
        assert np.ptp(recording.presses_mm, axis=0) == pytest.approx(sides, rel=0.02)
    turned = replace(twin, frame=PlanTransform(turn_deg=10, scale=0.8))
    half = np.array(model_twin(turned, ideal_rig()).corners_mm[1])
    spans = np.ptp(turned.frame.to_plan(half * [[-1, -1], [-1, 1], [1, 1], [1, -1]]), axis=0)
    assert spans == pytest.approx((20, 10))


@pytest.mark.parametrize("rig", [{}, {"drift_mv": 100.0, "noise_mv": 5.0}])
def test_simulate_twin_scatters_by_its_noise(rig: dict) -> None:
    """What was measured takes precedence."""
    measured = {"noise_mv": 1.6, "drift_mv": 10.0, "hysteresis_s": 12.0} | rig
    twin = twin_of(noise_v=0.012, readings=TwinReadings(**measured))
    recording = simulate(twin, quiet_rig(presses=1500, scatter=0.3))
    assert recording.source["rig"].items() >= (measured | {"memory": 0.0, "scatter": 0.0}).items()
    expected = model_twin(twin, quiet_rig()).responses(recording.presses_mm, np.full(1500, 5.0)).held
    scatter = responses(recording) - expected
    assert scatter[:, [0, 2, 3]].std(axis=0) == pytest.approx(0.012, rel=0.08)


def test_simulate_twin_adds_what_is_left_of_the_parts() -> None:
    """Where its fibres answer nothing, a twin answers what a map says; creep and residues are lost from it."""
    part = TwinPart(DISTANCE_MM, WEIGHT, np.zeros(4))
    volts = np.zeros((4, 4, 2, 2))
    volts[0, 1], volts[3, 1, 0] = -0.05, -0.02  # held everywhere, and what remains where x is low
    residual = TwinResidual((0.0, 0.0), 11.25, volts)
    twin = replace(twin_of(), parts=dict.fromkeys(PARTS, part), residual=residual)
    recording = simulate(twin, quiet_rig(presses=60, hysteresis_s=0.5, readings_per_press=80))
    assert responses(recording, 80)[:, 1] == pytest.approx(-0.05, abs=1e-3)
    after = recording.readings[:, 1].reshape(60, 80)[1:, 4] - recording.readings[0, 1]
    x = recording.presses_mm[:-1, 0]
    assert np.corrcoef(after, x)[0, 1] < -0.95
    assert (after[x > 10] < 2e-3).all()


def test_a_pad_like_a_twin_has_the_median_of_its_gains_and_noise() -> None:
    """Of live channels: the dead one has most noise, and counts not; gains have the sign of most."""
    twin = replace(twin_of(), scatter=TwinScatter(floor=0.5, share=0.1, common=0.2))
    noise_v = (0.01, 0.9, 0.02, 0.09)
    channels = tuple(replace(each, noise_v=v) for each, v in zip(twin.channels, noise_v, strict=True))
    other = Morphology.straight(3)
    model = model_like_twin(other, replace(twin, channels=channels), ideal_rig())
    assert model.noise_v == pytest.approx(np.full(6, 0.5 * 0.02))
    positions_mm = np.array([[1.0, 2.0], [-5.0, 4.0]])
    half = model.responses(positions_mm, np.full(2, 2.5)).held
    expected = -0.05 / 2 * relative_stretch(other, other.to_grid(positions_mm), twin.contact())
    assert half == pytest.approx(expected, abs=1e-5)
    held = {"held": TwinPart(DISTANCE_MM, WEIGHT, 2 * np.insert(GAINS, 1, 0.0))}
    model = model_like_twin(other, replace(twin, channels=channels, parts=held), ideal_rig())
    assert model.responses(positions_mm, np.full(2, 2.5)).held == pytest.approx(2 * expected, abs=1e-5)
    measured = measured_rig(replace(twin, channels=channels), ideal_rig())
    assert (measured.scatter, measured.scatter_common) == (0.1, 0.2)


def test_measure_rig_settings_recovers_those_of_a_simulation() -> None:
    values = (3.0, 25.0, 6.0)
    names = ("noise_mv", "drift_mv", "hysteresis_s")
    rig: dict[str, Any] = dict(zip(names, values, strict=True))
    measured = measure_rig_settings(simulate(PAD, RigSettings(presses=1500, memory=0.0, **rig)))
    for name, value, rel in zip(names, values, (0.05, 0.3, 0.35), strict=True):
        assert measured[name] == pytest.approx(value, rel=rel), name
    # incomplete channels and few presses tell nothing
    assert measure_rig_settings(simulate(PAD, RigSettings(presses=90))) == {}
    recording = simulate(PAD, RigSettings(presses=200))
    readings = np.column_stack([recording.readings, np.full(len(recording.readings), 1.5), recording.readings[:, 0]])
    readings[1000, 5] = np.nan
    assert measure_rig_settings(replace(recording, readings=readings)) == measure_rig_settings(recording)
    assert measure_rig_settings(replace(recording, readings=readings[:, 4:])) == {}


WINDING, QUIET = Morphology.random(3, knots=5, seed=0), quiet_rig(presses=8)


def test_a_stroke_reads_as_a_press_where_the_finger_is() -> None:
    """On the pad of a simulated recording, whose fibres rest alike."""
    strokes = simulate_strokes(WINDING, QUIET, Contact(), 20.0, 3, np.random.default_rng(0))
    recording = strokes.recording
    np.testing.assert_array_equal(recording.readings[:19], simulate(WINDING, QUIET).readings[:19])
    held = recording.up_command[0] - recording.down_command[0]
    for stroke in range(3):
        for reading in (held // 2, held - 1):
            x, y = strokes.positions_mm[stroke, reading]
            volts = recording.readings[recording.down_command[stroke] + reading]
            resting = simulate_strokes(WINDING, QUIET, Contact(), 0.0, 1, _FixedStart((x, y)))  # type: ignore[arg-type]
            expected = resting.recording.readings[resting.recording.down_command[0] + reading]
            assert np.allclose(volts, expected, atol=1.7e-3)  # two steps of the converter


class _FixedStart:
    """A generator that starts the only stroke at a position."""

    def __init__(self, position: tuple[float, float]) -> None:
        self._position = position

    def uniform(self, low: object, high: object, size: object) -> np.ndarray:
        return np.array([self._position]) if isinstance(size, tuple) else np.zeros(8)


@pytest.mark.parametrize("speed", [0.0, 10.0, 50.0])
def test_strokes_go_straight_at_their_speed_and_stay_on_the_pad(speed: float) -> None:
    rig = RigSettings(presses=8)
    strokes = simulate_strokes(WINDING, rig, Contact(), speed, 20, np.random.default_rng(1))
    steps = np.diff(strokes.positions_mm, axis=1)
    assert np.allclose(steps, steps[:, :1])
    speeds = np.hypot(*steps[:, 0].T) * rig.rate_hz
    assert (speeds <= speed * (1 + 1e-9)).all()
    assert np.median(speeds) == pytest.approx(speed) or speed > 20
    assert np.abs(strokes.positions_mm).max() <= 1.5 * WINDING.unit_mm  # from the middle of what is sensed
    np.testing.assert_array_equal(strokes.recording.presses_mm, strokes.positions_mm[:, -1])  # where they end
