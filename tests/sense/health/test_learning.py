"""What is learnt of a healthy pad, also where some of its fibres are dead, and from what nothing is learnt."""

from typing import Any

import numpy as np
import pytest

from design.common.errors import InputError
from sense import Localizer, Recording
from sense.health import learning
from sense.health.health_model import COMMANDED, DETECTED
from sense.health.learning import dead_fibres, fit_health_model
from sense.health.monitor import Monitor, examine
from sense.health.schema import LEAST_PRESSES
from sense.recordings.processing.limits import LEAST_SPREAD_V
from tests.sense.health.pads import BAD_FROM, later, learn, noisy, weak


def test_dead_channels_are_known_and_left_out(pad: Recording) -> None:
    readings = pad.readings.copy()
    readings[:, 0] = 3.3
    readings[:, 3] = np.minimum(readings[:, 3], np.quantile(readings[:, 3], 0.2))
    model = learn(readings, pad)
    assert model.dead == (0, 3)
    assert Monitor(model).lost == (0, 3)
    assert later(model, readings, pad) == []
    noisy(readings, int(pad.begun[BAD_FROM]), np.random.default_rng(2))
    assert later(model, readings, pad)[0].fibres == (1,)


def test_a_single_fibre_still_tells_what_its_own_readings_do(pad: Recording) -> None:
    readings = pad.readings[:, 1:2].copy()
    model = learn(readings, pad)
    readings[pad.begun[BAD_FROM] :] = readings[pad.begun[BAD_FROM]]
    assert [finding.kind for finding in later(model, readings, pad)] == ["stuck"]


def test_fibres_that_read_one_value_or_stand_at_the_end_of_their_range_are_dead() -> None:
    """At the end for more than half of the time, which most fibres are not."""
    rng = np.random.default_rng(0)
    readings = 1.5 + 0.01 * rng.standard_normal((1000, 9))
    readings[:, 1] = 1.5
    readings[:510, 2] = readings[:, 2].max()
    readings[:490, 3] = readings[:, 3].max()
    readings[:510, 4] = readings[:, 4].min()
    readings[:510, 5] = np.nan
    readings[:490, 6] = np.nan
    for fibre, spread in ((7, 0.99), (8, 1.01)):
        readings[:, fibre] = 1.5 + spread * LEAST_SPREAD_V * rng.permutation(np.linspace(0, 1, 1000))
    assert dead_fibres(readings).tolist() == [1, 2, 4, 5, 7]


def test_what_cannot_be_learnt_from_is_refused(pad: Recording) -> None:
    with pytest.raises(InputError, match=f"299 whole presses, health is learnt from {LEAST_PRESSES}"):
        learn(pad.readings, pad, LEAST_PRESSES - 1)
    with pytest.raises(InputError, match="all 6 fibres are dead"):
        learn(np.ones_like(pad.readings), pad)
    with pytest.raises(InputError, match="false alarms a press are 0"):
        fit_health_model(pad.readings, pad.times_s, pad.begun, pad.lifted, rng=np.random.default_rng(0), false_alarms=0)


def test_health_learnt_from_few_presses_calls_no_fibre_weak(pad: Recording) -> None:
    model = learn(pad.readings, pad, 500)
    end = int(pad.begun[500])
    assert not examine(model, pad.readings[:end], pad.times_s[:end], pad.begun[:500], pad.lifted[:500])
    readings = pad.readings.copy()
    weak(readings, int(pad.begun[BAD_FROM]), np.random.default_rng(2))
    assert "weak" not in {finding.kind for finding in later(model, readings, pad, 500)}


def test_health_is_learnt_from_the_presses_that_were_not_held_back(
    localizer: Localizer, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        learning, "fit_health_model", lambda readings, times_s, begun, lifted, **options: (begun, lifted)
    )
    learnt = np.setdiff1d(np.arange(len(recording.begun)), localizer.test)
    edges: dict[str, Any] = {**learning.learn_health(recording, localizer.test, localizer.provenance)}
    assert 0 < len(localizer.test) < len(learnt)
    np.testing.assert_array_equal(edges[COMMANDED], (recording.begun[learnt], recording.lifted[learnt]))
    assert len(edges[DETECTED][0]) == len(edges[DETECTED][1]) == len(learnt)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"recording": 3}, "recording is 3, expected a Recording"),
        ({"held_back": [0, 10**6]}, "held_back is .*, allowed are presses from 0 to"),
        ({"held_back": [-1]}, "held_back is .*, allowed are presses from 0 to"),
        ({"held_back": "ab"}, "held_back"),
        ({"provenance": None}, "provenance is None, expected a table"),
        ({"provenance": {}}, "the seed of provenance is None"),
        ({"provenance": {"seed": "a"}}, "the seed of provenance is 'a'"),
    ],
)
def test_what_health_is_not_learnt_from_is_refused_in_one_line(
    pad: Recording, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        learning.learn_health(**{"recording": pad, "held_back": (), "provenance": {"seed": 0}, **change})
