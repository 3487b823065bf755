"""Simulated pads as built, their physical model, recordings and strokes, and settings that are measured in them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from padforge.design import Contact, Morphology, Twin, signals
from padforge.design.contact import relative_stretch, widened
from padforge.design.paths.curves import lengths
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings
from padforge.design.twin import PARTS, PlanTransform, TwinChannel, TwinPart, TwinReadings, TwinResidual, TwinScatter
from padforge.sense import Recording, RigSettings, simulate
from padforge.sense.settings import IDEAL_RIG
from padforge.sense.simulation import pad_model
from padforge.sense.simulation.built_pad import BuiltPad, PressParts, build_pad, press_contacts
from padforge.sense.simulation.pad_model import ADC_STEPS, RETURNED, SUPPLY_V, Strain, Viscoelasticity
from padforge.sense.simulation.simulated_recording import measure_rig_settings, model_twin
from padforge.sense.simulation.strokes import simulate_strokes
from tests.helpers.golden import Golden, json_text
from tests.helpers.rigs import KEEP_OUT, ideal_rig, quiet_rig

PLAN = Morphology.random((5, 3), 2, seed=2)
PRESSES_MM = np.random.default_rng(0).uniform(-15, 15, (20, 2))


def test_pad_as_planned_responds_as_its_plan() -> None:
    built = build_pad(PLAN, IDEAL_RIG)
    assert built.paths is PLAN
    expected = signals(PLAN, PLAN.to_grid(PRESSES_MM), Contact()) / lengths(PLAN)
    for part in built.stretch(PRESSES_MM, press_contacts(Contact(), IDEAL_RIG)):
        np.testing.assert_array_equal(part, expected)
    # parts of a press are as wide as stated
    rig = IDEAL_RIG.model_copy(update={"onset_width": 0.8, "after_width": 0.6})
    _, *parts = build_pad(PLAN, rig).stretch(PRESSES_MM, press_contacts(Contact(), rig))
    for part, width in zip(parts, (0.8, 0.6, 0.6), strict=True):
        narrow = signals(PLAN, PLAN.to_grid(PRESSES_MM), Contact(scale=width)) / lengths(PLAN)
        np.testing.assert_array_equal(part, narrow)


@pytest.mark.parametrize("contact", [Contact(model="profile"), PUBLISHED_CONTACT])
def test_any_contact_can_be_widened(contact: Contact) -> None:
    """A press that is twice as wide on a pad twice as large has twice the signals, and 1 changes nothing."""
    assert widened(contact, 1.0) is contact
    pad = Morphology.random(2, 3, seed=1, pitch_mm=10.0)
    large, presses = Morphology(pad.knots, 20.0), [[1.2, 0.9], [0.7, 1.6]]
    same = signals(large, presses, widened(contact, 2.0 if contact.model == "profile" else 1.0))
    np.testing.assert_allclose(same, signals(pad, presses, contact), rtol=1e-6, atol=1e-8)


def test_paths_and_sensitivities_deviate_as_stated() -> None:
    rig = RigSettings(path_mm=0.7, sensitivity=0.4, own_sensitivity=0.3)
    pads = [build_pad(PLAN, rig.model_copy(update={"seed": seed})) for seed in range(40)]
    at = np.linspace(0.1, 0.9, 30)
    offsets = [_across(pad.paths, at) - _across(PLAN, at) for pad in pads]  # ends stay, so more between them
    assert PLAN.unit_mm * np.std(offsets) == pytest.approx(0.7, rel=0.15)
    held, onset, creep, after = np.moveaxis(np.array([pad.sensitivities for pad in pads]), 1, 0)
    for part, std in ((held, 0.4), (onset / held, 0.3), (creep / held, 0.3), (after / held, 0.3)):
        rows = np.log(part)
        assert np.std(rows - rows.mean(axis=2, keepdims=True)) == pytest.approx(std, rel=0.1)
    assert np.mean(held) == pytest.approx(1.0)


def _across(pad: Morphology, shares: np.ndarray) -> np.ndarray:
    """Positions across the axes of the horizontal fibres, at shares of their length along it; grid units."""
    rows = pad.knots[: pad.layout.counts[0]]
    return np.array([PchipInterpolator(*row.T)(row[0, 0] + shares * np.ptp(row[:, 0])) for row in rows])


def test_sensitivity_weighs_the_elements_of_a_fibre() -> None:
    """A fibre that answers on its first half alone does not see presses beyond the middle."""
    ramp = np.repeat([[1.0, 1.0, 0.0, 0.0]], 8, axis=0)
    built = BuiltPad(Morphology.straight(4), PressParts(ramp, ramp, ramp, ramp))
    contacts = press_contacts(Contact(model="profile"), IDEAL_RIG)
    held = built.stretch(np.array([[-20.0, 5.6], [20.0, 5.6]]), contacts).held[:, :4]
    assert held[0].max() > 0.01
    assert held[1].max() < 0.05 * held[0].max()


GRID = Morphology.straight(4)


@pytest.mark.parametrize(("distance_mm", "share"), [(0.0, 0.8), (10.0, 0.8 * np.exp(-0.5)), (60.0, 0.0)])
def test_press_takes_away_residues_near_it(distance_mm: float, share: float) -> None:
    """As far as both reach a fibre, and a part of that comes back; what it took is gone for the next one."""
    rig = RigSettings(memory=0.8, memory_mm=10.0, hysteresis_s=20.0)
    positions_mm = np.array([[0.0, 0.0], [distance_mm, 0.0], [distance_mm, 0.0]])
    touch_s, release_s = np.array([0.0, 3.0, 6.0]), np.array([1.0, 4.0, 7.0])
    residues, held = np.zeros((3, 2)), np.array([[0.2, -0.2], [0.01, -0.01], [0.04, 0.01]])
    residues[0] = 0.04, -0.04
    presses = positions_mm, touch_s, release_s, residues, held
    replaced = pad_model.replaced_residues(*presses, rig)
    assert not replaced[0].any()
    assert replaced[1] == pytest.approx(share * np.exp(-0.1) * np.array([0.02, -0.02]), abs=1e-9)
    left = 1 - (1 - RETURNED) * share
    assert replaced[2] == pytest.approx([left * share * np.exp(-0.25) * 0.04, 0.0], abs=1e-9)
    assert not pad_model.replaced_residues(*presses, rig.model_copy(update={"memory": 0.0})).any()


def test_divider_and_adc() -> None:
    """A fibre that has grown by as much as itself and its resistor together halves the voltage."""
    rest = np.linspace(0.5, 3, 26)
    np.testing.assert_allclose(pad_model.divider_voltage(rest, np.zeros(26)), rest)
    np.testing.assert_allclose(pad_model.divider_voltage(rest, SUPPLY_V / (SUPPLY_V - rest)), rest / 2)
    volts = np.linspace(-1, 5, 1001)
    counts, exact = (each / SUPPLY_V * ADC_STEPS for each in (pad_model.adc_volts(volts), np.clip(volts, 0, SUPPLY_V)))
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.abs(counts - exact).max() <= (1 + 1e-9) / 2


def test_drift_is_an_ornstein_uhlenbeck_process() -> None:
    drift = pad_model.Drift(200, 13.3, np.random.default_rng(0))(10_000)
    assert drift.std() == pytest.approx(1, rel=0.05)
    assert np.diff(drift, axis=0).std() == pytest.approx(np.sqrt(2 / (13.3 * 600)), rel=0.02)


def test_streams_do_not_depend_on_the_size_of_blocks() -> None:
    pieces, rng = [1, 7, 1, 40, 3], np.random.default_rng(0)
    strain = Strain(*rng.uniform(0, 2, (3, sum(pieces), 3)))
    model, cuts = Viscoelasticity(13.3, RigSettings()), np.cumsum(pieces)[:-1]
    parts = [model(Strain(*part)) for part in zip(*(np.split(each, cuts) for each in strain), strict=True)]
    np.testing.assert_allclose(np.vstack(parts), Viscoelasticity(13.3, RigSettings())(strain))
    drift, again = (pad_model.Drift(2, 13.3, np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_allclose(np.vstack([drift(n) for n in pieces]), again(sum(pieces)))


def test_held_presses_follow_the_relative_stretch() -> None:
    """A fibre's resistance grows by 0.4 of its relative stretch at 5 mm."""
    recording = simulate(GRID, quiet_rig(presses=400), PUBLISHED_CONTACT)
    cycles = recording.readings.reshape(400, 40, 8)
    rest, stretch = cycles[:, 15], relative_stretch(GRID, GRID.to_grid(recording.presses_mm), PUBLISHED_CONTACT)
    held = 3.3 / (1 + (3.3 / rest - 1) * (1 + 0.4 * stretch))
    np.testing.assert_allclose(cycles[:, 35], held, atol=1.6 * 3.3 / 4095)


