"""`localizer.h`, compiled, gives what its Python twin gives; the student in it is nearly as accurate as its teacher."""

import re
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design.common.validation import InputError
from padforge.sense import LocalizerSettings, Recording, calibrate
from padforge.sense.arrays import MAX_VOLTS
from padforge.sense.deploy.c_header import (
    WRAP_AT,
    WRAP_BY,
    HeaderReport,
    StudentNetwork,
    distill,
    evaluate_student,
    quantize,
    render_header,
)
from padforge.sense.deploy.streaming import CODE_BYTES, MAX_PRESS, MemoryBudget, commanded_presses
from padforge.sense.formats.import_export import open_recording
from padforge.sense.localizer.calibration import split_unseen
from padforge.sense.localizer.model import LocalizerModel
from tests.sense.conftest import QUICK
from tests.sense.deploy.conftest import BUDGET, Output, build_program, compile_c, tutorial_code
from tests.sense.live.conftest import first_presses

TOLERANCE_MM = 1e-3
MAX_RATIO = 1.25  # of the mean errors of a student and its teacher
MAX_RATIO_BEFORE_RELEASE = 2.2  # and of a student that does not see the release, as its teacher does


def check_twin(output: Output, twin: tuple, failed: tuple[int, ...] = ()) -> None:
    """Check that a program estimates at the same readings as its twin, and the same positions."""
    presses, prediction = twin
    masked = ~presses.features.fibre_mask | np.isin(np.arange(4), failed)
    assert np.isfinite(output.events).all()
    assert np.array_equal(output.positions[:, 0], presses.reading)
    is_final = presses.reading == presses.ended[presses.press]
    assert np.array_equal(output.positions[:, 7:9], np.column_stack([presses.n_readings, is_final]))
    assert np.hypot(*(output.positions[:, 2:4] - prediction.positions_mm).T).max(initial=0) < TOLERANCE_MM
    radii = np.column_stack([prediction.r50_mm, prediction.r90_mm])
    np.testing.assert_allclose(output.positions[:, 4:6], radii, rtol=1e-4)
    assert np.array_equal(output.positions[:, 6], masked.sum(axis=1))


@pytest.mark.parametrize("weights", ["student", "quantized"])
def test_header_gives_positions_of_the_twin_within_its_budget(weights: str, recording, tmp_path, request) -> None:
    student = request.getfixturevalue(weights)
    pressed, run = commanded_presses(recording), build_program(student, tmp_path)
    for failed in ((), (0, 2), (0, 1, 2, 3)):
        output = run(recording.readings, pressed, failed)
        assert output.positions[:, 8].sum() == 299  # the last press is held to the end of the recording
        check_twin(output, student.predict(recording.readings, pressed, failed), failed)
        assert output.tables == student.table_bytes <= 40_000 - CODE_BYTES
        assert output.state <= student.state_bytes <= 8_000


def test_header_detects_presses_of_the_twin(student, program, recording) -> None:
    output, twin = program(recording.readings), student.predict(recording.readings)
    assert len(twin[0].down_command) >= 290
    check_twin(output, twin)
    kinds = output.events[:, 1].astype(int)
    touched, released = output.events[kinds & 1 > 0, 0], output.events[kinds & 4 > 0, 0]
    assert len(touched) == len(twin[0].down_command)
    assert np.array_equal(released, twin[0].ended[: len(released)])
    assert (touched[: len(released)] < released).all()


def test_header_takes_a_long_press_for_a_new_rest(student, program, recording) -> None:
    """A fibre breaks while the pad is free."""
    readings = np.array(recording.readings)
    readings[2012:, 0] = 0.0
    twin = student.predict(readings)
    assert (twin[0].ended - twin[0].down_command > MAX_PRESS).sum() == 1
    check_twin(program(readings), twin)


