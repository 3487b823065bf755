"""Readings as pads give them at their worst: results are finite, or one line says why there is none."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given

import sense
from design.common.errors import InputError
from sense.localizer.features import FEATURES, press_inputs
from sense.localizer.normalization import Normalization
from sense.localizer.response.response_model import ResponseModel
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.sense.cases import RATE_HZ, TINY, learnt, made, recorded, right_or_refused, seeds, watched


def _faulty(rng: np.random.Generator, readings: np.ndarray) -> np.ndarray:
    """Readings (R, C) of which fibres fail, each in a way of its own."""
    readings = np.array(readings)
    rows, fibres = readings.shape
    for _ in range(rng.integers(1, 4)):
        fibre, since = int(rng.integers(fibres)), int(rng.integers(rows)) * int(rng.integers(2))
        kind = rng.integers(11)
        part = readings[since:, fibre]
        if kind == 0:
            part[:] = rng.choice([0.0, 3.3, -0.0, 1e-300, 5e-324, 1e3, -1e3])
        elif kind == 1:  # saturated
            np.clip(part, 1.8, 1.85, out=part)
        elif kind == 2:
            part[:] = np.nan
        elif kind == 3:
            part[rng.random(len(part)) < rng.choice([0.01, 0.5, 0.99])] = np.nan
        elif kind == 4:  # changed places
            other = int(rng.integers(fibres))
            readings[since:, [fibre, other]] = readings[since:, [other, fibre]]
        elif kind == 5:
            part *= rng.choice([1e-300, 1e-9, 1e-3, -1.0, 500.0])
        elif kind == 6:
            part += rng.standard_normal(len(part)) * rng.choice([1e-12, 1.0, 100.0])
        elif kind == 7:
            part[rng.random(len(part)) < 0.01] = rng.choice([1e3, -1e3])
        elif kind == 8:
            part += np.linspace(0, rng.choice([1.0, -100.0, 1e-300]), len(part))
        elif kind == 9:
            part[:] = np.where(np.arange(len(part)) % 2, 1e-300, 0.0)
        else:  # all of them
            readings[since:] = rng.choice([0.0, 1.0, np.nan, 999.0])
    return readings


def _places(rng: np.random.Generator, places_mm: np.ndarray) -> np.ndarray:
    places_mm, kind = np.array(places_mm), rng.integers(7)
    if kind == 0:  # all in one
        places_mm[:] = places_mm[0]
    elif kind == 1:  # on a line
        places_mm[:, 1] = 0
    elif kind == 2:
        places_mm[rng.random(len(places_mm)) < rng.choice([0.1, 0.9])] = np.nan
    elif kind == 3:  # twice
        places_mm[1::2] = places_mm[: len(places_mm[1::2])]
    elif kind == 4:
        places_mm *= rng.choice([1e-12, 1e-300, 5e3])
    elif kind == 5:
        places_mm[-1] = 1e5
    return places_mm


def _worst(rng: np.random.Generator, presses: int) -> sense.Recording:
    """A recording with faults of fibres, odd presses and odd times; InputError where it is none at all."""
    cycle = int(rng.choice([4, 8, 40]))
    one = made(int(rng.integers(4)), presses=presses, cycle=cycle, fibres=4)
    times_s = one.times_s
    kind = rng.integers(5)
    if kind == 0:  # a pause, or clocks that jitter
        times_s = times_s + np.where(np.arange(len(times_s)) > len(times_s) // 2, rng.choice([10.0, 1e6, 1e9]), 0.0)
    elif kind == 1:
        times_s = times_s + rng.uniform(0, 0.9 / RATE_HZ, len(times_s))
    begun, lifted = np.array(one.begun), np.array(one.lifted)
    if rng.random() < 0.3:  # as short as they may be
        lifted = begun + 1
    if rng.random() < 0.2:  # at the very ends
        begun[0], lifted[-1] = 1, len(times_s)
    readings = _faulty(rng, one.readings) if rng.random() < 0.9 else one.readings
    if rng.random() < 0.2:
        readings = readings.astype(np.float32).astype(np.float64)
    return sense.Recording(readings, times_s, _places(rng, one.presses_mm), begun, lifted)


def _finite(found: sense.Found, presses: int) -> None:
    assert found.places_mm.shape == found.sd_mm.shape == (presses, 2)
    assert np.isfinite(np.column_stack([found.places_mm, found.sd_mm, found.r50_mm, found.r90_mm])).all()
    assert (found.sd_mm > 0).all()
    assert (found.r50_mm > 0).all()


def _numbers(document: Any) -> list[float]:
    if isinstance(document, dict):
        return [number for value in document.values() for number in _numbers(value)]
    if isinstance(document, list | tuple):
        return [number for value in document for number in _numbers(value)]
    return [float(document)] if isinstance(document, int | float) else []


@few(20)
@given(seed=seeds)
def test_the_worst_recordings_are_located_examined_and_evaluated(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def work() -> None:
        one = _worst(rng, int(rng.choice([1, 2, 3, 30])))
        model = [learnt(), learnt("causal"), learnt("published", "published")][rng.integers(3)]
        findings = sense.examine(watched(), one.readings, one.times_s, one.begun, one.lifted)
        _finite(sense.locate(model, one, (), findings), len(one.begun))
        if one.known.any():
            document = sense.evaluate(model, one, (0,) if model.method == "published" else (0, 3))
            assert np.isfinite(_numbers(document)).all()

    right_or_refused(work)


@few(12)
@given(seed=seeds)
def test_the_worst_recordings_teach_or_are_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    features = rng.choice(FEATURES)
    method = "published" if features == "published" and rng.random() < 0.5 else "masked"

    def work() -> None:
        one = _worst(rng, int(rng.choice([1, 3, 5, 30, 60])))
        options = TINY.model_copy(update={"features": features, "method": method, "test_share": 0.3})
        localizer, document = sense.calibrate(one, options)
        assert np.isfinite(_numbers(document)).all()
        _finite(sense.locate(localizer, one), len(one.begun))

    right_or_refused(work)


@few(6)
@given(seed=seeds)
def test_the_worst_recordings_are_followed_or_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def work() -> None:
        one = _worst(rng, int(rng.choice([2, 12, 30])))
        model = [learnt(), learnt("published", "published")][rng.integers(2)]
        localizer, document = sense.recalibrate(model, one)
        assert np.isfinite(_numbers(document)).all()
        _finite(sense.locate(localizer, one), len(one.begun))
        if not (np.isnan(localizer.factors).any() or np.isnan(model.factors).any()):
            assert (localizer.factors >= model.factors).all()

    right_or_refused(work, 30)


@few(5)
@given(seed=seeds)
def test_health_is_learnt_from_the_worst_or_refused(
    seed: int, few_steps: None, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rng = np.random.default_rng(seed)

    def work() -> None:
        one = recorded()
        readings = _faulty(rng, one.readings)
        model = sense.fit_health_model(
            readings, one.times_s, one.begun, one.lifted, rng=np.random.default_rng(0), false_alarms=1e-4
        )
        model.save(tmp_path_factory.getbasetemp())
        assert sense.HealthModel.load(tmp_path_factory.getbasetemp()).dead == model.dead
        for finding in sense.examine(model, readings, one.times_s, one.begun[::4], one.lifted[::4]):
            assert 0 <= finding.since <= finding.press < 80
            assert not set(finding.fibres) & set(model.dead)

    right_or_refused(work, 30)


@pytest.fixture(scope="module")
def few_steps():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sense.health.fibre_prediction.MOST_STEPS", 20)
        yield


@few(12)
@given(seed=seeds)
def test_readings_as_they_come_give_finite_places_in_any_portions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rate_hz = float(rng.choice([RATE_HZ, 1e-3, 1.0, 1000.0, 1e6]))
    one = made(int(rng.integers(4)), presses=12)
    readings, times_s = _faulty(rng, one.readings) if rng.random() < 0.7 else one.readings, one.times_s
    times_s = times_s * (RATE_HZ / rate_hz)

    def follow(edges: list[int]) -> tuple[list[Any], dict[str, Any]]:
        models = [replace(model, rate_hz=rate_hz) for model in (learnt(), learnt("early"))]
        live = sense.Live(models, replace(watched(), rate_hz=rate_hz), 4, rate_hz)
        parts = [slice(first, end) for first, end in pairwise(edges)]
        events = [event for part in parts for event in live.feed(times_s[part], readings[part])]
        return events, live.view()

    def work() -> None:
        whole = follow([0, len(times_s)])
        cuts = np.sort(rng.integers(len(times_s), size=5)).tolist()
        assert follow([0, *cuts, len(times_s)]) == whole
        for event in whole[0]:
            assert np.isfinite(_numbers(vars(event))).all()
        swings = [fibre["swing"] for fibre in whole[1]["fibres"]]
        assert np.isfinite([swing for swing in swings if swing is not None]).all()

    right_or_refused(work)


@pytest.mark.parametrize("features", FEATURES)
@few(6)
@given(seed=seeds)
def test_inputs_of_presses_scale_with_volts_and_keep_fibres_apart(features: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    try:
        one = _worst(rng, 10)
    except InputError:
        return
    edges = one.begun, one.lifted
    raw = press_inputs(one.readings, *edges, features)
    assert np.isfinite(raw.windows).all()
    assert np.isfinite(raw.history).all()
    order = rng.permutation(4)
    moved = press_inputs(one.readings[:, order], *edges, features)
    np.testing.assert_array_equal(moved.windows, raw.windows[:, order])
    np.testing.assert_array_equal(moved.alive, raw.alive[:, order])
    if np.nanmax(np.abs(one.readings)) > 1e-3:
        doubled = press_inputs(one.readings * 2, *edges, features)
        np.testing.assert_allclose(doubled.windows, 2 * raw.windows, atol=1e-300)
    places_mm = np.nan_to_num(one.presses_mm)
    scaling, table = Normalization.fit(raw, places_mm)
    assert np.isfinite(table).all()
    assert np.isfinite(scaling.inputs(raw).inputs).all()
    assert 0 < scaling.span_mm < np.inf


def test_very_many_presses_take_memory_in_proportion() -> None:
    """Ten readings each, of one fibre; what is made of them takes no more than some such tables."""
    import resource

    presses = 1_000_000 if few(1).max_examples > 1 else 50_000
    rng = np.random.default_rng(0)
    readings = 1.8 + 0.01 * rng.standard_normal((10 * presses, 1))
    begun = 10 * np.arange(presses) + 5
    one = sense.Recording(readings, np.arange(10.0 * presses) / 100, rng.uniform(-1, 1, (presses, 2)), begun, begun + 5)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with ends_in_time(30 + presses // 5000):
        raw = press_inputs(one.readings, one.begun, one.lifted, "early")
        ResponseModel.fit(one.presses_mm, raw.windows, raw.history, raw.alive)
        sense.find_presses(one.readings, one.times_s)
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown_kb < 250_000 + 2 * presses  # the bumps of all of them alone would take 3.5 kB a press