def test_presses_have_the_published_delays_and_travel() -> None:
    fast = simulate(GRID, quiet_rig(presses=100, rate_hz=1000.0, readings_per_press=2000))
    fibre = np.abs(fast.readings - fast.readings[0]).reshape(100, 2000, 8).max(axis=2)
    strong = fibre.max(axis=1) > 0.03
    touched = np.argmax(fibre[strong, 1000:] > 0, axis=1)
    arrived = np.argmax(fibre[strong, 1000:] >= fibre[strong, 1900:1901], axis=1)
    assert (touched.min() / 1000, touched.max() / 1000) == pytest.approx((0.04, 0.22), abs=0.012)
    assert np.median(arrived - touched) / 1000 == pytest.approx(0.1, abs=0.01)


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


def test_live_pad_responds_in_proportion_to_depth() -> None:
    model = pad_model.LivePad(PAD, PUBLISHED_CONTACT, quiet_rig(), 1000.0, np.random.default_rng(0))
    volts = model.volts(np.tile([-5.0, 7.0], (80, 1)), np.repeat([-5.0, 0.0, 2.5, 5.0], 20))
    rest, above, half, full = volts[10::20]
    np.testing.assert_array_equal(above, rest)
    np.testing.assert_allclose(rest - half, (rest - full) / 2, atol=0.05 * np.ptp(rest - full))


