"""`localizer.h`, compiled and fed readings: it tells what its Python twin tells."""

import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sense.live.deployment import streaming
from sense.live.deployment.budget import CODE, Budget, state_bytes, table_bytes
from sense.live.deployment.c_header import Header, c_header, header_lines
from tests.sense.live.deployment.conftest import BUDGET, compiled, tutorial

OFF_MM = 1e-3


@pytest.mark.parametrize("weights", ["taught", "quantized"])
@pytest.mark.parametrize("lost", [(), (1,), (0, 2), (0, 1, 2), (0, 1, 2, 3)])
def test_places_are_those_of_the_python_student(weights, lost, program, recording, request) -> None:
    student = request.getfixturevalue(weights)
    held = streaming.held(recording)
    told = program(student)(recording.readings, held, lost)
    seen, found = student.touches(recording.readings, held, lost)
    places = told.places
    assert len(places) == 300
    assert np.array_equal(places[:, 0], seen.told)
    assert np.hypot(*(places[:, 2:4] - found.places_mm).T).max() < OFF_MM
    np.testing.assert_allclose(places[:, 4:6], np.column_stack([found.r50_mm, found.r90_mm]), rtol=1e-4)
    assert (places[:, 6] == len(lost)).all()


def test_its_own_detector_is_that_of_the_twin(taught, program, recording) -> None:
    told = program(taught)(recording.readings)
    seen, found = taught.touches(recording.readings)
    assert len(seen.told) >= 290
    assert np.array_equal(told.places[:, 0], seen.told)
    assert np.hypot(*(told.places[:, 2:4] - found.places_mm).T).max() < OFF_MM
    what = told.events[:, 1].astype(int)
    began, ended = told.events[what & 1 > 0, 0], told.events[what & 4 > 0, 0]
    assert len(began) == len(seen.told)
    assert np.array_equal(ended, seen.ended[: len(ended)])
    assert (began[: len(ended)] < ended).all()


def test_missing_values_and_such_as_are_no_numbers_do_no_harm(taught, program, recording) -> None:
    readings = np.array(recording.readings)
    rng = np.random.default_rng(0)
    readings[rng.random(readings.shape) < 0.05] = np.nan
    readings[3000:3100, 1] = np.inf
    told, (seen, found) = program(taught)(readings), taught.touches(readings)
    assert np.isfinite(told.places).all()
    assert np.array_equal(told.places[:, 0], seen.told)
    assert np.hypot(*(told.places[:, 2:4] - found.places_mm).T).max() < OFF_MM
    during = (told.places[:, 0] >= 3030) & (told.places[:, 0] < 3100)
    assert (told.places[during, 6] >= 1).all()


def test_depth_and_force_come_with_the_place_where_they_were_learnt(deeply, program, deep_recording) -> None:
    held = streaming.held(deep_recording)
    told = program(deeply, BUDGET, "-DDEPTH")(deep_recording.readings, held)
    _, found = deeply.touches(deep_recording.readings, held)
    measures = [column for each in found.measures.values() for column in (each.values, each.r90)]
    assert np.hypot(*(told.places[:, 2:4] - found.places_mm).T).max() < OFF_MM
    np.testing.assert_allclose(told.places[:, 7:], np.column_stack(measures), rtol=1e-4, atol=1e-4)


def test_a_rate_of_whole_readings_is_a_number_of_c(taught) -> None:
    for rate, told in ((13.0, "13.0f"), (13.333, "13.33f"), (20_000.0, "2e+04f")):
        student = replace(taught, localizer=replace(taught.localizer, rate_hz=rate))
        assert f"#define LOCALIZER_RATE_HZ {told}\n" in c_header(student, BUDGET, [])


def test_columns_are_as_wide_as_what_heads_them(taught) -> None:
    rows = {name: [{"lost": 0, "subsets": 1, "mean_mm": 1.5}] for name in ("header", "causal", "published")}
    errors = {"errors": rows, "test_presses": 9, "found": 0, "false": 2, "found_mm": None}
    lines = header_lines(Header(taught, 20_000, 2_000, errors), BUDGET)
    assert lines[2:4] == ["lost  sets    header    causal published", "   0     1      1.50      1.50      1.50"]
    assert lines[4] == "its own detector finds 0 of 9 presses, 2 touches that are none"


def test_sizes_are_those_of_the_budget(taught, quantized, program) -> None:
    for student in (taught, quantized):
        told = program(student)(np.zeros((1, 4)))
        measures, levels = len(student.localizer.normalization.measures), len(student.localizer.factors)
        sizes = (measures, levels, student.hidden, student.quantized)
        assert told.tables == table_bytes(4, *sizes)
        assert told.tables + CODE <= 40_000
        assert told.state <= state_bytes(4, measures, student.hidden) <= 8_000


def test_a_header_beyond_its_budget_does_not_compile(taught, program) -> None:
    for budget in (Budget(40_000, 500), Budget(9_000, 8_000)):
        with pytest.raises(subprocess.CalledProcessError):
            program(taught, budget)


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
    np.testing.assert_allclose(numbers[:, 1:3], found.places_mm, atol=0.052)
    np.testing.assert_allclose(numbers[:, 3], found.r90_mm, atol=0.052)
    late = numbers[:, 0] - recording.times_s[seen.begun]
    assert (late > -0.06).all()
    assert (late < 0.8).all()


def test_it_counts_on_when_its_counter_goes_back(taught, program, recording) -> None:
    """The counter of readings goes back after 2^30 of them: here after 200, at the same place of the ring."""
    text = c_header(taught, BUDGET, [])
    assert f">= {2**30} " in text
    short = text.replace(f">= {2**30} ", ">= 200 ").replace(str(2**29), "128")
    told = program(taught, BUDGET, text=short)(recording.readings)
    seen, found = taught.touches(recording.readings)
    assert np.array_equal(told.places[:, 0], seen.told)
    assert np.hypot(*(told.places[:, 2:4] - found.places_mm).T).max() < OFF_MM


def test_whatever_the_readings_it_does_as_its_twin(taught, program) -> None:
    """Steps, spikes, gaps and values that are no voltage, by its own judgement and by another's."""
    run = program(taught)

    @given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 0.1, 10.0]), st.booleans())
    @settings(max_examples=25)
    def check(seed: int, step: float, by_others: bool) -> None:
        rng = np.random.default_rng(seed)
        levels = np.cumsum(step * rng.standard_normal((400, 4)) * (rng.random((400, 1)) < 0.1), axis=0)
        readings = 2 + levels + 1e-3 * rng.standard_normal((400, 4))
        odd = rng.random(readings.shape) < 0.02
        readings[odd] = rng.choice([np.nan, np.inf, -np.inf, 1e30, 5e3, 0.0, 900.0], odd.sum())
        held = np.repeat(rng.random(100) < 0.4, rng.integers(1, 9, 100))[:400] if by_others else None
        held = held if held is None else np.resize(held, 400)
        told, (seen, found) = run(readings, held), taught.touches(readings, held)
        assert np.isfinite(told.events).all()
        places = told.places if len(told.events) else np.empty((0, 7))
        assert np.array_equal(places[:, 0], seen.told)
        assert np.hypot(*(places[:, 2:4] - found.places_mm).T).max(initial=0) < OFF_MM

    check()
