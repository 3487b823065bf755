"""Physical model of the simulated pad: scatter, creep, hysteresis, drift, divider and ADC."""

import numpy as np
import pytest

from padforge.design import Morphology, signals
from padforge.design.contact import relative_stretch
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense import RigSettings, simulate
from padforge.sense.simulation.built_pad import PressParts
from padforge.sense.simulation.pad_model import (
    ADC_STEPS,
    RETURNED,
    SUPPLY_V,
    Cycle,
    Drift,
    LivePad,
    Motion,
    Strain,
    Viscoelasticity,
    adc_volts,
    divider_voltage,
    probe_motion,
    replaced_residues,
    superpose_strain,
)
from tests.helpers.rigs import quiet_rig

PAD = Morphology.straight(4)
CYCLE = Cycle(40, 13.3)


def followed_by_rest(motion: Motion, cycles: int) -> Motion:
    return Motion(*(np.pad(values, ((0, cycles), (0, 0))) for values in motion))


def test_what_remains_is_of_opposite_sign_and_decays() -> None:
    parts = np.zeros((4, 10, 1))
    parts[:, 0, 0] = 1.0, 1.0, 0.0, 0.25  # one press, and none in the cycles that follow
    motion = followed_by_rest(probe_motion(CYCLE, np.full((1, 2), 0.1)), 9)
    strain = superpose_strain(PressParts(*parts), np.zeros((10, 1)), motion)
    visible = Viscoelasticity(13.3, RigSettings(hysteresis_s=2.5))(strain)[:, 0]
    assert visible[:40].min() == 0
    assert visible[35:40] == pytest.approx(1, abs=0.01)
    assert -0.25 < visible[40:].min() < -0.22
    late = visible[60:300]
    np.testing.assert_allclose(late[1:] / late[:-1], np.exp(-1 / (13.3 * 2.5)), rtol=1e-9)


def test_held_response_develops_from_the_onset_and_creeps() -> None:
    """It follows the probe with the onset, and goes to the held response, less creep, exponentially."""
    fast = Cycle(2000, 1000.0)
    parts = np.reshape([1.0, 0.3, 0.0, 0.0], (4, 1, 1))
    motion = probe_motion(fast, np.zeros((1, 2)))
    lag = Viscoelasticity(1000.0, RigSettings())(superpose_strain(PressParts(*parts), np.zeros((1, 1)), motion))[:, 0]
    pressed = lag[1000 + 100 :]
    assert pressed[0] == pytest.approx(1 - 0.7 * np.exp(-0.1 / 0.15), abs=0.005)
    np.testing.assert_allclose((1 - pressed[1:]) / (1 - pressed[:-1]), np.exp(-1 / 150), rtol=1e-9)
    parts = np.reshape([1.0, 1.0, 0.2, 0.0], (4, 1, 1))
    creep = Viscoelasticity(1000.0, RigSettings())(superpose_strain(PressParts(*parts), np.zeros((1, 1)), motion))[:, 0]
    assert creep[1100] == pytest.approx(1 - 0.2 * 0.05, abs=0.005)
    assert creep[1999] == pytest.approx(1 - 0.2 * (1 - np.exp(-0.95)), abs=0.005)


@pytest.mark.parametrize(("distance_mm", "share"), [(0.0, 0.8), (10.0, 0.8 * np.exp(-0.5)), (60.0, 0.0)])
def test_press_takes_away_residues_near_it(distance_mm: float, share: float) -> None:
    """As far as both reach a fibre, and a part of that comes back; what it took is gone for the next one."""
    rig = RigSettings(memory=0.8, memory_mm=10.0, hysteresis_s=20.0)
    positions_mm = np.array([[0.0, 0.0], [distance_mm, 0.0], [distance_mm, 0.0]])
    residues, held = (
        np.array([[0.04, -0.04], [0.0, 0.0], [0.0, 0.0]]),
        np.array([[0.2, -0.2], [0.01, -0.01], [0.04, 0.01]]),
    )
    touch_s, release_s = np.array([0.0, 3.0, 6.0]), np.array([1.0, 4.0, 7.0])
    replaced = replaced_residues(positions_mm, touch_s, release_s, residues, held, rig)
    assert not replaced[0].any()
    assert replaced[1] == pytest.approx(share * np.exp(-0.1) * np.array([0.02, -0.02]), abs=1e-9)
    left = 1 - (1 - RETURNED) * share
    assert replaced[2] == pytest.approx([left * share * np.exp(-0.25) * 0.04, 0.0], abs=1e-9)
    off = replaced_residues(positions_mm, touch_s, release_s, residues, held, rig.model_copy(update={"memory": 0.0}))
    assert not off.any()


