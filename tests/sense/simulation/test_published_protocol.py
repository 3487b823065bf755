"""The simulated pad behaves like one: touched fibres answer, creep, overshoot, drift; the ADC counts."""

from typing import Any

import numpy as np
import pytest

from padforge.design import InputError, Morphology, signals, signals_quantized
from padforge.design.contact import relative_stretch
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings
from padforge.sense import RigSettings, simulate
from padforge.sense.simulation.pad_model import (
    ADC_STEPS,
    SUPPLY_V,
    Answer,
    Cycle,
    LivePad,
    Wander,
    digitised,
    divider,
    indentation,
    strain,
)

PAD = Morphology.straight(4)
CYCLE = Cycle(40, 13.3)
STILL: dict[str, Any] = {"noise_mv": 0.0, "drift_mv": 0.0, "creep": 0.0, "hysteresis": 0.0}


def test_it_has_the_published_form_and_presses_no_more_than_is_sensed() -> None:
    recording = simulate(PAD, RigSettings(presses=400))
    assert recording.readings.shape == (16_000, 8)
    assert np.array_equal(recording.down_command, 40 * np.arange(400) + 20)
    assert np.array_equal(recording.up_command, recording.down_command + 20)
    assert np.abs(recording.presses_mm).max() <= 22.5
    assert np.abs(recording.presses_mm).max(axis=0).min() > 21
    assert recording.rate_hz == pytest.approx(13.3, rel=0.02)
    assert simulate(PAD, RigSettings(presses=1)).source["sensed_mm"] == "beyond"
    strip = simulate(PAD, RigSettings(presses=400), size=PadSettings(sensed_mm=(50, 8)))
    assert strip.source["sensed_mm"] == [50, 8]
    np.testing.assert_allclose(np.abs(strip.presses_mm).max(axis=0), [25, 4], rtol=0.02)
    with pytest.raises(InputError, match=r"sensed_mm: got .*the pad itself is 56\.25 mm"):
        simulate(PAD, RigSettings(presses=1), size=PadSettings(sensed_mm=(57, 8)))


def test_untouched_fibres_stay_within_noise() -> None:
    recording = simulate(PAD, RigSettings(presses=300, drift_mv=0.0, creep=0.0, hysteresis=0.0), PUBLISHED_CONTACT)
    touched = signals_quantized(PAD, PAD.to_grid(recording.presses_mm)) > 0
    cycles = recording.readings.reshape(300, 40, 8)
    change = cycles[:, 28:38].mean(axis=1) - cycles[:, 8:18].mean(axis=1)
    expected = 1.6e-3 * np.sqrt(2 / 10)
    assert change[~touched].std() == pytest.approx(expected, rel=0.15)
    assert np.abs(change[touched]).mean() > 20 * expected


def test_unloading_overshoots_and_loading_does_not() -> None:
    indented = np.vstack([indentation(CYCLE, np.full((1, 2), 0.1)), np.zeros((9, 80))])
    strained = strain(np.vstack([[1.0], np.zeros((9, 1))]), indented)
    shown = Answer(CYCLE.rate_hz, 0.0, 0.25, 2.5)(strained)[:, 0]
    assert shown[:40].min() == 0
    assert -0.25 < shown[40:].min() < -0.15
    assert (np.diff(shown[45:]) > 0).all()
    assert abs(shown[-1]) < 0.01


def test_the_divider_rests_where_it_should_and_the_adc_gives_whole_steps_within_half_a_step() -> None:
    """A fibre that has grown by as much as itself and its resistor together halves what its resistor shows."""
    rest = np.linspace(0.5, 3, 26)
    np.testing.assert_allclose(divider(rest, np.zeros(26)), rest)
    np.testing.assert_allclose(divider(rest, SUPPLY_V / (SUPPLY_V - rest)), rest / 2)
    volts = np.linspace(-1, 5, 1001)
    counts = digitised(volts) / SUPPLY_V * ADC_STEPS
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.abs(digitised(volts) - np.clip(volts, 0, SUPPLY_V)).max() <= SUPPLY_V / ADC_STEPS / 2 * (1 + 1e-9)


def test_the_rest_wanders_slowly_about_its_place_and_asked_bit_by_bit_the_model_gives_the_same() -> None:
    wander = Wander(200, 13.3, np.random.default_rng(0))(10_000)
    assert wander.std() == pytest.approx(1, rel=0.05)
    assert np.diff(wander, axis=0).std() == pytest.approx(np.sqrt(2 / (13.3 * 600)), rel=0.02)
    pieces = [1, 7, 1, 40, 3]
    strained = np.random.default_rng(0).uniform(0, 2, (sum(pieces), 3))
    model = Answer(13.3, 0.2, 0.3, 2.5)
    parts = np.split(strained, np.cumsum(pieces)[:-1])
    assert np.allclose(np.vstack([model(part) for part in parts]), Answer(13.3, 0.2, 0.3, 2.5)(strained))
    drift, again = (Wander(2, 13.3, np.random.default_rng(1)) for _ in range(2))
    assert np.allclose(np.vstack([drift(n) for n in pieces]), again(sum(pieces)))


