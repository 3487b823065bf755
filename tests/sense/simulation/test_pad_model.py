"""Physical model of the simulated pad: scatter, creep, hysteresis, drift, divider and ADC."""

from typing import Any

import numpy as np
import pytest

from padforge.design import Morphology, signals
from padforge.design.contact import relative_stretch
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense import RigSettings, simulate
from padforge.sense.simulation.pad_model import (
    ADC_STEPS,
    SUPPLY_V,
    CreepHysteresis,
    Cycle,
    Drift,
    LivePad,
    divider_voltage,
    quantize,
    relative_depths,
    superpose_strain,
)

PAD = Morphology.straight(4)
IDEAL: dict[str, Any] = {"noise_mv": 0.0, "drift_mv": 0.0, "creep": 0.0, "hysteresis": 0.0}


def test_hysteresis_overshoots_on_unloading_only() -> None:
    depths = np.vstack([relative_depths(Cycle(40, 13.3), np.full((1, 2), 0.1)), np.zeros((9, 80))])
    strain = superpose_strain(np.vstack([[1.0], np.zeros((9, 1))]), depths)
    visible = CreepHysteresis(13.3, RigSettings(creep=0, hysteresis=0.25, hysteresis_s=2.5))(strain)[:, 0]
    assert visible[:40].min() == 0
    assert -0.25 < visible[40:].min() < -0.15
    assert (np.diff(visible[45:]) > 0).all()
    assert abs(visible[-1]) < 0.01


def test_creep_has_two_time_constants() -> None:
    steps = np.arange(1, 40)
    creep = CreepHysteresis(10.0, RigSettings(creep=0.2, hysteresis=0))(np.append(0, np.ones(39))[:, None])[1:, 0]
    np.testing.assert_allclose(creep, 1 - 0.1 * (np.exp(-steps / 4) + np.exp(-steps / 60)))


def test_divider_and_adc() -> None:
    """A fibre that has grown by as much as itself and its resistor together halves the voltage."""
    rest = np.linspace(0.5, 3, 26)
    np.testing.assert_allclose(divider_voltage(rest, np.zeros(26)), rest)
    np.testing.assert_allclose(divider_voltage(rest, SUPPLY_V / (SUPPLY_V - rest)), rest / 2)
    volts = np.linspace(-1, 5, 1001)
    counts = quantize(volts) / SUPPLY_V * ADC_STEPS
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.abs(quantize(volts) - np.clip(volts, 0, SUPPLY_V)).max() <= SUPPLY_V / ADC_STEPS / 2 * (1 + 1e-9)


def test_drift_is_an_ornstein_uhlenbeck_process() -> None:
    drift = Drift(200, 13.3, np.random.default_rng(0))(10_000)
    assert drift.std() == pytest.approx(1, rel=0.05)
    assert np.diff(drift, axis=0).std() == pytest.approx(np.sqrt(2 / (13.3 * 600)), rel=0.02)


def test_streams_do_not_depend_on_the_size_of_blocks() -> None:
    pieces, rig = [1, 7, 1, 40, 3], RigSettings(creep=0.2, hysteresis=0.3)
    strain = np.random.default_rng(0).uniform(0, 2, (sum(pieces), 3))
    model = CreepHysteresis(13.3, rig)
    parts = [model(part) for part in np.split(strain, np.cumsum(pieces)[:-1])]
    np.testing.assert_allclose(np.vstack(parts), CreepHysteresis(13.3, rig)(strain))
    drift, again = (Drift(2, 13.3, np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_allclose(np.vstack([drift(n) for n in pieces]), again(sum(pieces)))


def test_held_presses_follow_the_relative_stretch_and_scatter() -> None:
    """A fibre's resistance grows by 0.4 of its relative stretch at 5 mm; responses scatter by a sixth of that."""
    recording = simulate(PAD, RigSettings(presses=400, scatter=0, **IDEAL), PUBLISHED_CONTACT)
    cycles = recording.readings.reshape(400, 40, 8)
    rest, stretch = cycles[:, 15], relative_stretch(PAD, PAD.to_grid(recording.presses_mm), PUBLISHED_CONTACT)
    held = 3.3 / (1 + (3.3 / rest - 1) * (1 + 0.4 * stretch))
    np.testing.assert_allclose(cycles[:, 35], held, atol=1.6 * 3.3 / 4095)
    rests = [simulate(PAD, RigSettings(presses=1, seed=seed, **IDEAL)).readings[0] for seed in range(20)]
    assert (np.min(rests), np.max(rests)) == pytest.approx((1.7, 2.1), abs=0.02)
    scattered = simulate(PAD, RigSettings(presses=400, scatter=0.16, **IDEAL), PUBLISHED_CONTACT)
    strong = rest - held > 0.05
    gains = (scattered.readings.reshape(400, 40, 8)[:, 35] - rest)[strong] / (held - rest)[strong]
    assert gains.std() == pytest.approx(0.16, rel=0.15)


def test_presses_have_the_published_delays_and_travel() -> None:
    fast = simulate(PAD, RigSettings(presses=100, rate_hz=1000, readings_per_press=2000, **IDEAL))
    fibre = np.abs(fast.readings - fast.readings[0]).reshape(100, 2000, 8).max(axis=2)
    strong = fibre.max(axis=1) > 0.03
    touched = np.argmax(fibre[strong, 1000:] > 0, axis=1)
    arrived = np.argmax(fibre[strong, 1000:] >= fibre[strong, 1900:1901], axis=1)
    assert (touched.min() / 1000, touched.max() / 1000) == pytest.approx((0.08, 0.2), abs=0.012)
    assert np.median(arrived - touched) / 1000 == pytest.approx(0.15, abs=0.01)


def test_live_pad_responds_in_proportion_to_depth() -> None:
    pad = Morphology.straight(2)
    model = LivePad(pad, PUBLISHED_CONTACT, RigSettings(**IDEAL), 1000.0, np.random.default_rng(0))
    volts = model.volts(np.tile([-5.0, 7.0], (80, 1)), np.repeat([-5.0, 0.0, 2.5, 5.0], 20))
    rest, above, half, full = (volts[20 * i + 10] for i in range(4))
    assert np.array_equal(rest, above)
    touched = signals(pad, pad.to_grid([[-5.0, 7.0]]), PUBLISHED_CONTACT)[0] > 0
    assert touched.any()
    assert ((full < half) & (half < rest))[touched].all()
    assert np.array_equal(full[~touched], rest[~touched])
