"""Simulated pads as built and their physical model: scatter, creep, hysteresis, drift, divider and ADC."""

from typing import Any

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from padforge.design import Contact, Morphology, signals
from padforge.design.contact import relative_stretch, widened
from padforge.design.paths.curves import lengths
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense import RigSettings, simulate
from padforge.sense.arrays import Array
from padforge.sense.settings import IDEAL_RIG
from padforge.sense.simulation import pad_model
from padforge.sense.simulation.built_pad import BuiltPad, PressParts, build_pad, press_contacts
from padforge.sense.simulation.pad_model import ADC_STEPS, RETURNED, SUPPLY_V, Cycle, Motion, Strain, Viscoelasticity
from tests.helpers.rigs import quiet_rig

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


PAD = Morphology.straight(4)
CYCLE = Cycle(40, 13.3)


def followed_by_rest(motion: Motion, cycles: int) -> Motion:
    return Motion(*(np.pad(values, ((0, cycles), (0, 0))) for values in motion))


def visible(parts: Array, motion: Motion, rate_hz: float = 13.3, replaced: Any = 0.0, **rig: float) -> Array:
    """What shows of presses of these parts (4, Q, 1), and of what they take away (Q, 1)."""
    strain = pad_model.superpose_strain(PressParts(*parts), replaced + np.zeros(parts.shape[1:]), motion)
    return Viscoelasticity(rate_hz, RigSettings.model_validate(rig))(strain)[:, 0]


def test_what_remains_is_of_opposite_sign_and_decays() -> None:
    parts = np.zeros((4, 10, 1))
    parts[:, 0, 0] = 1.0, 1.0, 0.0, 0.25  # one press, and none in the cycles that follow
    motion = followed_by_rest(pad_model.probe_motion(CYCLE, np.full((1, 2), 0.1)), 9)
    shown = visible(parts, motion, hysteresis_s=2.5)
    assert shown[:40].min() == 0
    assert shown[35:40] == pytest.approx(1, abs=0.01)
    assert -0.25 < shown[40:].min() < -0.22
    late = shown[60:300]
    np.testing.assert_allclose(late[1:] / late[:-1], np.exp(-1 / (13.3 * 2.5)), rtol=1e-9)


def test_held_response_develops_from_the_onset_and_creeps() -> None:
    """It follows the probe with the onset, and goes to the held response, less creep, exponentially."""
    motion = pad_model.probe_motion(Cycle(2000, 1000.0), np.zeros((1, 2)))
    pressed = visible(np.reshape([1.0, 0.3, 0.0, 0.0], (4, 1, 1)), motion, 1000.0)[1000 + 100 :]
    assert pressed[0] == pytest.approx(1 - 0.7 * np.exp(-0.1 / 0.15), abs=0.005)
    np.testing.assert_allclose((1 - pressed[1:]) / (1 - pressed[:-1]), np.exp(-1 / 150), rtol=1e-9)
    creep = visible(np.reshape([1.0, 1.0, 0.2, 0.0], (4, 1, 1)), motion, 1000.0)
    assert creep[1100] == pytest.approx(1 - 0.2 * 0.05, abs=0.005)
    assert creep[1999] == pytest.approx(1 - 0.2 * (1 - np.exp(-0.95)), abs=0.005)


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


def test_press_answers_by_what_it_takes_away() -> None:
    """It goes on top of the response while it is held, and a part of it is back once it is released."""
    parts, replaced = np.zeros((4, 3, 1)), np.zeros((3, 1))
    parts[:2, 1], replaced[1] = 1.0, 0.2
    motion = followed_by_rest(pad_model.probe_motion(CYCLE, np.full((2, 2), 0.05)), 1)
    shown = visible(parts, motion, replaced=replaced, hysteresis_s=1e4)
    assert shown[70:80] == pytest.approx(1.2, abs=0.01)
    assert shown[100:] == pytest.approx(0.2 * (1 - RETURNED), abs=0.01)


def test_divider_and_adc() -> None:
    """A fibre that has grown by as much as itself and its resistor together halves the voltage."""
    rest = np.linspace(0.5, 3, 26)
    np.testing.assert_allclose(pad_model.divider_voltage(rest, np.zeros(26)), rest)
    np.testing.assert_allclose(pad_model.divider_voltage(rest, SUPPLY_V / (SUPPLY_V - rest)), rest / 2)
    volts = np.linspace(-1, 5, 1001)
    counts = pad_model.adc_volts(volts) / SUPPLY_V * ADC_STEPS
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.abs(pad_model.adc_volts(volts) - np.clip(volts, 0, SUPPLY_V)).max() <= SUPPLY_V / ADC_STEPS / 2 * (
        1 + 1e-9
    )


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
    recording = simulate(PAD, quiet_rig(presses=400), PUBLISHED_CONTACT)
    cycles = recording.readings.reshape(400, 40, 8)
    rest, stretch = cycles[:, 15], relative_stretch(PAD, PAD.to_grid(recording.presses_mm), PUBLISHED_CONTACT)
    held = 3.3 / (1 + (3.3 / rest - 1) * (1 + 0.4 * stretch))
    np.testing.assert_allclose(cycles[:, 35], held, atol=1.6 * 3.3 / 4095)


def test_presses_have_the_published_delays_and_travel() -> None:
    fast = simulate(PAD, quiet_rig(presses=100, rate_hz=1000.0, readings_per_press=2000))
    fibre = np.abs(fast.readings - fast.readings[0]).reshape(100, 2000, 8).max(axis=2)
    strong = fibre.max(axis=1) > 0.03
    touched = np.argmax(fibre[strong, 1000:] > 0, axis=1)
    arrived = np.argmax(fibre[strong, 1000:] >= fibre[strong, 1900:1901], axis=1)
    assert (touched.min() / 1000, touched.max() / 1000) == pytest.approx((0.04, 0.22), abs=0.012)
    assert np.median(arrived - touched) / 1000 == pytest.approx(0.1, abs=0.01)


def test_live_pad_responds_in_proportion_to_depth() -> None:
    pad = Morphology.straight(2)
    model = pad_model.LivePad(pad, PUBLISHED_CONTACT, quiet_rig(), 1000.0, np.random.default_rng(0))
    volts = model.volts(np.tile([-5.0, 7.0], (80, 1)), np.repeat([-5.0, 0.0, 2.5, 5.0], 20))
    rest, above, half, full = (volts[20 * i + 10] for i in range(4))
    assert np.array_equal(rest, above)
    touched = signals(pad, pad.to_grid([[-5.0, 7.0]]), PUBLISHED_CONTACT)[0] > 0
    assert touched.any()
    assert ((full < half) & (half < rest))[touched].all()
    assert np.array_equal(full[~touched], rest[~touched])
