"""`localizer.h`: a student written out as one C99 file."""

from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from padforge.design.common.files import write_text
from padforge.sense.arrays import Array, Floats
from padforge.sense.deploy import streaming as press_stream
from padforge.sense.deploy.streaming import CODE, LAYERS, POLES, Budget, rates, state_bytes, table_bytes
from padforge.sense.deploy.student import Student, causal_beside, examine, split, teach
from padforge.sense.localizer.features import MAX_INPUT
from padforge.sense.localizer.model import MEASURED, UNKNOWN, LocalizerModel
from padforge.sense.localizer.network import EPSILON, LEAST_LOG, MOST_LOG
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import LocalizerSettings

WRAP, BACK = 2**30, 2**29
"""Readings at which the count of them goes back, and by how many: before 32 bits run over."""
LINE = 118


class Header(NamedTuple):
    """What was written: the student, the bytes of its tables and of its state at most, and how far off it is."""

    student: Student
    tables: int
    state: int
    errors: Mapping[str, Any]


def export_header(
    teacher: LocalizerModel,
    digest: str,
    path: Path,
    recording: Recording,
    budget: Budget,
    options: LocalizerSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Header:
    """Teach a student what `teacher` knows, on the presses of a recording, and write it as a C header.

    Args:
        digest: of the teacher's `localizer.json`.

    Raises:
        InputError: as `student.split` and `student.teach`, or `path` cannot be written.
    """
    training, test = split(recording, teacher, options)
    student = teach(recording, teacher, training, budget, options, progress)
    fibres, measures = teacher.fibres, len(student.localizer.scaler.measures)
    levels = len(student.localizer.interval_factors)
    causal = causal_beside(teacher, recording, training, options, progress)
    errors = examine(student, [causal] if causal is teacher else [causal, teacher], recording, test)
    about = [
        f"by padforge {version('padforge')}, of localizer.json with SHA-256",
        f"{digest}",
        f"A touch is found by a simple detector, which found {errors['found']} of {len(test)} presses "
        f"and {errors['false']} that were none.",
        f"Mean error on these presses, never trained on: {errors['errors']['header'][0]['mean_mm']:.2f} mm.",
    ]
    write_text(path, c_header(student, budget, about))
    return Header(
        student,
        table_bytes(fibres, measures, levels, student.hidden, budget.quantized),
        state_bytes(fibres, measures, student.hidden),
        errors | {"test_presses": len(test), "training_presses": len(training)},
    )


def header_lines(header: Header, budget: Budget) -> list[str]:
    """The same for people."""
    student, errors = header.student, header.errors
    kind = "int8" if student.quantized else "float32"
    predicted_mm = "" if errors["predicted_mm"] is None else f"; mean error of these {errors['predicted_mm']:.2f} mm"
    size = f"{student.hidden} neurons in each of {LAYERS + 1} layers"
    flash = (
        f"flash {(header.tables + CODE) / 1024:.1f} KiB of {budget.flash / 1024:.4g}, {CODE / 1024:g} of them for code"
    )
    columns: Mapping[str, Any] = errors["errors"]
    width = max(7, *map(len, columns))
    lines = [
        f"{size}, {kind}: {flash}; RAM {header.state / 1024:.1f} KiB of {budget.ram / 1024:.4g}",
        f"mean error in mm on {errors['test_presses']} presses never trained on",
        "lost  sets" + "".join(f" {name:>{width}}" for name in columns),
    ]
    for row in zip(*columns.values(), strict=True):
        means = "".join(f" {each['mean_mm']:{width}.2f}" for each in row)
        lines.append(f"{row[0]['n_failed']:4d} {row[0]['subsets']:5d}{means}")
    return [
        *lines,
        f"its own detector finds {errors['found']} of {errors['test_presses']} presses, "
        f"{errors['false']} touches that are none{predicted_mm}",
    ]


def c_header(student: Student, budget: Budget, about: Sequence[str]) -> str:
    """The text of the header.

    Args:
        about: lines that say what it was made of and how far off it is.
    """
    localizer, detector = student.localizer, student.detector
    scaling = localizer.scaler
    span, hidden = scaling.span_mm, student.hidden
    environment = Environment(
        loader=PackageLoader("padforge.sense.deploy", "."),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    environment.filters["rows"] = lambda values: fill(
        ", ".join(values), LINE, initial_indent="  ", subsequent_indent="  "
    )
    return environment.get_template("localizer.h.j2").render(
        about=about,
        fibres=localizer.fibres,
        rate=f"{localizer.rate_hz:.4g}",
        rate_hz=_literal(f"{localizer.rate_hz:.4g}"),
        flash=budget.flash,
        code=CODE,
        ram=budget.ram,
        hidden=hidden,
        layers=len(localizer.weights["hidden.w"]),
        numbers=2 + len(scaling.measures),
        levels=len(localizer.interval_factors),
        poles=POLES,
        inputs=len(press_stream.WINDOWS),
        **_stream_constants(),
        threshold=_float(detector.threshold),
        judge=detector.threshold,
        late=detector.late,
        wrap=WRAP,
        back=BACK,
        max_input=_float(MAX_INPUT),
        epsilon=_float(EPSILON),
        least_log=_float(LEAST_LOG),
        most_log=_float(MOST_LOG),
        span=_float(span),
        middle=[_float(each) for each in scaling.origin_mm],
        unknown=[_float(each * span) for each in UNKNOWN[1:]],
        measures=[
            dict(zip(("value", "r90"), MEASURED[each.name], strict=True))
            | {"span": _float(each.span), "middle": _float(each.middle)}
            for each in scaling.measures
        ],
        quantized=student.quantized,
        kind="int8_t" if student.quantized else "float",
        tables=_tables(student),
    )


def _stream_constants() -> dict[str, Any]:
    """What the header has of its twin's numbers, by their names in lower case."""
    counts = {
        name.lower(): getattr(press_stream, name) for name in ("RING", "LAG", "REST", "SEEN", "SETTLING", "LONGEST")
    }
    floats = {name.lower(): _float(getattr(press_stream, name)) for name in ("MOST_V", "FOLLOWING", "GONE_BACK")}
    windows = ", ".join(f"{{{first}, {end}}}" for first, end in press_stream.WINDOWS)
    return {**counts, **floats, "windows": windows, "follows": round(1 / press_stream.FOLLOWING)}


def _tables(student: Student) -> list[dict[str, Any]]:
    localizer, scaling = student.localizer, student.localizer.scaler
    units = [scaling.span_mm] * 3 + [each.span for each in scaling.measures]
    floats = {
        "rates": rates(),
        "quiet": student.detector.quiet,
        "centre": scaling.centre,
        "spread": scaling.spread,
        "memory": scaling.memory,
        "usual": scaling.usual,
        "interval_factors": localizer.interval_factors * units,
    }
    out = [_table(name, values) for name, values in floats.items()]
    for name, matrix in student.matrices().items():
        out.append(_table(f"{name}_b", matrix.bias))
        if matrix.scale is None:
            out.append(_table(f"{name}_w", matrix.rows))
        else:
            out.append(_table(f"{name}_scale", matrix.scale))
            out.append({"name": f"{name}_w", "kind": "int8_t", "entries": [str(each) for each in matrix.rows.ravel()]})
    return out


def _table(name: str, values: Array | Floats) -> dict[str, Any]:
    return {"name": name, "kind": "float", "entries": [_float(each) for each in values.ravel().tolist()]}


def _float(value: float) -> str:
    """A number as C reads it back to the same float."""
    return _literal(f"{np.float32(value):.9g}")


def _literal(number: str) -> str:
    """A number in digits as a float of C, which 13f is not."""
    return f"{number}f" if set(".e") & set(number) else f"{number}.0f"
