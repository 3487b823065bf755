"""`localizer.h`: a student network as one C99 file, rendered from the template `localizer.h.j2`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from padforge.design.common.files import write_text
from padforge.sense.arrays import Array, Floats
from padforge.sense.deploy import streaming
from padforge.sense.deploy.streaming import CODE_BYTES, N_LAYERS, MemoryBudget, state_bytes, table_bytes
from padforge.sense.deploy.student import (
    StudentNetwork,
    causal_reference,
    distill,
    evaluate_student,
    split_student_presses,
)
from padforge.sense.localizer import model as localizer_model
from padforge.sense.localizer import network, scaler
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import LocalizerSettings

WRAP_AT, WRAP_BY = 2**30, 2**29  # readings at which the 32-bit counter goes back, and by how many
LINE = 118  # characters


@dataclass(frozen=True)
class HeaderReport:
    """A written header, and the errors of the student in it."""

    student: StudentNetwork
    table_bytes: int
    state_bytes: int
    errors: Mapping[str, Any]  # see `evaluate_student`
    n_test: int

    def lines(self, budget: MemoryBudget) -> list[str]:
        """Return the report as text, beside the budget that it was made for."""
        student, errors = self.student, self.errors
        kind = "int8" if student.quantized else "float32"
        flash = f"flash {(self.table_bytes + CODE_BYTES) / 1024:.1f} KiB of {budget.flash / 1024:.4g}"
        columns: Mapping[str, Any] = errors["errors"]
        width = max(7, *map(len, columns))
        lines = [
            f"{student.hidden} neurons in each of {N_LAYERS + 1} layers, {kind}: {flash}, "
            f"{CODE_BYTES / 1024:g} of them for code; RAM {self.state_bytes / 1024:.1f} KiB of {budget.ram / 1024:.4g}",
            f"mean error in mm on {self.n_test} presses never trained on",
            "failed  sets" + "".join(f" {name:>{width}}" for name in columns),
        ]
        for row in zip(*columns.values(), strict=True):
            means = "".join(f" {each['mean_mm']:{width}.2f}" for each in row)
            lines.append(f"{row[0]['n_failed']:6d} {row[0]['subsets']:5d}{means}")
        mean_mm = errors["detected_mean_mm"]
        of_detected = "" if mean_mm is None else f"; mean error of these {mean_mm:.2f} mm"
        lines.append(
            f"its own detector detects {errors['n_detected']} of {self.n_test} presses, "
            f"with {errors['n_false']} false detections{of_detected}"
        )
        return lines


def export_header(
    teacher: LocalizerModel,
    digest: str,
    path: Path,
    recording: Recording,
    budget: MemoryBudget,
    options: LocalizerSettings,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> HeaderReport:
    """Distill a localizer into a student, and write that as a C header.

    Args:
        teacher: localizer to distill.
        digest: SHA-256 of its `localizer.json`.
        path: of the header.
        recording: whose presses the student is trained and tested on.
        budget: memory that the student may use.
        options: length and rate of the training, and its seed.
        on_progress: called with steps done and steps in all.

    Raises:
        InputError: raised by `split_student_presses` and `distill`, or `path` cannot be written.
    """
    training, test = split_student_presses(recording, teacher, options)
    student = distill(recording, teacher, training, budget, options, on_progress)
    n_fibres, n_measures = teacher.fibres, len(student.model.scaler.measures)
    n_levels = len(student.model.interval_factors)
    causal = causal_reference(teacher, recording, training, options, on_progress)
    errors = evaluate_student(student, [causal] if causal is teacher else [causal, teacher], recording, test)
    about = [
        f"by padforge {version('padforge')}, of localizer.json with SHA-256",
        digest,
        f"A simple detector detects touches: {errors['n_detected']} of {len(test)} presses, "
        f"with {errors['n_false']} false detections.",
        f"Mean error on these presses, never trained on: {errors['errors']['header'][0]['mean_mm']:.2f} mm.",
    ]
    write_text(path, render_header(student, budget, about))
    return HeaderReport(
        student,
        table_bytes(n_fibres, n_measures, n_levels, student.hidden, budget.quantized),
        state_bytes(n_fibres, n_measures, student.hidden),
        errors,
        len(test),
    )


def render_header(student: StudentNetwork, budget: MemoryBudget, about: Sequence[str]) -> str:
    """Render the template; beyond the budget, the header does not compile. `about` is lines of its first comment."""
    environment = Environment(
        loader=PackageLoader("padforge.sense.deploy", "."), undefined=StrictUndefined, keep_trailing_newline=True
    )
    environment.filters |= {"f": _float, "literal": _literal, "numbers": _numbers}
    modules = map(vars, (streaming, network, scaler, localizer_model))
    constants = {name: value for module in modules for name, value in module.items() if name.isupper()}
    return environment.get_template("localizer.h.j2").render(
        constants | {"WRAP_AT": WRAP_AT, "WRAP_BY": WRAP_BY},
        about=about,
        budget=budget,
        model=student.model,
        scaler=student.model.scaler,
        detector=student.detector,
        hidden=student.hidden,
        quantized=student.quantized,
        tables=_tables(student),
    )


def _tables(student: StudentNetwork) -> dict[str, Any]:
    model, of = student.model, student.model.scaler
    units = [of.scale_mm] * 3 + [measure.scale for measure in of.measures]
    tables: dict[str, Any] = {
        "rates": streaming.RATES,
        "inverse_noise": student.detector.inverse_noise,
        "mean": of.mean_v,
        "scale": of.scale_v,
        "history_coef": of.history_coef,
        "history_mean": of.history_mean_v,
        "interval_factors": model.interval_factors * units,
    }
    for name, layer in student.layers().items():
        tables[f"{name}_b"] = layer.bias
        if layer.scale is not None:
            tables[f"{name}_scale"] = layer.scale
        tables[f"{name}_w"] = layer.weights
    return tables


def _numbers(table: Array | Floats) -> str:
    texts = map(str if table.dtype.kind == "i" else _float, table.ravel().tolist())
    return fill(", ".join(texts), LINE, initial_indent="  ", subsequent_indent="  ")


def _float(value: float) -> str:
    """Write a number as C reads it back to the same float."""
    return _literal(f"{np.float32(value):.9g}")


def _literal(number: str) -> str:
    """Write digits as a float of C, which 13f is not."""
    return f"{number}f" if set(".e") & set(number) else f"{number}.0f"