def test_header_gives_depth_and_force(deep_student, deep_recording, tmp_path) -> None:
    pressed, run = commanded_presses(deep_recording), build_program(deep_student, tmp_path, "-DDEPTH")
    for failed in ((), (0, 1, 2, 3)):
        output = run(deep_recording.readings, pressed, failed)
        twin = deep_student.predict(deep_recording.readings, pressed, failed)
        check_twin(output, twin, failed)
        measures = [column for each in twin[1].measures.values() for column in (each.values, each.r90)]
        np.testing.assert_allclose(output.positions[:, 9:], np.column_stack(measures), rtol=1e-4, atol=1e-4)


def test_header_writes_whole_rates_as_floats(student) -> None:
    for rate, literal in ((13.0, "13.0f"), (13.333, "13.33f"), (20_000.0, "2e+04f")):
        other = replace(student, model=replace(student.model, rate_hz=rate))
        assert f"#define LOCALIZER_RATE_HZ {literal}\n" in render_header(other, BUDGET, [])


def test_header_holds_the_very_numbers_of_its_tables(student) -> None:
    text = render_header(student, BUDGET, [])
    for name, table in (("mean", student.model.scaler.mean_v), ("first_b", student.weights["first.b"])):
        match = re.search(rf"localizer_{name}_\[\d+\] = {{\n(.*?)\n}};", text, re.DOTALL)
        assert match is not None
        numbers = [float(number.strip().removesuffix("f")) for number in match[1].split(",")]
        assert np.array_equal(np.array(numbers, np.float32), table.ravel().astype(np.float32))


@pytest.mark.parametrize("short", ["ram", "flash"])
def test_header_beyond_its_budget_does_not_compile(student, tmp_path, short: str) -> None:
    flash = student.table_bytes + CODE_BYTES
    budget = MemoryBudget(flash, 500) if short == "ram" else MemoryBudget(flash - 1, 8_000)
    with pytest.raises(subprocess.CalledProcessError):
        build_program(student, tmp_path, budget=budget)


@pytest.mark.parametrize("sign", [-1, 1])
def test_header_limits_the_errors_that_it_expects(student, recording, tmp_path, sign: int) -> None:
    """A network far from its training answers with errors of any size."""
    networks = {
        name: weights | {"last.b": weights["last.b"] + sign * np.float32(30)}
        for name, weights in student.model.networks.items()
    }
    sure, pressed = replace(student, model=replace(student.model, networks=networks)), commanded_presses(recording)
    check_twin(build_program(sure, tmp_path)(recording.readings, pressed), sure.predict(recording.readings, pressed))


def test_program_of_the_tutorial_prints_touches(student, recording, tmp_path) -> None:
    (tmp_path / "localizer.h").write_text(render_header(student, BUDGET, []))
    (tmp_path / "main.c").write_text(tutorial_code("main", "c"))
    program = compile_c(tmp_path / "main.c", tmp_path)
    rows = np.column_stack([recording.times_s, recording.readings])
    text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    lines = subprocess.run([program], input=text, capture_output=True, check=True, text=True).stdout.splitlines()
    numbers = np.array([re.findall(r"-?\d+\.\d", line) for line in lines], float)
    presses, prediction = student.predict(recording.readings)
    assert len(lines) == len(presses.reading)
    assert sum(line.endswith("released") for line in lines) in (len(presses.ended) - 1, len(presses.ended))
    np.testing.assert_allclose(numbers[:, 0], recording.times_s[presses.reading], atol=0.052)
    np.testing.assert_allclose(numbers[:, 1:3], prediction.positions_mm, atol=0.052)
    np.testing.assert_allclose(numbers[:, 3], prediction.r90_mm, atol=0.052)


def test_header_survives_the_wrap_of_its_counter(student, recording, tmp_path) -> None:
    """The counter goes back after 2^30 readings: here after 200, at the same position of the ring."""
    text = render_header(student, BUDGET, [])
    assert f">= {WRAP_AT} " in text
    short = text.replace(f">= {WRAP_AT} ", ">= 200 ").replace(str(WRAP_BY), "128")
    check_twin(build_program(student, tmp_path, text=short)(recording.readings), student.predict(recording.readings))


