"""`localizer.h`, compiled and fed readings: it tells what its Python twin tells."""

import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.deploy import streaming
from padforge.sense.deploy.c_header import c_header
from padforge.sense.deploy.streaming import CODE, Budget, state_bytes, table_bytes
from tests.sense.deploy.conftest import BUDGET, Told, compiled, program_of, tutorial

OFF_MM = 1e-3


def require_twin(told: Told, twin: tuple, lost: tuple[int, ...] = ()) -> None:
    """See that a program tells the same presses as its twin, at the same readings and places."""
    seen, found = twin
    missing = ~seen.inputs.fibre_mask | np.isin(np.arange(4), lost)
    assert np.isfinite(told.events).all()
    assert np.array_equal(told.places[:, 0], seen.told)
    assert np.hypot(*(told.places[:, 2:4] - found.positions_mm).T).max(initial=0) < OFF_MM
    np.testing.assert_allclose(told.places[:, 4:6], np.column_stack([found.r50_mm, found.r90_mm]), rtol=1e-4)
    assert np.array_equal(told.places[:, 6], missing.sum(axis=1))


@pytest.mark.parametrize("weights", ["taught", "quantized"])
def test_places_are_those_of_the_python_student(weights: str, recording, tmp_path, request) -> None:
    student = request.getfixturevalue(weights)
    held, run = streaming.held(recording), program_of(student, tmp_path)
    for lost in ((), (1,), (0, 2), (0, 1, 2), (0, 1, 2, 3)):
        told = run(recording.readings, held, lost)
        assert len(told.places) == 300
        require_twin(told, student.touches(recording.readings, held, lost), lost)
    measures, levels = len(student.localizer.scaler.measures), len(student.localizer.interval_factors)
    told = run(np.zeros((1, 4)))
    assert told.tables == table_bytes(4, measures, levels, student.hidden, student.quantized)
    assert told.tables + CODE <= 40_000
    assert told.state <= state_bytes(4, measures, student.hidden) <= 8_000


def test_its_own_detector_is_that_of_the_twin(taught, program, recording) -> None:
    told, twin = program(recording.readings), taught.touches(recording.readings)
    assert len(twin[0].told) >= 290
    require_twin(told, twin)
    what = told.events[:, 1].astype(int)
    began, ended = told.events[what & 1 > 0, 0], told.events[what & 4 > 0, 0]
    assert len(began) == len(twin[0].told)
    assert np.array_equal(ended, twin[0].ended[: len(ended)])
    assert (began[: len(ended)] < ended).all()


def test_depth_and_force_come_with_the_place_where_they_were_learnt(deeply, deep_recording, tmp_path) -> None:
    held = streaming.held(deep_recording)
    told = program_of(deeply, tmp_path, "-DDEPTH")(deep_recording.readings, held)
    twin = deeply.touches(deep_recording.readings, held)
    require_twin(told, twin)
    measures = [column for each in twin[1].measures.values() for column in (each.values, each.r90)]
    np.testing.assert_allclose(told.places[:, 7:], np.column_stack(measures), rtol=1e-4, atol=1e-4)


def test_a_rate_of_whole_readings_is_a_number_of_c(taught) -> None:
    for rate, told in ((13.0, "13.0f"), (13.333, "13.33f"), (20_000.0, "2e+04f")):
        student = replace(taught, localizer=replace(taught.localizer, rate_hz=rate))
        assert f"#define LOCALIZER_RATE_HZ {told}\n" in c_header(student, BUDGET, [])


def test_a_header_beyond_its_budget_does_not_compile(taught, tmp_path) -> None:
    for budget in (Budget(40_000, 500), Budget(9_000, 8_000)):
        with pytest.raises(subprocess.CalledProcessError):
            program_of(taught, tmp_path, budget=budget)


def test_the_program_of_the_tutorial_does_as_it_says(taught, recording, tmp_path) -> None:
    (tmp_path / "localizer.h").write_text(c_header(taught, BUDGET, []))
    (tmp_path / "main.c").write_text(tutorial("main", "c"))
    program = compiled(tmp_path / "main.c", tmp_path)
    rows = np.column_stack([recording.times_s, recording.readings])
    given = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    lines = subprocess.run([program], input=given, capture_output=True, check=True, text=True).stdout.splitlines()
    numbers = np.array([re.findall(r"-?\d+\.\d", line) for line in lines], float)
    seen, found = taught.touches(recording.readings)
    assert len(lines) == len(seen.told)
    np.testing.assert_allclose(numbers[:, 1:3], found.positions_mm, atol=0.052)
    np.testing.assert_allclose(numbers[:, 3], found.r90_mm, atol=0.052)
    late = numbers[:, 0] - recording.times_s[seen.down_command]
    assert (late > -0.06).all()
    assert (late < 0.8).all()


def test_it_counts_on_when_its_counter_goes_back(taught, recording, tmp_path) -> None:
    """The counter of readings goes back after 2^30 of them: here after 200, at the same place of the ring."""
    text = c_header(taught, BUDGET, [])
    assert f">= {2**30} " in text
    short = text.replace(f">= {2**30} ", ">= 200 ").replace(str(2**29), "128")
    told = program_of(taught, tmp_path, text=short)(recording.readings)
    require_twin(told, taught.touches(recording.readings))


def test_whatever_the_readings_it_does_as_its_twin(taught, program) -> None:
    """Steps, spikes, gaps and values that are no voltage, one or a hundred, by its own judgement and by another's."""

    @given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 0.1, 10.0]), st.booleans())
    @settings(max_examples=15)
    def check(seed: int, step: float, by_others: bool) -> None:
        rng = np.random.default_rng(seed)
        levels = np.cumsum(step * rng.standard_normal((400, 4)) * (rng.random((400, 1)) < 0.1), axis=0)
        readings = 2 + levels + 1e-3 * rng.standard_normal((400, 4))
        odd = rng.random(readings.shape) < 0.02
        readings[odd] = rng.choice([np.nan, np.inf, -np.inf, 1e30, 5e3, 0.0, 900.0], odd.sum())
        readings[200:300, 1] = rng.choice([np.inf, 2.0])
        held = np.repeat(rng.random(100) < 0.4, rng.integers(1, 9, 100))[:400] if by_others else None
        held = held if held is None else np.resize(held, 400)
        require_twin(program(readings, held), taught.touches(readings, held))

    check()