def test_simulate_presses_all_that_is_sensed_as_deep_as_the_contact() -> None:
    recording = simulate(GRID, RigSettings(presses=400))
    assert np.abs(recording.presses_mm).max() <= 22.5
    assert np.abs(recording.presses_mm).max(axis=0).min() > 21
    strip = simulate(GRID, RigSettings(presses=400), pad_settings=PadSettings(sensed_mm=(50, 8)))
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
    # a twin whose fibres answer to no part of a press, and a pad like a twin with one part: of the dead channel, whose
    # noise is the greatest, nothing counts
    volts = np.zeros((4, 4, 2, 2))
    volts[0, 1], volts[3, 1, 0], nothing = -0.05, -0.02, TwinPart(DISTANCE_MM, WEIGHT, np.zeros(4))
    residual = TwinResidual((0.0, 0.0), 11.25, volts)
    left = replace(twin_of(), parts=dict.fromkeys(PARTS, nothing), residual=residual)
    channels = (replace(each, noise_v=v) for each, v in zip(twin_of().channels, (0.01, 0.9, 0.02, 0.09), strict=True))
    held = {"held": TwinPart(DISTANCE_MM, WEIGHT, 2 * np.insert(GAINS, 1, 0.0))}
    scatter = TwinScatter(floor=0.5, share=0.1, common=0.2)
    like = replace(twin_of(), channels=tuple(channels), parts=held, scatter=scatter)
    shown["left_v"] = np.round(simulate(left, quiet_rig(presses=4, hysteresis_s=0.5)).readings[::10, :2], 4)
    shown["like_v"] = np.round(simulate(GRID, ideal_rig(presses=2), like=like).readings[19::20], 4)
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