BROKEN = """
#include <stdio.h>
#include "localizer.h"
int main(void) {
  static localizer_state pad;
  localizer_touch touch;
  const float volts[LOCALIZER_FIBRES] = {NAN, 1.0f, 1.0f, 1.0f};
  localizer_init(&pad);
  for (int n = 0; n < 50; n++) {
    memset(&touch, 1, sizeof touch);
    localizer_reading_held(&pad, volts, 0.5f * (float)n, n >= 40, &touch);
  }
  printf("%ld %d %.1f %g", (long)pad.missing[0], touch.n_failed, touch.seconds, touch.r90_mm);
  return 0;
}
"""
"""A fibre is missing, and the pad is pressed with the last readings."""


def test_header_counts_missing_readings_and_the_time_of_a_press_alone(student, tmp_path) -> None:
    """A broken fibre is missing for years while nobody presses, and the counter has 32 bits."""
    (tmp_path / "localizer.h").write_text(render_header(student, BUDGET, []))
    for source, expected in ((BROKEN, "9 1 20.0 "), (BROKEN.replace("n >= 40", "0"), "0 0 0.0 0")):
        (tmp_path / "main.c").write_text(source)
        program = compile_c(tmp_path / "main.c", tmp_path)
        assert subprocess.run([program], check=True, capture_output=True, text=True).stdout.startswith(expected)


def test_header_takes_the_radii_of_the_most_failures_for_more(student, recording, tmp_path) -> None:
    """They were calibrated for one failed fibre only."""
    model = replace(student.model, interval_factors=student.model.interval_factors[:, :2])
    fewer, pressed = replace(student, model=model), commanded_presses(recording)
    output = build_program(fewer, tmp_path)(recording.readings, pressed, (0, 1, 2))
    check_twin(output, fewer.predict(recording.readings, pressed, (0, 1, 2)), (0, 1, 2))


def test_header_agrees_with_its_twin_on_any_readings(student, program) -> None:
    """Steps, spikes, gaps and values that are no voltage, with its own detector and without."""

    @given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 0.1, 10.0]), st.booleans())
    @settings(max_examples=15)
    def check(seed: int, step: float, is_held: bool) -> None:
        rng = np.random.default_rng(seed)
        levels = np.cumsum(step * rng.standard_normal((400, 4)) * (rng.random((400, 1)) < 0.1), axis=0)
        readings = 2 + levels + 1e-3 * rng.standard_normal((400, 4))
        odd = rng.random(readings.shape) < 0.02
        readings[odd] = rng.choice([np.nan, np.inf, -np.inf, 1e30, 5e3, 0.0, 900.0, MAX_VOLTS], odd.sum())
        readings[200:300, 1] = rng.choice([np.inf, 2.0])
        pressed = np.resize(np.repeat(rng.random(100) < 0.4, rng.integers(1, 9, 100)), 400) if is_held else None
        check_twin(program(readings, pressed), student.predict(readings, pressed))

    check()


def test_student_is_nearly_as_accurate_as_its_teacher(
    student: StudentNetwork, recording: Recording, localizer: LocalizerModel
) -> None:
    _, test = split_unseen(recording, localizer, QUICK)
    assert set(test.tolist()) == set(localizer.test)
    evaluation = evaluate_student(student, localizer, recording, test)
    header, teacher = evaluation["errors"]["header"], evaluation["errors"]["whole press"]
    assert list(evaluation["errors"]) == ["header", "at the end", "whole press"]
    assert header[0]["mean_mm"] < MAX_RATIO_BEFORE_RELEASE * teacher[0]["mean_mm"]
    assert [row["n_failed"] for row in header] == [0, 1, 2, 3]
    assert all(0.75 < row["within_r90"] < 1 for row in header)
    assert (evaluation["n_detected"], evaluation["n_false"]) == (len(test), 0)
    assert evaluation["detected_mean_mm"] < MAX_RATIO_BEFORE_RELEASE * teacher[0]["mean_mm"]


