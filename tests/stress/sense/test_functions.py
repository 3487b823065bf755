"""Public functions of sense with hostile arguments: a right result or one line, and nothing else."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given

import sense
from design import Morphology
from sense import settings as sense_settings
from sense.recordings.press_plan import PressPlan
from tests.helpers.effort import few
from tests.stress.sense.cases import (
    EXTREMES,
    ODD,
    TINY,
    learnt,
    made,
    recorded,
    right_or_refused,
    seeds,
    spoiled,
    watched,
)

SMALL = made(2, presses=12)


def _finite(*arrays: Any) -> bool:
    return all(np.isfinite(np.asarray(array, dtype=float)).all() for array in arrays)


def _number(rng: np.random.Generator, sound: Any) -> Any:
    """`sound`, or something else in its place."""
    return [sound, ODD[rng.integers(len(ODD))], float(rng.choice(EXTREMES)), int(rng.integers(-3, 600))][
        rng.integers(4)
    ]


def _some(rng: np.random.Generator, sound: dict[str, Any]) -> dict[str, Any]:
    """Arguments of which one or two are spoiled."""
    given = dict(sound)
    for name in rng.choice(list(sound), min(len(sound), int(rng.integers(1, 3))), replace=False):
        value = sound[name]
        given[name] = spoiled(rng, value) if isinstance(value, np.ndarray) else _number(rng, value)
    return given


def _recording(rng: np.random.Generator) -> None:
    one = SMALL
    given = {"readings": one.readings, "times_s": one.times_s, "presses_mm": one.presses_mm}
    given |= {"begun": one.begun, "lifted": one.lifted, "source": {"a": 1}}
    found = sense.Recording(**_some(rng, given))
    assert found.times_s.shape == (len(found.readings),)
    assert len(found.begun) == len(found.lifted) == len(found.presses_mm)
    assert (found.begun > 0).all()
    assert (found.begun < found.lifted).all()
    assert (found.lifted[:-1] <= found.begun[1:]).all()
    assert found.lifted[-1] <= len(found.readings)
    assert 0 < found.rate_hz < np.inf
    assert len(found.digest) == 64


def _total_variation(rng: np.random.Generator) -> None:
    given = {"readings": SMALL.readings, "lam": 4.0, "fidelity": "robust", "starts": np.array([10, 50])}
    given = _some(rng, given | {"causal": False})
    found = sense.total_variation(**given)
    assert found.shape == np.shape(given["readings"])
    array = np.asarray(given["readings"], dtype=float)
    if array.size and not np.isnan(array).all():
        assert np.nanmin(found) >= np.nanmin(array) - 5e-324
        assert np.nanmax(found) <= np.nanmax(array) + 5e-324


def _running_median(rng: np.random.Generator) -> None:
    given = _some(rng, {"readings": SMALL.readings, "width": 15, "starts": np.array([10, 50]), "causal": False})
    found = sense.running_median(**given)
    assert found.shape == np.shape(given["readings"])


def _stretches(rng: np.random.Generator) -> None:
    given = _some(rng, {"times_s": SMALL.times_s, "longest_s": 1.0})
    found = sense.stretches(**given)
    assert (np.diff(found) > 0).all()


def _streams(rng: np.random.Generator) -> None:
    if rng.random() < 0.5:
        stream = sense.RunningMedian(**_some(rng, {"channels": 4, "width": 15, "causal": False}))
    else:
        stream = sense.TotalVariation(**_some(rng, {"channels": 4, "lam": 4.0, "fidelity": "robust", "most_held": 100}))
    parts = [stream.feed(spoiled(rng, SMALL.readings[:100])) for _ in range(2)]
    parts.append(stream.finish())
    assert len({part.shape[1] for part in parts}) == 1


def _find_presses(rng: np.random.Generator) -> None:
    given = _some(rng, {"readings": SMALL.readings, "times_s": SMALL.times_s})
    found = sense.find_presses(**given)
    assert (found.touched < found.released).all()
    assert (found.released[:-1] <= found.touched[1:]).all()
    assert found.released.max(initial=0) <= len(given["times_s"])


def _finder(rng: np.random.Generator) -> None:
    finder = sense.Finder(_number(rng, 4))
    for _ in range(2):
        given = _some(rng, {"times_s": SMALL.times_s[:100], "readings": SMALL.readings[:100]})
        events = finder.feed(**given)
        assert [event.down for event in events[1:]] == [not event.down for event in events[:-1]]


def _locate(rng: np.random.Generator) -> None:
    given = _some(rng, {"recording": SMALL, "lost": np.array([1]), "findings": ()})
    found = sense.locate(learnt(rng.choice(["full", "causal"])), **given)
    assert found.places_mm.shape == (12, 2)
    assert _finite(found.places_mm, found.sd_mm, found.r50_mm, found.r90_mm)
    assert (found.r50_mm <= found.r90_mm).all()


def _evaluate(rng: np.random.Generator) -> None:
    found = sense.evaluate(learnt(), **_some(rng, {"recording": SMALL, "levels": np.array([0, 1])}))
    assert all(_finite(list(row.values())) for row in found["errors"])


def _calibrate(rng: np.random.Generator) -> None:
    given = {"recording": SMALL, "options": TINY, "split": "random", "seed": 3}
    localizer, document = sense.calibrate(**_some(rng, given))
    assert _finite(*localizer.weights.values())
    assert all(_finite(list(row.values())) for row in document["errors"])


def _recalibrate(rng: np.random.Generator) -> None:
    given = _some(rng, {"localizer": learnt("published", "published"), "recording": SMALL, "seed": 0})
    localizer, document = sense.recalibrate(**given)
    assert _finite(*localizer.weights.values(), document["gain_mm"])


def _robustness(rng: np.random.Generator) -> None:
    given = {"recording": SMALL, "localizer": learnt(), "retrain": False, "options": TINY, "lost": 1, "keep_in": None}
    found = sense.fibre_loss_study(**_some(rng, given))
    assert all(_finite(list(row.values())) for way in found["ways"].values() for row in way["errors"])


def _size_curve(rng: np.random.Generator) -> None:
    found = sense.learning_curve(**_some(rng, {"recording": SMALL, "options": TINY}))
    assert _finite(list(found["fit"].values()))


def _health(rng: np.random.Generator) -> None:
    one = recorded()
    given = {"readings": one.readings[:800], "times_s": one.times_s[:800]}
    given |= {"begun": one.begun[:20], "lifted": one.lifted[:20], "rng": np.random.default_rng(0), "false_alarms": 1e-5}
    sense.fit_health_model(**_some(rng, given))


def _examine(rng: np.random.Generator) -> None:
    one = SMALL
    given = {"readings": one.readings, "times_s": one.times_s, "begun": one.begun, "lifted": one.lifted}
    for finding in sense.examine(watched(), **_some(rng, given)):
        assert set(finding.fibres) <= set(range(4))
        assert 0 <= finding.since <= finding.press < 12
        assert 0 < finding.score <= 99


def _monitor(rng: np.random.Generator) -> None:
    monitor = sense.Monitor(watched())
    for _ in range(3):
        monitor.update(**_some(rng, {"readings": SMALL.readings[:50], "begun": 20, "lifted": 40}))
    assert monitor.presses == 3


def _live(rng: np.random.Generator) -> None:
    given = {"localizers": [learnt(), learnt("early")], "health": watched(), "fibres": 4, "rate_hz": 13.3}
    live = sense.Live(**_some(rng, given))
    for part in range(3):
        part = slice(100 * part, 100 * part + 100)
        live.feed(**_some(rng, {"times_s": SMALL.times_s[part], "readings": SMALL.readings[part]}))
        for press in live.view()["presses"]:
            assert _finite(press["x_mm"], press["y_mm"], press["r50_mm"], press["r90_mm"])


def _localizer(rng: np.random.Generator) -> None:
    localizer = learnt()
    found = localizer.locate(localizer.inputs(SMALL), spoiled(rng, np.array([0, 2])))
    assert _finite(found.places_mm, found.r90_mm)


def _simulate(rng: np.random.Generator) -> None:
    rig = sense_settings.RigSettings(presses=3, readings_per_press=8)
    found = sense.simulate(**_some(rng, {"pad": Morphology.straight(2), "rig": rig, "contact": None}))
    assert _finite(found.readings)


def _plan(rng: np.random.Generator) -> None:
    if rng.random() < 0.5:
        plan = PressPlan.of(spoiled(rng, np.abs(rng.normal(size=(4, 3))) + 0.1))
    else:
        plan = PressPlan(**_some(rng, {"places_mm": np.zeros((3, 2)), "depths_mm": np.ones(3)}))
    assert _finite(plan.places_mm)
    assert (plan.depths_mm > 0).all()
    assert len(plan) == len(plan.document()) > 0


CASES: tuple[Callable[[np.random.Generator], None], ...] = (
    *(_recording, _total_variation, _running_median, _stretches, _streams, _find_presses, _finder, _locate, _evaluate),
    *(_calibrate, _recalibrate, _robustness, _size_curve, _health, _examine, _monitor, _live, _localizer, _simulate),
    _plan,
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__.strip("_"))
@few(12)
@given(seed=seeds)
def test_hostile_arguments(case: Callable[[np.random.Generator], None], seed: int) -> None:
    right_or_refused(lambda: case(np.random.default_rng(seed)))
