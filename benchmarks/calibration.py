"""Test errors of calibrations against their run time, for shorter trainings and smaller networks.

`python -m padforge.benchmarks.calibration OUT [RECORDING.mat PRESSES...]` prints a table and draws
OUT/bench_calibration.png: for presses on a simulated pad, and for each number PRESSES of those in a recording of the
authors. A case takes some three minutes on two cores, which nothing else should use meanwhile.
"""

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from padforge.benchmarks.harness import Row, draw_times
from padforge.common.plotting import save_figure
from padforge.design import Morphology
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense import LocalizerSettings, RigSettings, import_mat, simulate
from padforge.sense.arrays import Indices
from padforge.sense.localizer.bayes import fit_stages
from padforge.sense.localizer.calibration import fit_recording
from padforge.sense.localizer.evaluation import distances, evaluate
from padforge.sense.localizer.features import compute_features
from padforge.sense.localizer.scaler import FeatureScaler, leave_one_out_residuals
from padforge.sense.recording.frames import frame_rate_hz, framed
from padforge.sense.recording.recording import Recording

SIMULATED = 1275  # presses of the training on the simulated pad
TEST = 400  # presses that are not trained on, and on which errors are measured
MAX_FAILURES = 3
EPOCHS = (10, 40, 80, 150)
WAYS: dict[str, dict[str, Any]] = {
    "as by default": {},
    "networks of 64 x 3": {"hidden": 64, "layers": 3},
    "no Bayesian member": {"members": 1},
}
"""Settings that differ from the default."""


def trials(case: str, recording: Recording, n_training: int) -> Iterator[Row]:
    """Yield calibrations by all ways, each with its run time and its errors, on presses that are drawn at random."""
    rng = np.random.default_rng(0)
    order = rng.permutation(np.flatnonzero(recording.has_position))
    training, test = order[:n_training], order[n_training : n_training + TEST]
    begin = time.perf_counter()
    errors_mm = _bayesian_errors(recording, training, test)
    yield _row(case, "Bayesian alone", 0, time.perf_counter() - begin, errors_mm)
    for (way, changes), epochs in product(WAYS.items(), EPOCHS):
        options = LocalizerSettings(max_failures=MAX_FAILURES, epochs=epochs, **changes)
        begin = time.perf_counter()
        model = fit_recording(recording, np.sort(training), options, np.random.default_rng(0))
        seconds = time.perf_counter() - begin
        model = replace(model, test=tuple(test.tolist()))
        evaluation = evaluate(model, recording, range(MAX_FAILURES + 1), by_moment=False)
        yield _row(case, way, epochs, seconds, [row["mean_mm"] for row in evaluation.errors])


def _bayesian_errors(recording: Recording, training: Indices, test: Indices) -> list[float]:
    """Return mean errors with 0, 1, ... failed fibres of the Bayesian localizer alone, after the press, in mm."""
    frames = framed(recording)
    features = compute_features(frames.readings, frames.down_command, frames.up_command)
    scaler, table = FeatureScaler.fit(features[training], recording.presses_mm[training])
    rate_hz = frame_rate_hz(recording.rate_hz)
    presses = scaler.training_presses(features[training], recording.presses_mm[training], rate_hz=rate_hz)
    presses = leave_one_out_residuals(presses, table)
    localizer = fit_stages(table, presses.inputs, presses.fibre_mask, presses.targets, presses.n_timed)[-1]

    scaled, errors_mm = scaler.transform(features[test]), []
    inputs = scaled.inputs.astype(np.float64)
    for n_failed in range(MAX_FAILURES + 1):
        means = []
        for failed in failure_subsets(recording.fibres, n_failed):
            fibre_mask = scaled.fibre_mask & ~np.isin(np.arange(recording.fibres), failed)
            position, _ = localizer.predict(inputs, fibre_mask)
            means.append(distances(scaler.positions_mm(position), recording.presses_mm[test]).mean())
        errors_mm.append(float(np.mean(means)))
    return errors_mm


def _row(case: str, way: str, epochs: int, seconds: float, errors_mm: Sequence[float]) -> Row:
    geometric_mean = float(np.exp(np.log(errors_mm).mean()))
    return {"case": case, "way": way, "size": epochs, "seconds": seconds, "errors": errors_mm, "error": geometric_mean}


def main(out: Path, mat: Path | None, presses: Sequence[int]) -> None:
    """Calibrate on the simulated pad and, if `mat` is a recording, on each of these numbers of its presses.

    A line of a table is printed after each calibration; their errors are drawn against their run times.
    """
    pad = Morphology.straight(4)
    cases = [("simulated", simulate(pad, RigSettings(presses=SIMULATED + TEST, seed=0)), SIMULATED)]
    if mat is not None:
        recording = import_mat(mat)
        cases += [(f"{number} real presses", recording, number) for number in presses]
    rows: list[Row] = []
    for case, recording, n_training in cases:
        for row in trials(case, recording, n_training):
            rows.append(row)
            errors = " ".join(f"{error:.2f}" for error in row["errors"])
            print(
                f"{case:<18} {row['way']:<20} {row['size'] or '-':>4} {row['seconds']:6.1f} s  {errors} mm", flush=True
            )
        save_figure(draw_times("calibration", rows, "mean error (mm)"), out / "bench_calibration.png")


if __name__ == "__main__":
    folder, *recorded = sys.argv[1:]
    main(Path(folder), Path(recorded[0]) if recorded else None, [int(number) for number in recorded[1:]])