def test_held_presses_divide_the_supply_as_the_stretch_of_fibres_has_it() -> None:
    """A fibre's resistance grows by 0.4 of its relative stretch at 5 mm; responses scatter by a sixth of that."""
    recording = simulate(PAD, RigSettings(presses=400, scatter=0, **STILL), PUBLISHED_CONTACT)
    cycles = recording.readings.reshape(400, 40, 8)
    rest, stretch = cycles[:, 15], relative_stretch(PAD, PAD.to_grid(recording.presses_mm), PUBLISHED_CONTACT)
    held = 3.3 / (1 + (3.3 / rest - 1) * (1 + 0.4 * stretch))
    np.testing.assert_allclose(cycles[:, 35], held, atol=1.6 * 3.3 / 4095)
    rests = [simulate(PAD, RigSettings(presses=1, seed=seed, **STILL)).readings[0] for seed in range(20)]
    assert (np.min(rests), np.max(rests)) == pytest.approx((1.7, 2.1), abs=0.02)
    scattered = simulate(PAD, RigSettings(presses=400, scatter=0.16, **STILL), PUBLISHED_CONTACT)
    strong = rest - held > 0.05
    gains = (scattered.readings.reshape(400, 40, 8)[:, 35] - rest)[strong] / (held - rest)[strong]
    assert gains.std() == pytest.approx(0.16, rel=0.15)


def test_presses_show_and_end_as_late_as_the_published_ones_and_creep_in_two_paces() -> None:
    fast = simulate(PAD, RigSettings(presses=100, rate_hz=1000, readings_per_press=2000, **STILL))
    fibre = np.abs(fast.readings - fast.readings[0]).reshape(100, 2000, 8).max(axis=2)
    strong = fibre.max(axis=1) > 0.03
    touched = np.argmax(fibre[strong, 1000:] > 0, axis=1)
    arrived = np.argmax(fibre[strong, 1000:] >= fibre[strong, 1900:1901], axis=1)
    assert (touched.min() / 1000, touched.max() / 1000) == pytest.approx((0.08, 0.2), abs=0.012)
    assert np.median(arrived - touched) / 1000 == pytest.approx(0.15, abs=0.01)
    steps = np.arange(1, 40)
    creeping = Answer(10.0, 0.2, 0.0, 1.0)(np.append(0, np.ones(39))[:, None])[1:, 0]
    np.testing.assert_allclose(creeping, 1 - 0.1 * (np.exp(-steps / 4) + np.exp(-steps / 60)))


def test_a_pad_recorded_or_live_answers_where_and_in_proportion_to_how_deep_it_is_pressed() -> None:
    light, deep, mixed = (
        simulate(PAD, RigSettings(presses=40, depths_mm=depths, **STILL)) for depths in ((1.0,), (4.0,), (1.0, 4.0))
    )
    assert mixed.depths_mm.tolist() == [1.0, 4.0] * 20
    assert np.array_equal(mixed.presses_mm, deep.presses_mm)
    cycles = [each.readings.reshape(40, 40, 8) for each in (light, deep, mixed)]
    assert np.array_equal(cycles[2][0::2, 20:], cycles[0][0::2, 20:])
    assert np.array_equal(cycles[2][1::2, 20:], cycles[1][1::2, 20:])
    swing = [np.abs(each[:, 39] - each[:, 15]).sum() for each in cycles[:2]]
    assert swing[1] / swing[0] == pytest.approx(4, rel=0.05)
    with pytest.raises(InputError, match="plan is adaptive"):
        simulate(PAD, RigSettings(plan="adaptive"))
    pad = Morphology.straight(2)
    model = LivePad(pad, PUBLISHED_CONTACT, RigSettings(**STILL), 1000.0, np.random.default_rng(0))
    depths = np.repeat([-5.0, 0.0, 2.5, 5.0], 20)
    volts = model.volts(np.tile([-5.0, 7.0], (80, 1)), depths)
    rest, above, half, full = (volts[20 * i + 10] for i in range(4))
    assert np.array_equal(rest, above)
    touched = signals(pad, pad.to_grid([[-5.0, 7.0]]), PUBLISHED_CONTACT)[0] > 0
    assert touched.any()
    assert ((full < half) & (half < rest))[touched].all()
    assert np.array_equal(full[~touched], rest[~touched])