@pytest.mark.slow
def test_student_is_nearly_as_accurate_as_its_teacher_before_the_release_on_the_published_recording(
    published: Path,
) -> None:
    """With 64 KiB of RAM, after a training of the same length."""
    recording = first_presses(open_recording(published / "para5_long_first4500.mat"), 1200)
    options = LocalizerSettings(members=1, hidden=64, layers=3, epochs=24, batch=128, max_failures=0)
    localizer, _ = calibrate(recording, options)
    training, test = split_unseen(recording, localizer, options)
    student = distill(recording, localizer, training, MemoryBudget(150_000, 65_536), options)
    evaluation = evaluate_student(student, localizer, recording, test)
    errors = evaluation["errors"]
    assert errors["header"][0]["mean_mm"] <= MAX_RATIO * errors["at the end"][0]["mean_mm"]
    assert evaluation["n_detected"] >= 0.95 * len(test)
    assert evaluation["n_false"] <= 0.03 * len(test)


def test_distill_ignores_test_presses(brief: Recording, localizer: LocalizerModel) -> None:
    training, test = split_unseen(brief, localizer, QUICK)
    assert (len(training), len(test)) == (34, 6)
    assert not set(training.tolist()) & set(test.tolist())
    wrong = np.array(brief.presses_mm)
    wrong[test] = 0.0
    options, budget = QUICK.model_copy(update={"epochs": 2}), MemoryBudget(20_000, 4_000)
    recordings = brief, replace(brief, presses_mm=wrong)
    one, other = (distill(each, localizer, training, budget, options) for each in recordings)
    for name, weight in one.weights.items():
        assert np.array_equal(weight, other.weights[name])
    assert np.array_equal(one.model.interval_factors, other.model.interval_factors)
    assert one.detector.threshold == other.detector.threshold


def test_split_leaves_out_presses_that_cannot_test(brief: Recording, localizer: LocalizerModel) -> None:
    unknown = np.array(brief.presses_mm)
    unknown[:10] = np.nan
    training, test = split_unseen(replace(brief, presses_mm=unknown), localizer, QUICK)
    assert min(*training, *test) == 10
    with pytest.raises(InputError, match="the localizer was recalibrated by"):
        split_unseen(brief, replace(localizer, recalibrated_by=(brief.digest,)), QUICK)


def test_quantize_is_within_half_a_step(student: StudentNetwork) -> None:
    quantized = quantize(student.weights)
    for name, weight in student.weights.items():
        step = np.abs(weight).max(axis=-2, keepdims=True) / 127 if name.endswith(".w") else 0  # biases stay
        assert (np.abs(quantized[name] - weight) <= 0.501 * step).all()
        assert not name.endswith(".w") or (np.abs(np.rint(quantized[name] / step)) <= 127).all()


def test_header_report_is_in_kibibytes() -> None:
    """Of tables of 2 and a state of 1.5 KiB."""
    student = SimpleNamespace(hidden=8, quantized=True, table_bytes=2048, state_bytes=1536)
    rows = [{"n_failed": 0, "subsets": 1, "mean_mm": 1.234}, {"n_failed": 1, "subsets": 4, "mean_mm": 2.5}]
    evaluation = {"errors": {"header": rows, "at the end": rows}, "n_detected": 7, "n_false": 1}
    report = HeaderReport(student, evaluation | {"detected_mean_mm": 3.125}, 9)  # type: ignore[arg-type]
    lines = report.lines(MemoryBudget(40 * 1024, 8192, True))
    code_kib = CODE_BYTES / 1024
    assert f"int8: flash {2 + code_kib:.1f} KiB of 40, {code_kib:g} of them for code; RAM 1.5 KiB of 8" in lines[0]
    assert lines[3].split() == ["0", "1", "1.23", "1.23"]
    assert lines[4].split() == ["1", "4", "2.50", "2.50"]
    assert "detects 7 of 9 presses, with 1 false detections; mean error of these 3.12 mm" in lines[5]