def test_press_answers_by_what_it_takes_away() -> None:
    """It goes on top of the response while it is held, and a part of it is back once it is released."""
    parts, replaced = np.zeros((4, 3, 1)), np.zeros((3, 1))
    parts[:2, 1], replaced[1] = 1.0, 0.2
    motion = followed_by_rest(probe_motion(CYCLE, np.full((2, 2), 0.05)), 1)
    strain = superpose_strain(PressParts(*parts), replaced, motion)
    visible = Viscoelasticity(13.3, RigSettings(hysteresis_s=1e4))(strain)[:, 0]
    assert visible[70:80] == pytest.approx(1.2, abs=0.01)
    assert visible[100:] == pytest.approx(0.2 * (1 - RETURNED), abs=0.01)


def test_divider_and_adc() -> None:
    """A fibre that has grown by as much as itself and its resistor together halves the voltage."""
    rest = np.linspace(0.5, 3, 26)
    np.testing.assert_allclose(divider_voltage(rest, np.zeros(26)), rest)
    np.testing.assert_allclose(divider_voltage(rest, SUPPLY_V / (SUPPLY_V - rest)), rest / 2)
    volts = np.linspace(-1, 5, 1001)
    counts = adc_volts(volts) / SUPPLY_V * ADC_STEPS
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.abs(adc_volts(volts) - np.clip(volts, 0, SUPPLY_V)).max() <= SUPPLY_V / ADC_STEPS / 2 * (1 + 1e-9)


def test_drift_is_an_ornstein_uhlenbeck_process() -> None:
    drift = Drift(200, 13.3, np.random.default_rng(0))(10_000)
    assert drift.std() == pytest.approx(1, rel=0.05)
    assert np.diff(drift, axis=0).std() == pytest.approx(np.sqrt(2 / (13.3 * 600)), rel=0.02)


def test_streams_do_not_depend_on_the_size_of_blocks() -> None:
    pieces, rng = [1, 7, 1, 40, 3], np.random.default_rng(0)
    strain = Strain(*rng.uniform(0, 2, (3, sum(pieces), 3)))
    model, cuts = Viscoelasticity(13.3, RigSettings()), np.cumsum(pieces)[:-1]
    parts = [model(Strain(*part)) for part in zip(*(np.split(each, cuts) for each in strain), strict=True)]
    np.testing.assert_allclose(np.vstack(parts), Viscoelasticity(13.3, RigSettings())(strain))
    drift, again = (Drift(2, 13.3, np.random.default_rng(1)) for _ in range(2))
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
    model = LivePad(pad, PUBLISHED_CONTACT, quiet_rig(), 1000.0, np.random.default_rng(0))
    volts = model.volts(np.tile([-5.0, 7.0], (80, 1)), np.repeat([-5.0, 0.0, 2.5, 5.0], 20))
    rest, above, half, full = (volts[20 * i + 10] for i in range(4))
    assert np.array_equal(rest, above)
    touched = signals(pad, pad.to_grid([[-5.0, 7.0]]), PUBLISHED_CONTACT)[0] > 0
    assert touched.any()
    assert ((full < half) & (half < rest))[touched].all()
    assert np.array_equal(full[~touched], rest[~touched])
