"""Health: fibres predict each other, a healthy pad is left in peace, and a bad fibre is named with what is wrong."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from design import Morphology
from design.common.errors import InputError
from sense import Recording, open_recording
from sense import settings as sense_settings
from sense.health import fibre_prediction as residuals
from sense.health import health_model as health
from sense.health.alarm_thresholds import Tail, climb
from sense.health.fault_likelihoods import HYPOTHESES, noise_of
from sense.health.fibre_prediction import INPUTS, MEMBERS, TARGETS, TRACE, expected, traces_of
from sense.health.health_model import RECORDED, HealthModel, _dead, checked_presses, files_of
from sense.health.monitor import TEXTS, FibreFault, Monitor, _Press, examine, fault_lines
from sense.health.schema import LEAST_PRESSES
from sense.processing.limits import LEAST_SPREAD_V
from sense.recordings.simulation import simulate

Array = NDArray[np.float64]
LEARNT, PRESSES, BAD_FROM = 600, 900, 660


DOCUMENT, WEIGHTS = (path.name for path in files_of("", RECORDED))


@pytest.fixture(scope="module")
def pad() -> Recording:
    """PRESSES on a simulated pad of six fibres."""
    return simulate(
        Morphology.random(3, knots=3, seed=5), sense_settings.RigSettings(presses=PRESSES, seed=1, drift_mv=10)
    )


@pytest.fixture(scope="module", autouse=True)
def quick_training() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(residuals, "STEPS", 400)
        patch.setattr(health, "WEAK_PRESSES", LEARNT)  # of this pad they suffice
        yield


@pytest.fixture(scope="module")
def model(pad: Recording, quick_training: None) -> HealthModel:
    return learn(pad.readings, pad)


def learn(readings: Array, pad: Recording, presses: int = LEARNT) -> HealthModel:
    end = pad.begun[presses]
    return HealthModel.fit(
        readings[:end], pad.times_s[:end], pad.begun[:presses], pad.lifted[:presses], rng=np.random.default_rng(0)
    )


def later(model: HealthModel, readings: Array, pad: Recording, first: int = LEARNT) -> list[FibreFault]:
    """Findings on the presses that health was not learnt from; press 0 is the first of them."""
    start = pad.lifted[first - 1]
    return examine(model, readings[start:], pad.times_s[start:], pad.begun[first:] - start, pad.lifted[first:] - start)


def random_weights(fibres: int, rng: np.random.Generator) -> dict[str, NDArray[np.float32]]:
    hidden, outputs = 7, 2 * TARGETS
    shapes = {
        "first.w": (MEMBERS, fibres, INPUTS, hidden),
        "first.alive": (MEMBERS, fibres, hidden),
        "first.b": (MEMBERS, hidden),
        "hidden.w": (MEMBERS, hidden, hidden),
        "hidden.b": (MEMBERS, hidden),
        "last.w": (MEMBERS, fibres, hidden, outputs),
        "last.b": (MEMBERS, fibres, outputs),
    }
    return {name: (0.5 * rng.standard_normal(shape)).astype(np.float32) for name, shape in shapes.items()}


@given(seed=st.integers(0, 2**32 - 1), fibres=st.integers(1, 5))
def test_a_fibre_has_no_part_in_its_own_prediction_nor_have_lost_ones(seed: int, fibres: int) -> None:
    rng = np.random.default_rng(seed)
    weights = random_weights(fibres, rng)
    inputs = rng.standard_normal((3, fibres, INPUTS)).astype(np.float32)
    alive = rng.random((3, fibres)) < 0.7
    mean, spread = expected(weights, inputs, alive)
    for press in range(3):
        for fibre in range(fibres):
            others = [c for c in range(fibres) if c != fibre and alive[press, c]]
            means, variances = [], []
            for e in range(MEMBERS):
                h = weights["first.b"][e].astype(float)
                for c in others:
                    h = h + inputs[press, c] @ weights["first.w"][e, c] + weights["first.alive"][e, c]
                h = h / (1 + np.exp(-h))
                h = h @ weights["hidden.w"][e] + weights["hidden.b"][e]
                h = h / (1 + np.exp(-h))
                out = h @ weights["last.w"][e, fibre] + weights["last.b"][e, fibre]
                means.append(out[:TARGETS])
                variances.append(np.exp(2 * np.clip(out[TARGETS:], *residuals.LOG_SPREAD)))
            assert np.allclose(mean[press, fibre], np.mean(means, axis=0), atol=1e-4)
            total = np.mean(variances, axis=0) + np.var(means, axis=0)
            assert np.allclose(spread[press, fibre], np.sqrt(total), rtol=1e-3, atol=1e-4)


def test_the_trace_of_a_press_keeps_to_it() -> None:
    readings = np.arange(100.0)[:, None] * [1.0, 2.0]
    whole = residuals.press_trace(readings, begun=30, lifted=55, low=0, high=100)
    assert whole.shape == (2, TRACE)
    assert whole[0].tolist() == [*range(20, 50), *range(55, 75)]
    tight = residuals.press_trace(readings, begun=30, lifted=34, low=28, high=36)
    assert tight[0].tolist() == [28] * 9 + [29] + [30, 31, 32, 33] + [33] * 16 + [34, 35] + [35] * 18


def test_the_others_tell_what_a_fibre_answers(pad: Recording, model: HealthModel) -> None:
    traces = traces_of(pad.readings, pad.begun, pad.lifted)
    history = residuals.History.none(6)
    rows = [model.shapes.advance(press, history) for press in traces]
    inputs, targets = model.shapes.scaled(np.stack([a for a, _ in rows]), np.stack([b for _, b in rows]))
    new = slice(LEARNT, None)
    mean, spread = expected(model.weights, inputs[new], np.ones((PRESSES - LEARNT, 6), dtype=bool))
    error = targets[new] - mean
    # The first component is nearly all of an answer.
    assert (error[:, :, 0] ** 2).mean() < 0.5 * (targets[new, :, 0] ** 2).mean()
    inside = (np.abs(error) < 2 * spread * model.evidence.scale).mean()
    # Two spreads of Student's t with 5 degrees of freedom hold 0.898.
    assert 0.8 < inside < 0.96


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1e-3, 10))
def test_noise_is_that_of_the_quiet_thirds_and_spikes_are_none(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    traces = size * rng.standard_normal((2, 3, TRACE))
    found = noise_of(traces)
    for index in np.ndindex(2, 3):
        own = traces[index]
        steps = sorted(abs(np.concatenate([np.diff(own[:10]), np.diff(own[20:30]), np.diff(own[40:])])))
        assert found[index] == pytest.approx(np.mean(steps[:20]))
    spiked = traces.copy()
    spiked[:, :, 5] += 1000 * size
    assert (noise_of(spiked) < 2 * found).all()
    steep = traces.copy()
    steep[:, :, 10:20] += 1000 * size * np.arange(10)
    assert (noise_of(steep) == found).all()


def test_a_climb_is_the_best_sum_over_all_beginnings() -> None:
    rng = np.random.default_rng(3)
    stay, begin = rng.normal(-0.3, 1, (2, 40))
    height = np.zeros(())
    for press in range(40):
        height = climb(height, stay[press], begin[press])
        sums = [begin[first] + stay[first + 1 : press + 1].sum() for first in range(press + 1)]
        # Having begun worth nothing before the first press is as good as any beginning.
        none = [stay[first : press + 1].sum() for first in range(press + 2)]
        assert height == pytest.approx(max(0.0, *sums, *none))


def test_the_tail_of_exact_ratios_is_known_and_leads_to_the_rate_of_false_alarms() -> None:
    def ratios(presses: int, seed: int) -> Array:
        """Of a mean of 1 against 0, for numbers of mean 0."""
        return np.random.default_rng(seed).standard_normal((presses, 3, 1)) - 0.5

    learnt = ratios(20_000, 0)
    tail = Tail.fit([(learnt, learnt)])
    # Exact likelihood ratios climb to h with a chance of about exp(-h) (Wald).
    assert tail.slope[0, 0] == pytest.approx(1, abs=0.15)
    threshold = tail.level[0] + tail.slope[0] * np.log(1 / 1e-3)
    height, alarms = np.zeros((3, 1)), 0
    for press in ratios(100_000, 1):
        height = climb(height, press, press)
        alarms += int((height > threshold).sum())
        height = np.where(height > threshold, 0.0, height)
    # A hundred are allowed; the level is on the safe side by a factor of ten at most.
    assert 10 <= alarms <= 100


def test_a_step_is_found_with_its_sign_and_smooth_answers_are_none(model: HealthModel, pad: Recording) -> None:
    traces = traces_of(pad.readings, pad.begun, pad.lifted)[LEARNT:]
    healthy = np.abs(model.evidence.steps(traces))
    for size in (0.1, -0.1):
        stepped = traces + size * (np.arange(TRACE) >= 24)
        found = model.evidence.steps(stepped)
        assert (np.sign(found) == np.sign(size)).all()
        assert np.abs(found).min() > np.quantile(healthy, 0.99)


Fault = Callable[[Array, int, np.random.Generator], None]


def stuck(readings: Array, at: int, rng: np.random.Generator) -> None:
    readings[at:, 1] = readings[at, 1]


def open_low(readings: Array, at: int, rng: np.random.Generator) -> None:
    readings[at:, 1] = 0.0


def floating(readings: Array, at: int, rng: np.random.Generator) -> None:
    readings[at:, 1] = rng.uniform(0, 3.3, len(readings) - at)


def swapped(readings: Array, at: int, rng: np.random.Generator) -> None:
    readings[at:, [1, 4]] = readings[at:, [4, 1]]


def noisy(readings: Array, at: int, rng: np.random.Generator) -> None:
    readings[at:, 1] += 0.016 * rng.standard_normal(len(readings) - at)


def offset(readings: Array, at: int, rng: np.random.Generator) -> None:
    readings[at:, 1] += 0.1


def drifting(readings: Array, at: int, rng: np.random.Generator) -> None:
    readings[at:, 1] -= 5e-5 * np.arange(len(readings) - at)


def weak(readings: Array, at: int, rng: np.random.Generator) -> None:
    rest = np.median(readings[at - 400 : at, 1])
    readings[at:, 1] = rest + 0.5 * (readings[at:, 1] - rest)


@pytest.mark.parametrize(
    ("fault", "kind", "within"),
    [
        (stuck, {"stuck"}, 20),
        (open_low, {"open"}, 20),
        (floating, {"open"}, 20),
        (swapped, {"swapped", "offset"}, 20),
        (noisy, {"noisy"}, 20),
        (offset, {"offset"}, 20),
        (drifting, {"drifting"}, 60),
        (weak, {"weak"}, 60),
    ],
)
def test_a_bad_fibre_is_named_once_with_its_fault(
    pad: Recording, model: HealthModel, fault: Fault, kind: set[str], within: int
) -> None:
    readings = pad.readings.copy()
    fault(readings, int(pad.begun[BAD_FROM]), np.random.default_rng(2))
    findings = later(model, readings, pad)
    first = findings[0]
    bad_from = BAD_FROM - LEARNT
    assert first.kind in kind
    # Where rests differ a swap shows as two offsets before the answers have told what it is.
    guilty = {1, 4} if fault is swapped else {1}
    named = [fibre for finding in findings for fibre in finding.fibres]
    assert bad_from <= first.press <= bad_from + within
    assert first.since <= first.press
    assert first.score >= 5
    # Named is named: no fibre is reported twice, and no sound one with it.
    assert sorted(named) == sorted(guilty)


@pytest.mark.parametrize(("beyond", "kind"), [(-1.01, "open"), (-0.99, "stuck"), (0.99, "stuck"), (1.01, "open")])
def test_one_value_farther_off_than_rests_ever_spread_is_open_and_else_stuck(
    model: HealthModel, beyond: float, kind: str
) -> None:
    low, high = model.rests[:, 1]
    value = (high if beyond > 0 else low) + beyond * (high - low)
    monitor = Monitor(model)
    fibres = len(model.living)
    flat, none = np.full((fibres, TRACE), value), np.zeros((fibres, 1))
    monitor._recent.append(_Press(flat, none.astype(np.float32), none, np.zeros(fibres), np.ones(fibres, bool)))
    assert monitor._kind(1, 0, 0) == kind


def test_a_healthy_pad_is_left_in_peace(pad: Recording, model: HealthModel) -> None:
    assert later(model, pad.readings, pad) == []


def test_presses_one_by_one_tell_the_same(pad: Recording, model: HealthModel) -> None:
    readings = pad.readings.copy()
    noisy(readings, int(pad.begun[BAD_FROM]), np.random.default_rng(2))
    monitor = Monitor(model)
    findings: list[FibreFault] = []
    for press in range(LEARNT, PRESSES):
        first = pad.begun[press] - 10
        last = pad.begun[press + 1] if press + 1 < PRESSES else len(readings)
        findings += monitor.update(readings[first:last], 10, int(pad.lifted[press] - first))
    assert findings == later(model, readings, pad)
    assert monitor.lost == (1,)
    assert monitor.presses == PRESSES - LEARNT


def test_missing_readings_speak_for_nothing_until_they_are_missing_for_long(pad: Recording, model: HealthModel) -> None:
    readings = pad.readings.copy()
    start = int(pad.begun[BAD_FROM])
    readings[start : start + 12 * 40, 2] = np.nan
    assert later(model, readings, pad) == []
    readings[start:, 2] = np.nan
    (finding,) = later(model, readings, pad)
    assert (finding.kind, finding.fibres) == ("missing", (2,))
    # The trace of the press before reaches into the gap only where presses follow at once: here it does.
    assert finding.press - finding.since == 19


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


def test_files_keep_every_bit(pad: Recording, model: HealthModel, tmp_path: Path) -> None:
    replace(model, provenance={"command": "test"}).save(tmp_path)
    read = HealthModel.load(tmp_path)
    assert read.provenance == {"command": "test"}
    readings = pad.readings.copy()
    weak(readings, int(pad.begun[BAD_FROM]), np.random.default_rng(2))
    assert later(read, readings, pad) == later(model, readings, pad)
    assert {file.name for file in tmp_path.iterdir()} == {DOCUMENT, WEIGHTS}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"false_alarms": 0.0}, "false_alarms: got 0.0"),
        ({"rate_hz": "fast"}, "rate_hz: got 'fast'"),
        ({"dead": [6]}, "dead is \\[6\\]"),
        ({"dead": [2]}, "is .*, expected"),
        ({"format": "padforge-localizer/1"}, "format is 'padforge-localizer/1'"),
        ({"weights_sha256": "0" * 64}, "not the weights"),
        ({"more": 1}, "more: no such key"),
    ],
)
def test_a_changed_document_is_refused(model: HealthModel, tmp_path: Path, change: dict, message: str) -> None:
    model.save(tmp_path)
    document = json.loads((tmp_path / DOCUMENT).read_text())
    (tmp_path / DOCUMENT).write_text(json.dumps(document | change))
    with pytest.raises(InputError, match=message) as caught:
        HealthModel.load(tmp_path)
    assert "\n" not in str(caught.value)


def test_torn_files_are_refused(model: HealthModel, tmp_path: Path) -> None:
    model.save(tmp_path)
    content = (tmp_path / WEIGHTS).read_bytes()
    (tmp_path / WEIGHTS).write_bytes(content[:-1])
    with pytest.raises(InputError, match="not the weights"):
        HealthModel.load(tmp_path)
    (tmp_path / WEIGHTS).unlink()
    with pytest.raises(InputError, match="cannot be read"):
        HealthModel.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("tail.slope", 0.0), ("evidence.noise", np.nan), ("shapes.basis", np.inf), ("evidence.scale", -1.0)],
)
def test_unsound_numbers_are_refused(model: HealthModel, tmp_path: Path, name: str, value: float) -> None:
    part, key = name.split(".")
    spoilt = getattr(getattr(model, part), key).copy()
    spoilt.flat[0] = value
    replace(model, **{part: replace(getattr(model, part), **{key: spoilt})}).save(tmp_path)
    with pytest.raises(InputError, match=name):
        HealthModel.load(tmp_path)


def test_a_recording_that_does_not_fit_is_refused(pad: Recording, model: HealthModel) -> None:
    presses = pad.begun, pad.lifted
    with pytest.raises(InputError, match="recording has 5 fibres, health was learnt from 6"):
        examine(model, pad.readings[:, :5], pad.times_s, *presses)
    with pytest.raises(InputError, match="readings a second"):
        examine(model, pad.readings, 2 * pad.times_s, *presses)
    with pytest.raises(InputError, match="each to end before the next begins"):
        examine(model, pad.readings, pad.times_s, pad.lifted, pad.begun)
    with pytest.raises(InputError, match="times have shape"):
        examine(model, pad.readings, pad.times_s[1:], *presses)
    with pytest.raises(InputError, match=r"expected \(R, 6\)"):
        Monitor(model).update(pad.readings[:60, :5], 10, 30)
    with pytest.raises(InputError, match="begun is 0, allowed is a whole number from 1"):
        Monitor(model).update(pad.readings[:60], 0, 30)


@pytest.mark.parametrize(
    ("begun", "lifted", "sound"),
    [
        ([1, 5], [5, 9], True),
        ([0, 5], [4, 9], False),
        ([1, 4], [5, 9], False),
        ([1, 5], [1, 9], False),
        ([1, 5], [2, 5], False),
        ([1, 5], [5, 10], False),
    ],
)
def test_presses_follow_each_other_within_the_readings(begun: list[int], lifted: list[int], sound: bool) -> None:
    readings, times_s = np.zeros((9, 2)), np.arange(9.0)
    if sound:
        found = checked_presses(readings, times_s, begun, lifted)
        assert [part.tolist() for part in found[2:]] == [begun, lifted]
    else:
        with pytest.raises(InputError, match="each to end before the next begins"):
            checked_presses(readings, times_s, begun, lifted)


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
    assert _dead(readings).tolist() == [1, 2, 4, 5, 7]


def test_every_hypothesis_has_an_equal_part_of_the_false_alarms(model: HealthModel) -> None:
    for alarms in (1e-3, 1e-5):
        assert np.exp(-replace(model, false_alarms=alarms).threshold) == pytest.approx(alarms / len(HYPOTHESES))


def test_what_cannot_be_learnt_from_is_refused(pad: Recording) -> None:
    with pytest.raises(InputError, match=f"299 whole presses, health is learnt from {LEAST_PRESSES}"):
        learn(pad.readings, pad, LEAST_PRESSES - 1)
    with pytest.raises(InputError, match="all 6 fibres are dead"):
        learn(np.ones_like(pad.readings), pad)
    with pytest.raises(InputError, match="false alarms a press are 0"):
        HealthModel.fit(pad.readings, pad.times_s, pad.begun, pad.lifted, rng=np.random.default_rng(0), false_alarms=0)


def test_findings_are_told_in_one_line_each() -> None:
    findings = [FibreFault(30, 21, (1, 4), "swapped", 7.2), FibreFault(50, 41, (0,), "weak", 6.0)]
    told = fault_lines(findings, 6, dead=(5,))
    assert told == [
        "fibre 5 was dead in the recording that health was learnt from",
        "fibres 1 and 4 have changed places (swapped) since press 21, found at press 30; by chance once in 1e7 presses",
        "fibre 0 answers by about half (weak) since press 41, found at press 50; by chance once in 1e6 presses",
        "sound fibres: 2, 3",
    ]
    # Whatever a hypothesis is called, there are words for it.
    assert {name for name in HYPOTHESES if not name.startswith("offset")} <= set(TEXTS)


def test_on_the_published_recording_faults_are_named_and_health_is_not(published: Path) -> None:
    pad = open_recording(published / "para5_long_first4500.mat")
    model = learn(pad.readings, pad, presses=1000)
    end = pad.begun[1400]
    short = Recording(pad.readings[:end], pad.times_s[:end], pad.presses_mm[:1400], pad.begun[:1400], pad.lifted[:1400])
    assert later(model, short.readings, short, first=1000) == []
    for fault, within in ((stuck, 20), (swapped, 20), (offset, 20), (weak, 60)):
        readings = short.readings.copy()
        fault(readings, int(short.begun[1300]), np.random.default_rng(0))
        found = later(model, readings, short, first=1000)[0]
        assert set(found.fibres) <= ({1, 4} if fault is swapped else {1})
        assert 300 <= found.press <= 300 + within


def test_health_learnt_from_few_presses_calls_no_fibre_weak(pad: Recording) -> None:
    model = learn(pad.readings, pad, 500)
    end = int(pad.begun[500])
    assert not examine(model, pad.readings[:end], pad.times_s[:end], pad.begun[:500], pad.lifted[:500])
    readings = pad.readings.copy()
    weak(readings, int(pad.begun[BAD_FROM]), np.random.default_rng(2))
    assert "weak" not in {finding.kind for finding in later(model, readings, pad, 500)}
